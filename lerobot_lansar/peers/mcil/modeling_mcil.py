"""MCIL under the name by which LeRobot looks for it."""

from ..latent_plan.modeling import LatentPlanPolicy
from .configuration_mcil import MCILConfig


class MCILPolicy(LatentPlanPolicy):
    """`LatentPlanPolicy` with MCIL's values."""

    config_class = MCILConfig
    name = "mcil"
