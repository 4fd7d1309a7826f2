"""The CALVIN desk on PyBullet: physics, cameras and the 34-task oracle. Needs neither LeRobot nor torch.

desk             `Desk`: reset, step, observe, render
scenes           the four scenes as numbers, and the geometry that they share
assets           the URDF files to load: a calvin_env checkout's, or generated ones
builtin          how URDFs are generated from a scene's numbers
robot            the Panda: inverse kinematics, position control, `robot_obs`
furniture        the desk's joints and lights, and the blocks: `scene_obs`
cameras          the two cameras' clip planes and view matrices
render/          pictures: our two renderers and PyBullet's two
oracle           which tasks were fulfilled between two moments
starts           random start states in which a task is feasible
sentences        commands in words: a grammar, or a user's file
errors           what users can cause
quiet            imports pybullet without its greeting
"""

from . import quiet  # noqa: F401  before the modules that import pybullet
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
