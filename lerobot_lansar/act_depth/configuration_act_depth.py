"""`--policy.type=act_depth`: ACT's options."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig


@PreTrainedConfig.register_subclass("act_depth")
@dataclass
class ACTDepthConfig(ACTConfig):
    """ACT whose pictures may have one channel: depth maps. The options are LeRobot's for ACT."""
