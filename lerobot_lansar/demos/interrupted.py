"""States in the middle of a command, as a policy leaves them behind, and whether the demonstrator finishes from there.

The demonstrator begins a task and is interrupted at a random moment; then something else moves the hand for a while.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..calvin import COLORS, POSE_UNITS, TASKS, TCP_POSE, Task
from ..desk import Desk, is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import TABLE, Snapshot
from ..desk.scenes import REACH, TABLE_Z, beside_door
from ..desk.starts import sample_start
from .demonstrator import AFTERWARDS, carry_out
from .moves import FALLEN, View, lying, on_table
from .skills import SKILLS
from .skills.blocks import best_base, has_shelf_room

DISTURBANCES = ("none", "wander", "grip", "wrong task")
"""What happens between the interruption and the takeover: nothing; up to 30 random steps; up to 30 steps in place with
the hand opened or closed; up to 90 steps of another task."""
_LATEST = 130  # control steps after which the interruption comes at the latest


@dataclass(frozen=True)
class Interruption:
    """A takeover, as `carry_out` needs it.

    Attributes:
        start, before, now: Observations when the command began, one control step ago, and at the takeover.
        begun: The snapshot when the command began.
        feasible: Whether the task can still be done.
        disturbance: One of `DISTURBANCES`.
    """

    start: Observation
    before: Observation
    now: Observation
    begun: Snapshot
    feasible: bool
    disturbance: str


def interrupt(desk: Desk, task: str, rng: np.random.Generator) -> Interruption:
    """Begins `task` from a random start, interrupts it before it is fulfilled, and lets something else happen.

    Args:
        desk: Left in the state of the takeover.
        task: One of `SKILLS`.
        rng: The only source of randomness.
    """
    while True:
        start = before = now = desk.reset(*sample_start(desk, task, rng))
        begun = desk.snapshot()
        disturbance = str(rng.choice(DISTURBANCES))
        first = carry_out(desk, now, SKILLS[task], rng, steps=int(rng.integers(0, _LATEST)))
        for _, after, snapshot in first:
            before, now = now, after
            if is_fulfilled(task, begun, snapshot):
                break
        for after in _disturb(desk, task, now, disturbance, rng):
            before, now = now, after
        if not is_fulfilled(task, begun, desk.snapshot()):
            feasible = _can_still_be_done(TASKS[task], _view(desk, start), _view(desk, now), begun)
            return Interruption(start, before, now, begun, feasible, disturbance)


def _disturb(
    desk: Desk, task: str, now: Observation, disturbance: str, rng: np.random.Generator
) -> Iterator[Observation]:
    """Carries out a disturbance; yields the observation after each control step."""
    steps = int(rng.integers(1, 31))
    if disturbance == "wrong task":
        other = str(rng.choice([name for name in SKILLS if name != task]))
        for _, after, _ in carry_out(desk, now, SKILLS[other], rng, steps=3 * steps):
            yield after
    elif disturbance != "none":
        way: np.ndarray = np.zeros(6)
        gripper = float(rng.choice([-1.0, 1.0]))
        for _ in range(steps):
            if disturbance == "wander":
                way = np.clip(0.8 * way + rng.normal(0, 0.4, 6), -1, 1)
                gripper = -gripper if rng.uniform() < 0.1 else gripper
            action = np.concatenate([now["robot_obs"][TCP_POSE] + way * POSE_UNITS, [gripper]])
            now = desk.step(action, control_mode="abs")
            yield now


def finishes(desk: Desk, task: str, takeover: Interruption, rng: np.random.Generator) -> int:
    """Control steps in which a fresh demonstrator fulfils `task` for good, or 0; `desk` is in the takeover's state."""
    satisfied = 0
    steps = carry_out(desk, takeover.now, SKILLS[task], rng, start=takeover.start, before=takeover.before)
    for count, (_, _, snapshot) in enumerate(steps, start=1):
        satisfied = satisfied + 1 if is_fulfilled(task, takeover.begun, snapshot) else 0
        if satisfied > AFTERWARDS:
            return count
    return 0


def _view(desk: Desk, obs: Observation) -> View:
    return View(desk.scene, obs["robot_obs"], obs["scene_obs"], np.random.default_rng(0))


def _can_still_be_done(task: Task, start: View, now: View, begun: Snapshot) -> bool:
    """Whether `task` can still be done, by the rules for start states in docs/demonstrations.md."""
    held = start.held()
    color = task.color or held
    if color is not None and not _can_be_taken(now, color):
        return False
    if task.kind == "place_block" and task.place == "slider":
        return has_shelf_room(now)
    if task.kind == "place_block":
        return now.drawer > 0.15
    if task.kind == "rotate_block":
        turn = Rotation.from_euler("xyz", now.block(str(color))[3:])
        turn *= Rotation.from_euler("xyz", start.block(str(color))[3:]).inv()
        return bool(turn.as_matrix()[2, 2] > 0.85)
    if task.kind == "stack_block":
        return held is not None and best_base(now, held) is not None
    if task.kind == "push_into_drawer":
        pushed = [c for c in COLORS if begun.blocks[c].contacts == {TABLE}]
        return now.drawer > 0.15 and any(
            now.holds(c) or (on_table(now.block(c)) and _can_be_taken(now, c)) for c in pushed
        )
    return True


def _can_be_taken(view: View, color: str) -> bool:
    """Whether a block is in the hand or lies where a hand can take it, with nothing on it."""
    x, y, z = view.block(color)[:3]
    if view.holds(color):
        return True
    if any(view.lies_on(other, color) for other in COLORS if other != color):
        return False
    if z < TABLE_Z - 0.05:
        return bool(z > FALLEN and y < -0.215)
    if y > 0.0:
        return bool(y < 0.125 and lying(view.block(color))[1] and beside_door(view.scene, view.slide, x))
    return bool(y > -0.19 and abs(x) < REACH)
