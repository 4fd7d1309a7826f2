"""The thesis' peers as LeRobot policies: they read pictures and commands, and no privileged state.

latent_plan  what MCIL and HULC share
mcil         --policy.type=mcil
hulc         --policy.type=hulc
gr1          --policy.type=gr1
inputs       what they check of datasets and environments, and how they prepare pictures
processor    their pipelines

Importing this package registers all of them. docs/peers.md says where sizes and constants come from.
"""

from .gr1 import GR1Config
from .hulc import HULCConfig
from .mcil import MCILConfig

__all__ = ["GR1Config", "HULCConfig", "MCILConfig"]
