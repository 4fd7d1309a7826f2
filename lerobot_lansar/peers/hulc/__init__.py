"""HULC: importing this package registers `--policy.type=hulc`."""

from .configuration_hulc import HULCConfig

__all__ = ["HULCConfig"]
