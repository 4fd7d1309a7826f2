"""LanSAR as a LeRobot policy: importing this package registers `--policy.type=lansar`.

The processor and scheduler are imported too: LeRobot rebuilds a checkpoint's pipelines and schedule by
registered name and imports nothing to find them. The model itself is imported by LeRobot when it is built.
"""

from .configuration_lansar import LanSARConfig
from .processor_lansar import ClipStep, WindowStep, make_lansar_pre_post_processors
from .scheduler import LinearWarmupDecaySchedulerConfig

__all__ = [
    "ClipStep",
    "LanSARConfig",
    "LinearWarmupDecaySchedulerConfig",
    "WindowStep",
    "make_lansar_pre_post_processors",
]
