"""Carries out a skill on a desk, closed loop, and keeps what a CALVIN recording keeps of every frame."""

from dataclasses import dataclass, field

import numpy as np

from ..desk import TASKS, Desk, DeskError
from ..desk.robot import ANGLE_STEP, POSITION_STEP
from ..desk.starts import sample_start
from .skills import SKILLS, View, Waypoint

MAX_STEPS = 200
_AFTERWARDS = 2  # frames kept after the oracle was satisfied
_PATIENCE = 12  # control steps without progress after which the next waypoint is due


@dataclass
class Demonstration:
    """One accepted demonstration; row t of each array is frame t.

    Attributes:
        frames: Key to (n, ...) array: ``robot_obs`` (15,), ``scene_obs`` (24,) with blocks in red, blue, pink order,
            ``actions`` (7,) absolute, ``rel_actions`` (7,) and the desk's pictures.
    """

    task: str
    frames: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames["actions"])


def relative_action(action: np.ndarray, robot_obs: np.ndarray) -> np.ndarray:
    """CALVIN's ``rel_actions``: the way from the present TCP pose to the commanded one in units of 0.02 m and 0.05
    rad, clipped to +-1, with angles taken the short way round; (7,)."""
    rotation = _wrap(action[3:6] - robot_obs[3:6])
    return np.concatenate(
        [
            np.clip((action[:3] - robot_obs[:3]) / POSITION_STEP, -1, 1),
            np.clip(rotation / ANGLE_STEP, -1, 1),
            action[6:],
        ]
    )


def demonstrate(desk: Desk, task: str, rng: np.random.Generator, noise: float = 0.2) -> Demonstration | None:
    """Tries ``task`` once from a random feasible start.

    Args:
        desk: Any desk; the episode's pictures are those of its cameras.
        task: One of :data:`SKILLS`.
        rng: Decides start, approach, speed and noise.
        noise: Standard deviation of the disturbance of executed actions, in relative action units; now and then a
            push of some steps, four times as strong, comes on top. What is recorded is the intended action, so a
            policy sees how to come back from a disturbance.

    Returns:
        The demonstration, or None when the oracle did not see the task fulfilled.

    Raises:
        DeskError: No skill for this task.
    """
    if task not in SKILLS:
        raise DeskError(f"task {task!r} cannot be demonstrated yet; choose among: {', '.join(SKILLS)}")
    robot_obs, scene_obs = sample_start(desk, task, rng)
    obs = desk.reset(robot_obs, scene_obs)
    start, fulfilled = desk.snapshot(), TASKS[task]
    view = View(desk.scene, obs["robot_obs"], obs["scene_obs"], rng)
    speed = rng.uniform(0.8, 1.0)
    disturbance = _Disturbance(noise, rng)
    rows: list[dict[str, np.ndarray]] = []
    remaining = MAX_STEPS
    for waypoint in SKILLS[task](view):
        best, stalled, held = np.inf, 0, 0
        while remaining > 0:
            distance, turn = _error(waypoint, obs["robot_obs"])
            arrived = np.linalg.norm(distance) < waypoint.tolerance and np.abs(turn).max() < 0.12
            if arrived and held >= waypoint.hold:
                break
            held += int(arrived)
            action = _toward(waypoint, obs["robot_obs"], distance, turn, speed)
            rows.append({**obs, "actions": action, "rel_actions": relative_action(action, obs["robot_obs"])})
            obs = desk.step(disturbance.of(action), control_mode="abs")
            view.robot_obs, view.scene_obs = obs["robot_obs"], obs["scene_obs"]
            remaining -= 1
            if remaining > _AFTERWARDS and fulfilled(start, desk.snapshot()):
                remaining = _AFTERWARDS
            error = float(np.linalg.norm(distance) + 0.1 * np.abs(turn).max())
            stalled = 0 if error < best - 1e-3 else stalled + 1
            best = min(best, error)
            if stalled > _PATIENCE + waypoint.hold:
                break
        if remaining <= 0:
            break
    if not fulfilled(start, desk.snapshot()):
        return None
    return Demonstration(task, {key: np.stack([row[key] for row in rows]) for key in rows[0]})


def _error(waypoint: Waypoint, robot_obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return waypoint.position - robot_obs[:3], _wrap(waypoint.euler - robot_obs[3:6])


def _wrap(angles: np.ndarray) -> np.ndarray:
    """Angles (rad) brought into [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _toward(
    waypoint: Waypoint, robot_obs: np.ndarray, distance: np.ndarray, turn: np.ndarray, speed: float
) -> np.ndarray:
    """The next absolute command: on every axis the way to the waypoint, at most a relative step of +-1.

    Limiting each axis by itself keeps the hand on its line while it pushes or pulls: sideways errors are corrected
    in full whatever remains to go.
    """
    step = POSITION_STEP * speed * waypoint.slow
    return np.concatenate(
        [
            robot_obs[:3] + np.clip(distance, -step, step),
            _wrap(robot_obs[3:6] + np.clip(turn, -ANGLE_STEP * speed, ANGLE_STEP * speed)),
            [waypoint.gripper],
        ]
    )


class _Disturbance:
    """Noise on executed actions: a little at every step, and pushes of four steps at random moments."""

    def __init__(self, noise: float, rng: np.random.Generator):
        self._noise, self._rng = noise, rng
        self._push: np.ndarray = np.zeros(6)
        self._left = 0

    def of(self, action: np.ndarray) -> np.ndarray:
        """The action that is really executed, (7,)."""
        if self._left == 0 and self._rng.uniform() < 0.025:
            self._push, self._left = self._rng.normal(0, 4 * self._noise, 6), 4
        units = self._rng.normal(0, self._noise, 6) + (self._push if self._left else 0.0)
        self._left = max(self._left - 1, 0)
        return np.concatenate([action[:6] + units * ([POSITION_STEP] * 3 + [ANGLE_STEP] * 3), action[6:]])
