"""Telling relative from absolute actions at an episode's first one, before a mistake costs an evaluation."""

import numpy as np

from ..calvin import wrap_angle
from ..desk import DeskError

_LARGEST_RELATIVE = 1.5  # of any number of a relative action, nominally 1
_LARGEST_ABSOLUTE = 2 * np.pi  # of any number of an absolute action (m, rad)
_REACH = 1.0  # largest absolute x and y of the TCP (m)
_HEIGHT = (0.2, 1.2)  # of the TCP (m)
# The hand points down at an episode's start, so an absolute roll is half a turn, give or take a full one.
_ABSOLUTE_ROLL = 2.0  # smallest absolute value (rad)


def refuse_other_mode(action: np.ndarray, control_mode: str) -> None:
    """Checks an episode's first action. An action that is possible in neither control mode is not refused.

    Args:
        action: (7,) and finite.
        control_mode: `"rel"` or `"abs"`, what the environment takes.

    Raises:
        DeskError: The action plainly belongs to the other control mode.
    """
    height, roll = action[2:4]
    if control_mode == "rel" and _is_absolute(action):
        looks, other = f"absolute: height {height:.2f} m and roll {roll:.2f} rad", "abs"
    elif control_mode == "abs" and np.abs(action).max() <= _LARGEST_RELATIVE:
        looks, other = f"relative: as an absolute one, roll {roll:.2f} rad would not point the hand down", "rel"
    else:
        return
    raise DeskError(
        f"the environment takes control_mode={control_mode!r} actions, but the policy's first action looks {looks}. "
        f"Set --env.control_mode={other}, or use a policy trained on {control_mode!r} actions"
    )


def _is_absolute(action: np.ndarray) -> bool:
    """Whether an action is a pose in which a hand can point down."""
    x, y, height, roll = action[:4]
    is_reachable = max(abs(x), abs(y)) <= _REACH and _HEIGHT[0] < height < _HEIGHT[1]
    points_down = abs(wrap_angle(roll)) > _ABSOLUTE_ROLL
    return bool(is_reachable and points_down and np.abs(action).max() <= _LARGEST_ABSOLUTE)
