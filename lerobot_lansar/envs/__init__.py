"""The CALVIN desk as a gymnasium environment. LeRobot's side of it is in `configuration_calvin`."""

from .calvin import LH_MTLC, CalvinEnv

__all__ = ["LH_MTLC", "CalvinEnv"]
