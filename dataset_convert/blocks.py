"""Which colour each block column of `scene_obs` holds, and whether the data are of the scene that they are said to be.

The documentation says red, blue, pink; the simulator writes another order in scenes A and C. The orders of scenes A to
D are known, and the data must not contradict them: in a window that lifts the red block, the red column rises; and a
door opens no farther than the scene's door does.
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from dataset_convert import checks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.frames import VECTORS
from lerobot_lansar.calvin import BLOCK_ORDER, BLOCKS, COLORS, FURNITURE, SLIDE, SLIDE_TRAVEL, TASKS, block_pose

BLOCK_ORDERS = ("checked", "known", "lifts")
"""What `--block_order` may be."""

_LIFTED = 0.03  # m; the smallest rise that CALVIN's oracle counts as a lift (from the slider)
_MOVED = 0.15  # m; the smallest motion of the door that CALVIN's oracle counts
_AGREEING = 0.8  # a few public annotations name the wrong colour, hence a majority and not unanimity
_TRAVEL_MARGIN = 0.01  # m; the doors of scenes A to D stop at least 0.024 m apart
_AT_STOP = 0.001  # m

_CORRECTIONS = (
    "Two kinds of public files were replaced. Language annotations of ABC->D and ABCD->D from before 2022-09-16 name "
    "wrong colours; scene_info.npy from before 2022-09-16 (ABC->D, ABCD->D) or 2023-02-24 (D->D) names wrong scenes. "
    "The corrected training/scene_info.npy has frame 0 in scene B on ABC->D and in scene D on the others; if yours has "
    "it there, the annotations are the old ones. docs/dataset.md says where the corrected files are"
)


@dataclass(frozen=True)
class Evidence:
    """What the windows of a scene show of it.

    Attributes:
        votes: (3, 3) int64: how often block column j rose in windows that lift colour i of `COLORS`.
        slides: The farthest position (m) of the door in each window that moved it.
    """

    votes: np.ndarray
    slides: list[float]


def gather_evidence(split: CalvinSplit, scene: str) -> Evidence:
    """Reads the first and the last frame of every window of a scene that lifts a block or moves the door.

    A window of which one of these is defective says nothing; converting it will report it.
    """
    votes = np.zeros((3, 3), dtype=np.int64)
    slides: list[float] = []
    for number, window in enumerate(split.windows):
        task = TASKS.get(window.task)
        if window.scene != scene or task is None or task.kind not in ("lift_block", "move_slider"):
            continue
        if number in split.faults:
            continue
        ends = [window.start, window.end - 1]
        try:
            columns = split.read(ends, VECTORS)
            checks.check_frames(columns, ends, split)
        except (FileNotFoundError, ValueError):
            continue
        before, after = columns["scene_obs"]
        rise = (after - before)[BLOCKS].reshape(3, 6)[:, 2]
        if task.color is not None and rise.max() > _LIFTED:
            votes[COLORS.index(task.color), rise.argmax()] += 1
        if abs(after[SLIDE] - before[SLIDE]) > _MOVED:
            slides.append(float(max(before[SLIDE], after[SLIDE])))
    return Evidence(votes, slides)


def contradictions(scene: str, evidence: Evidence) -> list[str]:
    """What speaks against the data being of a known scene with its known block order, in words; none for others."""
    if scene not in BLOCK_ORDER:
        return []
    return [text for text in (_against_order(scene, evidence.votes), _against_travel(scene, evidence.slides)) if text]


def _against_order(scene: str, votes: np.ndarray) -> str | None:
    known = BLOCK_ORDER[scene]
    if _score(known, votes) >= _AGREEING * votes.sum():
        return None
    order = _order_shown(votes)
    shown = f"show the order {', '.join(order)}" if order else "contradict each other"
    return f"its lifts {shown} ({_told(votes)}; the known order is {', '.join(known)})"


def _against_travel(scene: str, slides: list[float]) -> str | None:
    travel, farthest = SLIDE_TRAVEL[scene], max(slides, default=0.0)
    at_stop = sum(farthest - slide < _AT_STOP for slide in slides)
    if farthest > travel + _TRAVEL_MARGIN:
        what = f"its door opens to {farthest:.3f} m"
    elif farthest < travel - _TRAVEL_MARGIN and at_stop >= 3:
        what = f"its door stops at {farthest:.3f} m ({at_stop} times)"
    else:
        return None
    fitting = [name for name, stop in SLIDE_TRAVEL.items() if abs(stop - farthest) < _TRAVEL_MARGIN]
    of = f", that of scene {' and '.join(fitting)} there" if fitting else ""
    return f"{what}; the door of scene {scene} stops at {travel:.3f} m{of}"


def block_order(scene: str, evidence: Evidence, how: str = "checked") -> tuple[str, ...]:
    """Which colour each of the three block columns of `scene_obs` holds.

    Args:
        scene: The scene's letter.
        evidence: What the windows show of it.
        how: One of `BLOCK_ORDERS`: the known order, with no `contradictions`; the known order in any case; or the
            order that the lifts show. Scenes without a known order always need the last.

    Returns:
        The colour of each column.

    Raises:
        ValueError: Something contradicts what is known of the scene; or lifts are needed, and no order explains at
            least 0.8 of the votes better than all others.
    """
    known, votes = BLOCK_ORDER.get(scene), evidence.votes
    against = contradictions(scene, evidence)
    if how == "checked" and against:
        raise ValueError(
            f"scene {scene}: {'; '.join(against)}. {_CORRECTIONS}. --block_order=known keeps the known order all the "
            "same, --block_order=lifts takes the one that the lifts show"
        )
    if known is not None and how != "lifts":
        return known
    order = known if known and _against_order(scene, votes) is None else _order_shown(votes)
    if order is None:
        raise ValueError(
            f"scene {scene}: cannot tell which block is in which column of scene_obs ({_told(votes)}; known order: "
            f"{', '.join(known) if known else 'none'}); it needs agreeing lift_<colour>_… windows of two colours"
        )
    return order


def _score(order: tuple[str, ...], votes: np.ndarray) -> int:
    """How many votes an order explains."""
    return int(sum(votes[COLORS.index(color), column] for column, color in enumerate(order)))


def _order_shown(votes: np.ndarray) -> tuple[str, ...] | None:
    """The order that explains most votes, if no other explains as many and enough of them are explained."""
    orders = sorted(permutations(COLORS), key=lambda order: -_score(order, votes))
    best, second = (_score(order, votes) for order in orders[:2])
    return orders[0] if best > second and best >= _AGREEING * votes.sum() else None


def _told(votes: np.ndarray) -> str:
    return "; ".join(f"lift_{color}: columns rose {votes[i].tolist()} times" for i, color in enumerate(COLORS))


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
