"""MCIL: importing this package registers `--policy.type=mcil`."""

from .configuration_mcil import MCILConfig

__all__ = ["MCILConfig"]
