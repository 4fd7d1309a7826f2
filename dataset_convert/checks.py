"""What must hold of CALVIN's frames: finite numbers, consistent actions, known block columns.

Two of its corrections are here too: the blocks' order and the roll of absolute actions.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np

from dataset_convert.calvin import VECTORS, CalvinSplit
from lerobot_lansar.calvin import (
    BLOCK_ORDER,
    BLOCKS,
    COLORS,
    FURNITURE,
    TASKS,
    block_pose,
    relative_action,
    wrap_angle,
)

_LIFTED = 0.03  # m; the smallest rise that CALVIN's oracle counts as a lift (from the slider)
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


def block_order(scene: str, votes: np.ndarray) -> tuple[str, ...]:
    """Which colour each of the three block columns of `scene_obs` holds.

    The documentation says red, blue, pink; the simulator writes another order in scenes A and C. So the data
    decide: in a window that lifts the red block, the red column rises. Where the data leave a choice, the scene's
    known order is taken.

    Args:
        scene: The scene's letter.
        votes: (3, 3) integers: how often block column j rose in windows that lift colour i of `COLORS`.

    Returns:
        The colour of each column.

    Raises:
        ValueError: The scene is unknown and the data do not settle it, or no order explains at least 0.8 of the
            votes.
    """
    known = BLOCK_ORDER.get(scene)
    orders = list(permutations(COLORS))
    scores = {order: sum(votes[COLORS.index(c), j] for j, c in enumerate(order)) for order in orders}
    best = max(scores.values())
    winners = [order for order, score in scores.items() if score == best]
    order = known if known in winners else winners[0] if len(winners) == 1 else None
    # A few public annotations name the wrong colour, hence a majority and not unanimity.
    if order is not None and best >= 0.8 * votes.sum():
        return order
    evidence = "; ".join(f"lift_{c}: columns rose {votes[i].tolist()} times" for i, c in enumerate(COLORS))
    raise ValueError(
        f"scene {scene}: cannot tell which block is in which column of scene_obs ({evidence}; known order: "
        f"{', '.join(known) if known else 'none'}); it needs agreeing lift_<colour>_… windows of two colours"
    )


def block_votes(split: CalvinSplit, scene: str) -> np.ndarray:
    """Counts which block column rises in each lifting window of a scene.

    A window whose first or last frame is defective does not vote; converting it will report it.

    Returns:
        (3, 3) int64: a row per colour that the task names, in the order of `COLORS`, a column per block column.
    """
    votes = np.zeros((3, 3), dtype=np.int64)
    for window in split.windows:
        task = TASKS.get(window.task)
        if window.scene != scene or task is None or task.kind != "lift_block" or task.color is None:
            continue
        ends = [window.start, window.end - 1]
        try:
            columns = split.read(ends, VECTORS)
            check_frames(columns, ends, split)
        except (FileNotFoundError, ValueError):
            continue
        rise = np.diff(columns["scene_obs"], axis=0)[0, BLOCKS].reshape(3, 6)[:, 2]
        if rise.max() > _LIFTED:
            votes[COLORS.index(task.color), rise.argmax()] += 1
    return votes


def without_roll_jump(actions: np.ndarray) -> np.ndarray:
    """Absolute actions (n, 7) with the roll in [0, 2 pi) instead of (-pi, pi].

    The hand points down, so CALVIN's roll jumps between pi and -pi; a policy that learns it by regression learns
    their mean, a hand that points up. Whatever executes actions accepts an angle plus any full turns.
    """
    turned = actions.copy()
    turned[:, 3] %= 2 * np.pi
    return turned


def reorder_blocks(scene_obs: np.ndarray, order: tuple[str, ...]) -> np.ndarray:
    """Puts the blocks into red, blue, pink order.

    Args:
        scene_obs: (n, 24) with block columns in `order`.
        order: Three colours.

    Returns:
        (n, 24) in the order of `COLORS`.
    """
    columns = [*range(24)[FURNITURE], *(c for color in COLORS for c in range(24)[block_pose(order.index(color))])]
    return np.take(scene_obs, columns, axis=1)  # C-contiguous for any order, so sums over frames are bit-equal
