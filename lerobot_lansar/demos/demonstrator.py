"""Carries out a skill on a desk, closed loop, and keeps of every frame what a CALVIN recording keeps."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ..calvin import STEPS_PER_COMMAND, relative_action
from ..desk import Desk, DeskError, is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import Snapshot
from ..desk.starts import sample_start
from .motion import Disturbance, Motion
from .moves import Skill, Style, View
from .skills import SKILLS

AFTERWARDS = 2
"""Frames for which the oracle must stay satisfied before a demonstration ends."""
_PATIENCE = 12  # control steps without progress after which the next waypoint is due
_TURN_TOLERANCE = 0.12  # rad

Frame = dict[str, np.ndarray]


@dataclass
class Demonstration:
    """One accepted demonstration; row t of each array is frame t.

    Attributes:
        task: The task that it fulfils.
        frames: Key to (n, ...) array: `robot_obs` (15,), `scene_obs` (24,) with blocks in red, blue, pink order,
            `actions` (7,) absolute, `rel_actions` (7,) and the desk's pictures.
    """

    task: str
    frames: Frame = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames["actions"])


def carry_out(
    desk: Desk,
    obs: Observation,
    skill: Skill,
    rng: np.random.Generator,
    *,
    start: Observation | None = None,
    before: Observation | None = None,
    variety: float = 1.0,
    noise: float = 0.2,
    steps: int = STEPS_PER_COMMAND,
) -> Iterator[tuple[Frame, Observation, Snapshot]]:
    """Carries out a skill from the present state to the skill's end, or until the caller has seen enough.

    The present state may be anywhere in the middle of the command, however it came about: a skill does what is left to
    do since `start`.

    Args:
        desk: In the state that `obs` shows.
        obs: The latest observation.
        skill: Where the hand goes.
        rng: The only source of randomness: style and noise.
        start: The observation when the command began; None: `obs`.
        before: The observation one control step before `obs`, from which the hand's velocity follows; None: the hand
            is at rest.
        variety, noise: As for `demonstrate`.
        steps: Maximum number of control steps.

    Yields:
        For each control step its frame (the observation before it, `actions`, `rel_actions`), and the observation
        and the snapshot after it.
    """
    begun = obs if start is None else start
    view = View(desk.scene, obs["robot_obs"], obs["scene_obs"], rng, Style.sample(rng, variety), begun)
    motion = Motion(obs["robot_obs"], view.style.speed, None if before is None else before["robot_obs"])
    disturbance = Disturbance(noise, rng)
    for waypoint in skill(view):
        pause = int(rng.integers(1, 9)) if rng.uniform() < view.style.pauses else 0
        best, stalled, held = np.inf, 0, 0
        while waypoint.keep is None or waypoint.keep():
            distance, turn = motion.error(waypoint, obs["robot_obs"])
            arrived = distance < waypoint.tolerance and turn < _TURN_TOLERANCE
            if arrived and held >= waypoint.hold + pause:
                break
            if steps <= 0:
                return
            action = motion.toward(waypoint, obs["robot_obs"])
            frame = {**obs, "actions": action, "rel_actions": relative_action(action, obs["robot_obs"])}
            obs = desk.step(disturbance.of(action, waypoint.careful), control_mode="abs")
            view.robot_obs, view.scene_obs = obs["robot_obs"], obs["scene_obs"]
            yield frame, obs, desk.snapshot()
            steps -= 1
            held += int(arrived)
            error = distance + 0.1 * turn
            stalled = 0 if error < best - 1e-3 else stalled + 1
            best = min(best, error)
            if stalled > _PATIENCE + waypoint.hold + pause:
                break


def fulfil(
    desk: Desk,
    obs: Observation,
    task: str,
    rng: np.random.Generator,
    *,
    before: Observation | None = None,
    variety: float = 1.0,
) -> tuple[bool, Observation, Observation]:
    """Carries out a task as a command of the benchmark: up to the step in which it is fulfilled, or for 360 steps.

    Args:
        desk, obs, rng, before, variety: As for `carry_out`.
        task: One of `SKILLS`.

    Returns:
        Whether it was fulfilled; the observations after the last step and before it.
    """
    start, begun, earlier, left = desk.snapshot(), obs, before, STEPS_PER_COMMAND
    while left:
        began = left
        frames = carry_out(desk, obs, SKILLS[task], rng, start=begun, before=earlier, variety=variety, steps=left)
        for frame, after, snapshot in frames:
            earlier, obs, left = frame, after, left - 1
            if is_fulfilled(task, start, snapshot):
                return True, obs, earlier
        if left == began:  # the skill sees nothing to do
            break
    return False, obs, obs if earlier is None else earlier


def demonstrate(
    desk: Desk, task: str, rng: np.random.Generator, noise: float = 0.2, variety: float = 1.0
) -> Demonstration | None:
    """Tries `task` once from a random feasible start.

    Args:
        desk: Any desk; the frames hold the pictures of its cameras.
        task: One of `SKILLS`.
        rng: The only source of randomness: start, approach, speed and noise.
        noise: Standard deviation of the disturbance of executed actions, in relative action units; now and then a
            push of four steps, four times as strong, is added. The recorded action is the intended one, so a policy
            sees how to recover from a disturbance.
        variety: 0 to 1, how much speed, approach, contact points and pauses differ between episodes.

    Returns:
        The demonstration, or None if the oracle did not see the task fulfilled, or not for long enough.

    Raises:
        DeskError: There is no such task.
    """
    if task not in SKILLS:
        raise DeskError(f"task {task!r} is unknown; choose among: {', '.join(SKILLS)}")
    obs = desk.reset(*sample_start(desk, task, rng))
    start, rows, satisfied = desk.snapshot(), [], 0
    for frame, _, snapshot in carry_out(desk, obs, SKILLS[task], rng, variety=variety, noise=noise):
        rows.append(frame)
        satisfied = satisfied + 1 if is_fulfilled(task, start, snapshot) else 0
        if satisfied > AFTERWARDS:
            return Demonstration(task, {key: np.stack([row[key] for row in rows]) for key in rows[0]})
    return None
