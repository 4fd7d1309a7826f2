"""`--policy.type=mcil`: MCIL's options, as CALVIN's authors train it."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from ..latent_plan.configuration import LatentPlanConfig


@PreTrainedConfig.register_subclass("mcil")
@dataclass
class MCILConfig(LatentPlanConfig):
    """Multicontext imitation learning (Lynch and Sermanet 2021): what differs from HULC."""

    static_shift: int = 0
    gripper_shift: int = 0
    plan: str = "continuous"
    plan_size: int = 256
    recognition: str = "rnn"
    bins: int = 256
    gripper_weight: float = 0.0
    action_frame: str = "world"
    decoder_sees: str = "both"
    contrastive_weight: float = 0.0
    control_mode: str = "abs"
    # Absolute actions are brought to [-1, 1] by the dataset's smallest and largest values.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
