"""Carries out a skill on a desk, closed loop, and keeps what a CALVIN recording keeps of every frame."""

from collections.abc import Callable, Iterator
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
"""The oracle must be satisfied in one frame and in so many after it; then a demonstration ends."""
_PATIENCE = 12  # control steps without progress after which the next waypoint is due
_TURN_TOLERANCE = 0.12  # rad

Frame = dict[str, np.ndarray]


@dataclass
class Demonstration:
    """One accepted demonstration; row t of each array is frame t.

    Attributes:
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
    variety: float = 1.0,
    noise: float = 0.2,
    steps: int = STEPS_PER_COMMAND,
    fulfilled: Callable[[Snapshot], bool] = lambda _: False,
) -> Iterator[tuple[Frame, Observation, Snapshot]]:
    """Carries out a skill from the present state; ends once it is and stays `fulfilled`, or at the skill's end.

    Args:
        desk: In the state that `obs` shows.
        obs: The latest observation.
        skill: Where the hand goes.
        rng: Decides style and noise.
        variety, noise: As for `demonstrate`.
        steps: Control steps at most.
        fulfilled: Asked after every step.

    Yields:
        For each control step its frame (the observation before it, `actions`, `rel_actions`), and the observation
        and the snapshot after it.
    """
    view = View(desk.scene, obs["robot_obs"], obs["scene_obs"], rng, Style.sample(rng, variety))
    motion = Motion(obs["robot_obs"], view.style.speed)
    disturbance = Disturbance(noise, rng)
    stays = 0
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
            snapshot = desk.snapshot()
            yield frame, obs, snapshot
            steps -= 1
            stays = stays + 1 if fulfilled(snapshot) else 0
            if stays > AFTERWARDS:
                return
            held += int(arrived)
            error = distance + 0.1 * turn
            stalled = 0 if error < best - 1e-3 else stalled + 1
            best = min(best, error)
            if stalled > _PATIENCE + waypoint.hold + pause:
                break


def demonstrate(
    desk: Desk, task: str, rng: np.random.Generator, noise: float = 0.2, variety: float = 1.0
) -> Demonstration | None:
    """Tries `task` once from a random feasible start.

    Args:
        desk: Any desk; the episode's pictures are those of its cameras.
        task: One of `SKILLS`.
        rng: Decides start, approach, speed and noise.
        noise: Standard deviation of the disturbance of executed actions, in relative action units; now and then a
            push of some steps, four times as strong, comes on top. What is recorded is the intended action, so a
            policy sees how to come back from a disturbance.
        variety: 0 to 1, how much speed, approach, contact points and pauses differ between episodes.

    Returns:
        The demonstration, or None when the oracle did not see the task fulfilled.

    Raises:
        DeskError: There is no such task.
    """
    if task not in SKILLS:
        raise DeskError(f"task {task!r} is unknown; choose among: {', '.join(SKILLS)}")
    obs = desk.reset(*sample_start(desk, task, rng))
    start, rows, stays = desk.snapshot(), [], 0
    for frame, _, snapshot in carry_out(
        desk,
        obs,
        SKILLS[task],
        rng,
        variety=variety,
        noise=noise,
        fulfilled=lambda now: is_fulfilled(task, start, now),
    ):
        rows.append(frame)
        stays = stays + 1 if is_fulfilled(task, start, snapshot) else 0
    if stays <= AFTERWARDS:
        return None
    return Demonstration(task, {key: np.stack([row[key] for row in rows]) for key in rows[0]})
