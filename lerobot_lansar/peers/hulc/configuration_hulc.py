"""`--policy.type=hulc`: HULC's options, as published."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from ..latent_plan.configuration import LatentPlanConfig


@PreTrainedConfig.register_subclass("hulc")
@dataclass
class HULCConfig(LatentPlanConfig):
    """Hierarchical Universal Language Conditioned Policies (Mees et al. 2022): the defaults of `LatentPlanConfig`."""
