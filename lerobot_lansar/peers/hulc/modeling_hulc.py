"""HULC under the name by which LeRobot looks for it."""

from ..latent_plan.modeling import LatentPlanPolicy
from .configuration_hulc import HULCConfig


class HULCPolicy(LatentPlanPolicy):
    """`LatentPlanPolicy` with HULC's values."""

    config_class = HULCConfig
    name = "hulc"
