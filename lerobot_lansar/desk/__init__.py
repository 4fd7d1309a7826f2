"""The CALVIN desk on PyBullet: physics, cameras and the 34-task oracle. Needs neither LeRobot nor torch."""

from .desk import CONTROL_HZ, Desk, Observation
from .errors import DeskError, SimulationError
from .oracle import TASKS, BlockState, Snapshot, completed_tasks
from .scenes import COLORS, SCENES

__all__ = [
    "COLORS",
    "CONTROL_HZ",
    "SCENES",
    "TASKS",
    "BlockState",
    "Desk",
    "DeskError",
    "Observation",
    "SimulationError",
    "Snapshot",
    "completed_tasks",
]
