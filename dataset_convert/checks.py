"""What must hold of CALVIN's frames: finite numbers and consistent actions."""

from collections.abc import Mapping, Sequence

import numpy as np

from dataset_convert.calvin import CalvinSplit
from lerobot_lansar.calvin import relative_action, wrap_angle

_ACTION_TOLERANCE = 1e-4  # float32 rounding of an angle near pi is 5e-6 in units of a relative action


def check_frames(
    columns: dict[str, np.ndarray],
    frames: Sequence[int],
    split: CalvinSplit,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Checks frames; shapes and dtypes were checked when they were read.

    Args:
        columns: The frames' vectors and pictures, each (n, ...).
        frames: Their n numbers.
        split: Where they are from, for messages.
        limits: Array to the smallest and largest distance (m) that its depth video can hold.

    Raises:
        ValueError: A number is not finite as float32, a distance does not fit into its video, a gripper command is
            neither -1 nor 1, or a relative action is not what `actions` and `robot_obs` say it is; the message
            names the file.
    """
    for key, column in columns.items():
        if column.dtype != np.uint8:
            _check_numbers(key, column, frames, split, (limits or {}).get(key))
    _check_actions(columns, frames, split)


def _check_numbers(
    key: str, column: np.ndarray, frames: Sequence[int], split: CalvinSplit, limits: tuple[float, float] | None
) -> None:
    """Numbers must be finite, and distances within the limits of their depth video."""
    with np.errstate(over="ignore"):  # what is stored is float32: 1e39 would become infinite
        rows = column.reshape(len(column), -1).astype(np.float32, copy=False)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        file = split.frame_file(frames[int(bad.argmax())])
        raise ValueError(f"{file}: array {key!r} holds a number that is not finite in float32")
    if limits is None:
        return
    low, high = limits
    nearest, farthest = rows.min(axis=1), rows.max(axis=1)
    bad = (nearest < low) | (farthest > high)
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{split.frame_file(frames[row])}: array {key!r}: distances of {nearest[row]:g} to {farthest[row]:g} m do "
            f"not fit into a depth video of {low:g} to {high:g} m; --images=png keeps them exactly"
        )


def _check_actions(columns: dict[str, np.ndarray], frames: Sequence[int], split: CalvinSplit) -> None:
    """Gripper commands must be -1 or 1, and relative actions those that absolute ones imply."""
    actions, robot_obs, stored = columns["actions"], columns["robot_obs"], columns["rel_actions"]
    gripper = actions[:, 6]
    neither = ~np.isin(gripper, (-1, 1))
    if neither.any():
        row = int(neither.argmax())
        file = split.frame_file(frames[row])
        raise ValueError(f"{file}: gripper command {gripper[row]:g} in 'actions', expected -1 or 1")
    implied = relative_action(actions, robot_obs)
    wrong: np.ndarray = np.abs(stored - implied) > _ACTION_TOLERANCE
    # Half a turn is as far to the left as to the right: rounding decides the sign, so both are accepted.
    half_turn = np.abs(np.abs(wrap_angle(actions[:, 3:6] - robot_obs[:, 3:6])) - np.pi) < 1e-4
    wrong[:, 3:6] &= ~(half_turn & (np.abs(np.abs(stored[:, 3:6]) - 1) <= _ACTION_TOLERANCE))
    if wrong.any():
        row, axis = map(int, np.argwhere(wrong)[0])
        raise ValueError(
            f"{split.frame_file(frames[row])}: rel_actions[{axis}] is {stored[row, axis]:.6f}, "
            f"but actions and robot_obs give {implied[row, axis]:.6f}"
        )
