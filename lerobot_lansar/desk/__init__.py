"""The CALVIN desk on PyBullet: physics, cameras and the 34-task oracle. Needs neither LeRobot nor torch."""

from .desk import Desk, Observation
from .errors import DeskError, SimulationError
from .oracle import BlockState, Snapshot, completed_tasks, is_fulfilled
from .scenes import SCENES

__all__ = [
    "SCENES",
    "BlockState",
    "Desk",
    "DeskError",
    "Observation",
    "SimulationError",
    "Snapshot",
    "completed_tasks",
    "is_fulfilled",
]
