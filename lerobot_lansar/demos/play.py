"""Play: tasks follow each other without a reset, as in CALVIN's data. Language windows are cut from that: CALVIN's
short ones around each fulfilled task, or whole subtasks, from the command to its fulfilment."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from ..calvin import CHAIN_LENGTH, COLORS, GRIPPER_ACTION, STEPS_PER_COMMAND, SWITCH, TASKS, WINDOW_FRAMES
from ..desk import Desk, SimulationError, completed_tasks, is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import DRAWER, PLANK, TABLE, Condition, Snapshot, is_stacked
from ..desk.scenes import DRAWER_TRAVEL, SWITCH_TRAVEL, Scene
from ..desk.starts import REACH, TABLE_Z, beside_door, sample_start
from .calvin_folder import FrameWriter, Unit
from .demonstrator import AFTERWARDS, carry_out
from .moves import Skill, Style, View, Waypoint, lying
from .skills import SKILLS
from .skills.blocks import put_down

_SHORTEST = 32
_PER_TASK = 2  # windows cut around a fulfilled task: CALVIN's windows show each frame 1.58 times
_LATEST = 10  # frames after the fulfilment at which a window ends at the latest


def record_play(
    desk: Desk,
    frames: int,
    rng: np.random.Generator,
    writer: FrameWriter,
    noise: float,
    variety: float,
    whole: bool = False,
) -> Unit:
    """Plays for `frames` control steps and writes all of them.

    A task is chosen among those that are feasible, carried out, and followed by a moment of rest. When a block fell
    off the desk or the physics diverged, the desk is reset to a random state and a new recording begins.

    Args:
        desk: Any desk; the frames hold the pictures of its cameras.
        frames: How many to record.
        rng: Decides everything.
        writer: Receives the frames.
        noise, variety: As for `demonstrator.demonstrate`.
        whole: The windows are whole subtasks instead of CALVIN's.

    Returns:
        What was recorded: stretches between resets, and the windows with their tasks.
    """
    unit = Unit(desk.scene.name)
    while writer.frames < frames:
        start, snapshots, fulfilled = writer.frames, [], []
        try:
            for frame, snapshot, done in _play(desk, frames - start, rng, noise, variety, unit, whole):
                writer.add(frame)
                snapshots.append(snapshot)
                if done is not None:
                    began, task = done
                    fulfilled.append((began, len(snapshots) - 1, task))
        except SimulationError:
            pass
        if snapshots:
            unit.recordings.append((start, writer.frames))
            cut = whole_windows(snapshots, fulfilled) if whole else cut_windows(snapshots, fulfilled, rng)
            for first, end, task in cut:
                unit.windows.append((start + first, start + end, task))
    unit.frames, unit.sums = writer.frames, writer.sums()
    return unit


def _play(
    desk: Desk,
    frames: int,
    rng: np.random.Generator,
    noise: float,
    variety: float,
    unit: Unit,
    whole: bool,
) -> Iterator[tuple[dict[str, np.ndarray], Snapshot, tuple[int, str] | None]]:
    """One uninterrupted recording. Yields each frame, its snapshot, and of the task first seen fulfilled in it the
    frame in which it was begun and its name.
    """
    obs = desk.reset(*sample_start(desk, str(rng.choice(list(TASKS))), rng))
    last, before = desk.snapshot(), None
    left, carried_out = frames, 0
    while left > 0:
        tasks = feasible_tasks(desk.scene, last, obs)
        skill: Skill
        oracle: Condition
        if tasks:
            task = _choose(tasks, before, rng)
            unit.tried[task] = unit.tried.get(task, 0) + 1
            skill, oracle, before = SKILLS[task], partial(is_fulfilled, task), task
        else:
            task, skill, oracle = "", put_down, _never
        start, began, done = last, frames - left, False
        rest = int(rng.integers(1, 6) if whole else rng.integers(2, 20))
        for moves, limit, stop in ((skill, STEPS_PER_COMMAND, oracle), (_resting, rest, _never)):
            steps = carry_out(
                desk,
                obs,
                moves,
                rng,
                variety=variety,
                noise=noise,
                steps=min(left, limit),
                fulfilled=partial(stop, start),
            )
            for frame, after, now in steps:
                first = not done and oracle(start, last)
                done = done or first
                yield frame, last, (began, task) if first else None
                obs, last, left = after, now, left - 1
        if done:
            unit.accepted[task] = unit.accepted.get(task, 0) + 1
        carried_out += 1
        if any(block.position[2] < 0.30 for block in last.blocks.values()):
            return
        if whole and (not done or carried_out == CHAIN_LENGTH):
            return


def _never(start: Snapshot, end: Snapshot) -> bool:
    return False


def _resting(view: View) -> Iterator[Waypoint]:
    """Stay where you are, with the hand as it is."""
    yield view.go(
        view.tcp.copy(), float(view.robot_obs[GRIPPER_ACTION]), view.robot_obs[3:6].copy(), hold=STEPS_PER_COMMAND
    )


def _choose(tasks: list[str], before: str | None, rng: np.random.Generator) -> str:
    """One of the tasks: kinds of task are equally likely, not tasks, and none comes twice in a row if others can."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for task in tasks:
        if task != before or len(tasks) == 1:
            kinds.setdefault((TASKS[task].kind, TASKS[task].place or ""), []).append(task)
    listed = kinds[sorted(kinds)[rng.choice(len(kinds))]]
    return str(rng.choice(listed))


def _held(snapshot: Snapshot) -> str | None:
    return next((color for color, block in snapshot.blocks.items() if block.bodies == {"robot"}), None)


def feasible_tasks(scene: Scene, snapshot: Snapshot, obs: Observation) -> list[str]:
    """The tasks that can begin now, by CALVIN's rules (a block in the hand can only be placed or stacked) and by what
    a hand can reach.

    Args:
        scene: The desk's scene.
        snapshot, obs: The present state.
    """
    held = _held(snapshot)
    view = View(scene, obs["robot_obs"], obs["scene_obs"], np.random.default_rng(0), Style())
    on_table = [c for c in COLORS if _free_on_table(view, snapshot, c)]
    slide, drawer = snapshot.slide, snapshot.drawer
    at_end = min(slide, scene.slide_travel - slide) < 0.03
    if held is not None:
        if not view.holds(held):
            return []  # it hangs on the hand somehow
        others = [c for c in on_table if c != held]
        return [
            *(["place_in_slider"] if at_end else []),
            *(["place_in_drawer"] if drawer > 0.15 else []),
            *(["stack_block"] if others else []),
        ]
    tasks = [
        *(["move_slider_left"] if scene.slide_travel - slide > 0.16 else []),
        *(["move_slider_right"] if slide > 0.16 else []),
        *(["open_drawer"] if DRAWER_TRAVEL - drawer > 0.13 else []),
        *(["close_drawer"] if drawer > 0.13 else []),
        "turn_off_lightbulb" if snapshot.bulb else "turn_on_lightbulb",
        "turn_off_led" if snapshot.led else "turn_on_led",
    ]
    switch = view.scene_obs[SWITCH]
    if snapshot.bulb != (switch > SWITCH_TRAVEL / 2):
        tasks.remove("turn_off_lightbulb" if snapshot.bulb else "turn_on_lightbulb")
    for color in on_table:
        tasks.append(f"lift_{color}_block_table")
        tasks += [f"rotate_{color}_block_{side}" for side in ("left", "right")]
        for side, sign in (("left", -1), ("right", 1)):
            if abs(view.block(color)[0] + sign * 0.11) < REACH:
                tasks.append(f"push_{color}_block_{side}")
    if drawer > 0.15 and any(abs(view.block(c)[0] - scene.drawer_x) < 0.3 for c in on_table):
        tasks.append("push_into_drawer")
    for color in COLORS:
        block, (x, y, z) = snapshot.blocks[color], view.block(color)[:3]
        beside = beside_door(scene, slide, x)
        flat = lying(view.block(color))[1]
        if PLANK in block.contacts and not _under_another(snapshot, color) and beside and y < 0.125 and flat:
            tasks.append(f"lift_{color}_block_slider")
        if DRAWER in block.contacts and not _under_another(snapshot, color) and y < -0.215 and z < TABLE_Z - 0.05:
            tasks.append(f"lift_{color}_block_drawer")
    if any(is_stacked(block) for block in snapshot.blocks.values()):
        tasks.append("unstack_block")
    return tasks


def _free_on_table(view: View, snapshot: Snapshot, color: str) -> bool:
    block, pose = snapshot.blocks[color], view.block(color)
    on_it = block.contacts == {TABLE} and abs(pose[2] - TABLE_Z) < 0.03
    return bool(on_it and abs(pose[0]) < REACH and -0.19 < pose[1] < 0.0)


def _under_another(snapshot: Snapshot, color: str) -> bool:
    position = snapshot.blocks[color].position
    above = [snapshot.blocks[c].position - position for c in COLORS if c != color]
    return any(gap[2] > 0.03 and np.linalg.norm(gap[:2]) < 0.05 for gap in above)


def whole_windows(snapshots: list[Snapshot], fulfilled: list[tuple[int, int, str]]) -> list[tuple[int, int, str]]:
    """Windows from the frame in which a task was begun until it is, and for some frames has been, fulfilled: what a
    policy has to do in a rollout of several subtasks, from where the one before left the desk.

    Args:
        snapshots: Of each frame of one recording.
        fulfilled: (began, frame, task): when tasks were begun and first seen fulfilled.

    Returns:
        (first, end, task) with an exclusive end, in order. Tasks that did not stay fulfilled give none.
    """
    return [
        (began, frame + 1 + AFTERWARDS, task)
        for began, frame, task in fulfilled
        if frame + AFTERWARDS < len(snapshots)
        and all(is_fulfilled(task, snapshots[began], now) for now in snapshots[frame : frame + 1 + AFTERWARDS])
    ]


def cut_windows(
    snapshots: list[Snapshot], fulfilled: list[tuple[int, int, str]], rng: np.random.Generator
) -> list[tuple[int, int, str]]:
    """Windows of at most 64 frames between whose first and last frame exactly one task was fulfilled.

    Args:
        snapshots: Of each frame of one recording.
        fulfilled: (began, frame, task): when tasks were begun and first seen fulfilled.
        rng: Decides where windows begin and end around these frames.

    Returns:
        (first, end, task) with an exclusive end, in order; windows may overlap. Tasks that took longer than a window,
        or cannot be told from another one, give none.
    """
    windows = set()
    for _, frame, task in fulfilled:
        found = 0
        for attempt in range(8):
            latest = min(frame + 1 + _LATEST, len(snapshots))
            end = int(rng.integers(frame + 1, latest + 1))
            length = WINDOW_FRAMES if attempt % 2 else int(rng.integers(_SHORTEST, WINDOW_FRAMES + 1))
            first = max(end - length, 0)
            if completed_tasks(snapshots[first], snapshots[end - 1]) == {task}:
                windows.add((first, end, task))
                found += 1
            if found == _PER_TASK:
                break
    return sorted(windows)
