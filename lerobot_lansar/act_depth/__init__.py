"""LeRobot's ACT for datasets with depth: importing this package registers `--policy.type=act_depth`.

LeRobot 0.6's own policies take pictures of three channels only, and end with an error at depth, which has one.

configuration_act_depth  ACTDepthConfig: the options, which are ACT's
modeling_act_depth       ACTDepthPolicy: ACT that sees depth as a grey picture
processor_act_depth      the pipelines, which are ACT's
"""

from .configuration_act_depth import ACTDepthConfig

__all__ = ["ACTDepthConfig"]
