"""Play: tasks follow each other without a reset, as in CALVIN's data. Language windows are cut from that: CALVIN's
short ones around each fulfilled task, or whole subtasks, from the command to its fulfilment."""

from collections.abc import Iterator, Mapping

import numpy as np

from ..calvin import CHAIN_LENGTH, COLORS, GRIPPER_ACTION, STEPS_PER_COMMAND, SWITCH, TASKS, WINDOW_FRAMES, Task
from ..desk import Desk, SimulationError, completed_tasks, is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import DRAWER, PLANK, TABLE, Snapshot, has_stack
from ..desk.scenes import DRAWER_TRAVEL, REACH, SWITCH_TRAVEL, TABLE_Z, Scene, beside_door, can_be_pushed
from ..desk.starts import sample_start
from .calvin_folder import FrameWriter, Unit
from .demonstrator import AFTERWARDS, Frame, carry_out
from .moves import FALLEN, Style, View, Waypoint, lying
from .skills import SKILLS
from .skills.blocks import has_shelf_room, put_down

NO_WEIGHTS: Mapping[str, float] = {}
_SHORTEST = 32  # frames in a window, unless its recording began later
_PER_TASK = 2  # windows cut around a fulfilled task: CALVIN's windows show each frame 1.58 times
_LATEST = 10  # frames after the fulfilment in which a window must end


def kind_name(task: Task) -> str:
    """The kind of task that a weight is given to; for lifting and placing with where."""
    if task.kind == "place_block":
        return task.name
    return f"lift_{task.place}" if task.kind == "lift_block" else task.kind


KINDS = tuple(dict.fromkeys(kind_name(task) for task in TASKS.values()))
"""The kinds of tasks among which play chooses."""


def record_play(
    desk: Desk,
    frames: int,
    rng: np.random.Generator,
    writer: FrameWriter,
    noise: float,
    variety: float,
    whole: bool = False,
    weights: Mapping[str, float] = NO_WEIGHTS,
) -> Unit:
    """Plays for `frames` control steps and writes all of them.

    One of the feasible tasks is chosen, carried out, and followed by a short rest. When a block fell off the desk or
    the physics diverged, the desk is reset to a random state and a new recording begins.

    Args:
        desk: Any desk; the frames hold the pictures of its cameras.
        frames: How many to record.
        rng: The only source of randomness.
        writer: Receives the frames.
        noise, variety: As for `demonstrator.demonstrate`.
        whole: The windows are whole subtasks instead of CALVIN's.
        weights: Kind of task (`KINDS`) to how often it is chosen compared with a kind that is not named.

    Returns:
        What was recorded: stretches between resets, and the windows with their tasks.
    """
    unit = Unit(desk.scene.name)
    while writer.frames < frames:
        start, snapshots, fulfilled = writer.frames, [], []
        try:
            for frame, snapshot, done in _play(desk, frames - start, rng, noise, variety, unit, whole, weights):
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
    weights: Mapping[str, float],
) -> Iterator[tuple[Frame, Snapshot, tuple[int, str] | None]]:
    """One uninterrupted recording; counts tasks tried and accepted in `unit`.

    Yields:
        Each frame, its snapshot, and, if a task is first seen fulfilled in it, the frame in which the task was begun
        and its name.
    """
    obs = desk.reset(*sample_start(desk, str(rng.choice(list(TASKS))), rng))
    last = desk.snapshot()
    task: str | None = None
    left, carried_out = frames, 0
    before: str | None = None
    while left > 0:
        feasible = feasible_tasks(desk.scene, last, obs, before)
        task = choose_task(feasible, before, rng, weights) if feasible else None
        if task is not None:
            unit.tried[task] = unit.tried.get(task, 0) + 1
            before = task
        start, began = last, frames - left
        done, satisfied = False, 0
        rest = int(rng.integers(1, 6) if whole else rng.integers(2, 20))
        acting = SKILLS[task] if task is not None else put_down
        for skill, limit in ((acting, STEPS_PER_COMMAND), (stay, rest)):
            for frame, after, now in carry_out(
                desk, obs, skill, rng, variety=variety, noise=noise, steps=min(left, limit)
            ):
                first = satisfied > 0 and not done
                done = done or first
                yield frame, last, (began, str(task)) if first else None
                obs, last, left = after, now, left - 1
                satisfied = satisfied + 1 if task is not None and is_fulfilled(task, start, now) else 0
                if skill is acting and satisfied > AFTERWARDS:
                    break
        if done and task is not None:
            unit.accepted[task] = unit.accepted.get(task, 0) + 1
        carried_out += 1
        if any(block.position[2] < FALLEN for block in last.blocks.values()):
            return
        if whole and (not done or carried_out == CHAIN_LENGTH):
            return


def stay(view: View) -> Iterator[Waypoint]:
    """Stay in place, with the hand as it is."""
    yield view.go(view.tcp.copy(), float(view.robot_obs[GRIPPER_ACTION]), view.euler, hold=STEPS_PER_COMMAND)


def choose_task(tasks: list[Task], before: str | None, rng: np.random.Generator, weights: Mapping[str, float]) -> str:
    """The name of one task: kinds are as likely as their weights say, and none comes twice in a row if others can."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for task in sorted(tasks, key=_color_and_side):
        if task.name != before or len(tasks) == 1:
            kinds.setdefault((task.kind, task.place or ""), []).append(task.name)
    names = sorted(kinds)
    likely = np.array([weights.get(kind_name(TASKS[kinds[name][0]]), 1.0) for name in names])
    if not likely.any():  # nothing else can be done
        likely = np.ones(len(names))
    kind = kinds[names[rng.choice(len(names), p=likely / likely.sum())]]
    return str(rng.choice(kind))


def _color_and_side(task: Task) -> tuple[int, str]:
    return COLORS.index(task.color) if task.color is not None else 0, task.side or ""


def feasible_tasks(scene: Scene, snapshot: Snapshot, obs: Observation, before: str | None = None) -> list[Task]:
    """The tasks that can begin now, by CALVIN's rules and by what a hand can reach.

    A block in the hand can only be placed or stacked, but for the upper block of a stack: unstacking ends with it in
    the hand, and the benchmark goes on as if it lay on the table.

    Args:
        scene: The desk's scene.
        snapshot, obs: The present state.
        before: The task that has just been fulfilled, if any.
    """
    view = View(scene, obs["robot_obs"], obs["scene_obs"], np.random.default_rng(0), Style())
    held = snapshot.held
    if held is not None and not view.holds(held):
        return []  # the block hangs on the hand, but not between the fingers
    tasks = []
    if held is not None:
        tasks += [task for task in TASKS.values() if _is_feasible_holding(task, held, view, snapshot)]
    if held is None or before == "unstack_block":
        tasks += [task for task in TASKS.values() if _is_feasible(task, view, snapshot)]
    return tasks


def _is_feasible_holding(task: Task, held: str, view: View, snapshot: Snapshot) -> bool:
    """Whether a task can begin with a block in the hand."""
    match task.kind, task.place:
        case "place_block", "slider":
            return has_shelf_room(view)
        case "place_block", "drawer":
            return view.drawer > 0.15
        case "stack_block", _:
            return any(_free_on_table(color, view, snapshot) for color in COLORS if color != held)
    return False


def _is_feasible(task: Task, view: View, snapshot: Snapshot) -> bool:
    """Whether a task can begin with an empty hand."""
    switched_on = view.scene_obs[SWITCH] > SWITCH_TRAVEL / 2
    match task.kind:
        case "move_slider":
            return (view.slide if task.side == "right" else view.scene.slide_travel - view.slide) > 0.16
        case "open_drawer":
            return DRAWER_TRAVEL - view.drawer > 0.13
        case "close_drawer":
            return view.drawer > 0.13
        case "turn_on_lightbulb":
            return not snapshot.bulb and not switched_on
        case "turn_off_lightbulb":
            return snapshot.bulb and bool(switched_on)
        case "turn_on_led":
            return not snapshot.led
        case "turn_off_led":
            return snapshot.led
        case "unstack_block":
            return has_stack(snapshot)
        case "push_into_drawer":
            near = [color for color in COLORS if abs(view.block(color)[0] - view.scene.drawer_x) < 0.3]
            return view.drawer > 0.15 and any(_free_on_table(color, view, snapshot) for color in near)
        case "rotate_block":
            return _free_on_table(str(task.color), view, snapshot)
        case "push_block":
            color = str(task.color)
            return _free_on_table(color, view, snapshot) and can_be_pushed(task.side, view.block(color)[0])
        case "lift_block":
            return _can_be_lifted(str(task.color), str(task.place), view, snapshot)
    return False


def _can_be_lifted(color: str, place: str, view: View, snapshot: Snapshot) -> bool:
    """Whether a block lies in that place, with nothing on it, and where a hand can take it."""
    if place == "table":
        return _free_on_table(color, view, snapshot)
    (x, y, z), contacts = view.block(color)[:3], snapshot.blocks[color].contacts
    if any(view.lies_on(other, color) for other in COLORS if other != color):
        return False
    if place == "drawer":
        return DRAWER in contacts and bool(y < -0.215 and z < TABLE_Z - 0.05)
    flat = lying(view.block(color))[1]
    return PLANK in contacts and bool(y < 0.125) and flat and beside_door(view.scene, view.slide, x)


def _free_on_table(color: str, view: View, snapshot: Snapshot) -> bool:
    """Whether a block touches nothing but the table and lies where a hand can push and take it."""
    x, y, z = view.block(color)[:3]
    on_it = snapshot.blocks[color].contacts == {TABLE} and abs(z - TABLE_Z) < 0.03
    return bool(on_it and abs(x) < REACH and -0.19 < y < 0.0)


def whole_windows(snapshots: list[Snapshot], fulfilled: list[tuple[int, int, str]]) -> list[tuple[int, int, str]]:
    """Windows from the frame in which a task was begun until it has stayed fulfilled for `AFTERWARDS` frames.

    That is what a policy does in a rollout of several subtasks: it begins where the subtask before left the desk. The
    oracle may waver at first, for instance when a block that is being turned leaves the table for a frame.

    Args:
        snapshots: One per frame of one recording.
        fulfilled: (began, frame, task): the frames in which a task was begun and first seen fulfilled, in order.

    Returns:
        (first, end, task) with an exclusive end, in order. Tasks that did not stay fulfilled until the next one began
        give none.
    """
    windows = []
    for number, (began, frame, task) in enumerate(fulfilled, start=1):
        until = fulfilled[number][0] if number < len(fulfilled) else len(snapshots)
        lasting = 0
        for end in range(frame, until):
            lasting = lasting + 1 if is_fulfilled(task, snapshots[began], snapshots[end]) else 0
            if lasting > AFTERWARDS:
                windows.append((began, end + 1, task))
                break
    return windows


def cut_windows(
    snapshots: list[Snapshot], fulfilled: list[tuple[int, int, str]], rng: np.random.Generator
) -> list[tuple[int, int, str]]:
    """Windows of at most `WINDOW_FRAMES` frames between whose first and last frame exactly one task was fulfilled.

    Args:
        snapshots: One per frame of one recording.
        fulfilled: (began, frame, task): the frames in which a task was begun and first seen fulfilled.
        rng: The only source of randomness: where windows begin and end around these frames.

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
