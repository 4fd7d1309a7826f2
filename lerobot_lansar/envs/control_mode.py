"""Telling relative from absolute actions at an episode's first one, before a mistake costs an evaluation."""

import numpy as np

from ..calvin import wrap_angle
from ..desk import DeskError

# The hand points down at an episode's start, so an absolute roll is half a turn, give or take a full one. A relative
# roll is nominally within +-1.
_RELATIVE_ROLL = 1.0  # largest absolute value (units of 0.05 rad)
_ABSOLUTE_ROLL = 2.0  # smallest absolute value (rad)
_REACH = 1.0  # largest absolute x and y of the TCP (m)
_HEIGHT = (0.2, 1.2)  # of the TCP (m)


def refuse_other_mode(action: np.ndarray, control_mode: str) -> None:
    """Checks an episode's first action.

    Args:
        action: (7,) and finite.
        control_mode: `"rel"` or `"abs"`, what the environment takes.

    Raises:
        DeskError: The action plainly belongs to the other control mode.
    """
    x, y, height, roll = action[:4]
    if control_mode == "rel" and _is_absolute(x, y, height, roll):
        looks, other = f"absolute: height {height:.2f} m and roll {roll:.2f} rad", "abs"
    elif control_mode == "abs" and abs(roll) <= _RELATIVE_ROLL:
        looks, other = f"relative: as an absolute one, roll {roll:.2f} rad would point the hand up", "rel"
    else:
        return
    raise DeskError(
        f"the environment takes control_mode={control_mode!r} actions, but the policy's first action looks {looks}. "
        f"Set --env.control_mode={other}, or use a policy trained on {control_mode!r} actions"
    )


def _is_absolute(x: float, y: float, height: float, roll: float) -> bool:
    """Whether a hand could be there, pointing down."""
    is_reachable = max(abs(x), abs(y)) <= _REACH and _HEIGHT[0] < height < _HEIGHT[1]
    return is_reachable and abs(wrap_angle(roll)) > _ABSOLUTE_ROLL
