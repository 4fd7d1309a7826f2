"""What must hold of CALVIN data before it is converted: finite numbers, consistent actions, known block
columns."""

from collections.abc import Mapping, Sequence
from itertools import permutations
from pathlib import Path

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
        columns: The frames' vectors and, if any, distances, each (n, …); colours are left alone.
        frames: Their n numbers.
        split: Names the files.
        limits: Array -> smallest and largest distance (m) that its depth video can hold.

    Raises:
        ValueError: A number is not finite as float32, a distance does not fit into its video, a gripper command is
            neither -1 nor 1, or a relative action is not what `actions` and `robot_obs` say it is; the message
            names the file.
    """
    limits = limits or {}

    def file_of(row: np.integer) -> Path:
        return split.frame_file(frames[int(row)])

    for key, column in columns.items():
        if column.dtype == np.uint8:
            continue
        with np.errstate(over="ignore"):  # what is stored is float32: 1e39 would become infinite
            rows = column.reshape(len(column), -1).astype(np.float32, copy=False)
        bad = ~np.isfinite(rows).all(axis=1)
        if bad.any():
            raise ValueError(f"{file_of(bad.argmax())}: array {key!r} holds a number that is not finite in float32")
        if key in limits:
            low, high = limits[key]
            nearest, farthest = rows.min(axis=1), rows.max(axis=1)
            bad = (nearest < low) | (farthest > high)
            if bad.any():
                row = bad.argmax()
                raise ValueError(
                    f"{file_of(row)}: array {key!r}: distances of {nearest[row]:g} to {farthest[row]:g} m do not fit "
                    f"into a depth video of {low:g} to {high:g} m; --images=png keeps them exactly"
                )
    gripper = columns["actions"][:, 6]
    neither = ~np.isin(gripper, (-1, 1))
    if neither.any():
        row = neither.argmax()
        raise ValueError(f"{file_of(row)}: gripper command {gripper[row]:g} in 'actions', expected -1 or 1")

    actions, robot_obs, stored = columns["actions"], columns["robot_obs"], columns["rel_actions"]
    wrong: np.ndarray = np.abs(stored - relative_action(actions, robot_obs)) > _ACTION_TOLERANCE
    # Half a turn is as far to the left as to the right: rounding decides the sign, so both are accepted.
    half_turn = np.abs(np.abs(wrap_angle(actions[:, 3:6] - robot_obs[:, 3:6])) - np.pi) < 1e-4
    wrong[:, 3:6] &= ~(half_turn & (np.abs(np.abs(stored[:, 3:6]) - 1) <= _ACTION_TOLERANCE))
    if wrong.any():
        row, axis = np.argwhere(wrong)[0]
        expected = relative_action(actions, robot_obs)[row, axis]
        raise ValueError(
            f"{file_of(row)}: rel_actions[{axis}] is {stored[row, axis]:.6f}, "
            f"but actions and robot_obs give {expected:.6f}"
        )


def block_order(scene: str, votes: np.ndarray) -> tuple[str, ...]:
    """Which colour each of the three block columns of `scene_obs` holds.

    The documentation says red, blue, pink; the simulator writes another order in scenes A and C. So the data
    decide: in a window that lifts the red block, the red column rises. The scene's known order serves where
    the data leave a choice, or say nothing.

    Args:
        scene: The scene's letter.
        votes: (3, 3) integers, how often block column j rose in windows that lift colour i of
        `COLORS`.

    Returns:
        Three colours, the first being that of the first column.

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

    A window whose first or last frame is defective does not vote: if it is to be converted, that is reported, or
    the window left out, then.

    Returns:
        (3, 3) int64: row = colour named by the task in the order of `COLORS`, column = block column.
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

    The hand points down, so CALVIN's roll jumps between pi and -pi, and a policy that learns it by regression learns
    their mean, a hand that points up. Everybody who takes actions takes any turn of an angle.
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
    return np.take(scene_obs, columns, axis=1)  # in rows, whose sums do not depend on the order of columns
