"""From waypoints to actions: a hand that speeds up and slows down smoothly along straight lines."""

import numpy as np

from ..calvin import POSE_UNITS, TCP_POSE, wrap_angle
from .moves import Waypoint, turned

RESPONSE = 0.5
"""Fraction of the commanded distance that the arm covers in one control step, also for angles (measured)."""
TOP_SPEED, TOP_TURN = 0.0095, 0.024
"""m and rad per control step: those of the largest relative action."""
ACCELERATION, TURN_ACCELERATION = 0.0015, 0.004
"""m and rad per control step squared."""
LEAD = np.array([0.02] * 3 + [0.08] * 3)
"""Maximum distance (m, rad) of the planned pose from the real one, when something holds the hand back; (6,)."""


def _difference(target: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """target - pose for poses of xyz and euler, (6,); yaw turns the way that keeps the last joint within its limits."""
    way = target - pose
    way[3:5] = wrap_angle(way[3:5])
    way[5] = turned(target[5]) - turned(pose[5])
    return way


class Motion:
    """Follows waypoints with a planned pose that moves with limited speed and acceleration.

    The planned pose moves along straight lines, at most `LEAD` ahead of the hand. Each command corrects half of the
    hand's deviation from it. All commands stay within a relative action of +-1 per axis.

    Args:
        robot_obs: (15,), where the motion begins.
        speed: Fraction of `TOP_SPEED` and `TOP_TURN`.
        before: (15,), one control step earlier; None: the hand is at rest.
    """

    def __init__(self, robot_obs: np.ndarray, speed: float, before: np.ndarray | None = None):
        self._speed = speed
        self._plan = robot_obs[TCP_POSE].copy()
        self._velocity: np.ndarray = np.zeros(6)
        if before is not None:
            velocity = _difference(robot_obs[TCP_POSE], before[TCP_POSE])
            self._velocity[:3] = np.clip(velocity[:3], -TOP_SPEED, TOP_SPEED)
            self._velocity[3:] = np.clip(velocity[3:], -TOP_TURN, TOP_TURN)

    def error(self, waypoint: Waypoint, robot_obs: np.ndarray) -> tuple[float, float]:
        """Distance left to the waypoint (m), and the largest angle left (rad)."""
        way = _difference(np.concatenate([waypoint.position, waypoint.euler]), robot_obs[TCP_POSE])
        return float(np.linalg.norm(way[:3])), float(np.abs(way[3:]).max())

    def toward(self, waypoint: Waypoint, robot_obs: np.ndarray) -> np.ndarray:
        """The next absolute action, (7,)."""
        target = np.concatenate([waypoint.position, waypoint.euler])
        pose = robot_obs[TCP_POSE]
        ahead = np.clip(_difference(self._plan, pose), -LEAD, LEAD)
        self._plan = pose + ahead
        left = _difference(target, self._plan)
        top = self._speed * waypoint.slow
        self._velocity[:3] = _accelerate(self._velocity[:3], left[:3], TOP_SPEED * top, ACCELERATION)
        self._velocity[3:] = _accelerate(
            self._velocity[3:], left[3:], TOP_TURN * (1 + self._speed) / 2, TURN_ACCELERATION
        )
        self._plan = self._plan + self._velocity
        command = np.clip(self._velocity / RESPONSE + ahead, -POSE_UNITS, POSE_UNITS)
        action = np.concatenate([pose + command, [waypoint.gripper]])
        action[3:6] = wrap_angle(action[3:6])
        return action


def _accelerate(velocity: np.ndarray, left: np.ndarray, top: float, acceleration: float) -> np.ndarray:
    """The next velocity (3,) towards the end of the distance `left` (3,), slow enough to stop there."""
    distance = float(np.linalg.norm(left))
    wanted = left * min(top, np.sqrt(2 * acceleration * distance), distance) / max(distance, 1e-9)
    change = wanted - velocity
    size = float(np.linalg.norm(change))
    return velocity + change * min(1.0, 1.5 * acceleration / max(size, 1e-9))


class Disturbance:
    """Noise on executed actions: a little at every step, and random pushes of four steps and slips of the gripper.

    Args:
        noise: Standard deviation in relative action units.
        rng: The only source of randomness.
    """

    def __init__(self, noise: float, rng: np.random.Generator):
        self._noise, self._rng = noise, rng
        self._push: np.ndarray = np.zeros(6)
        self._pushed = 0

    def of(self, action: np.ndarray, careful: bool) -> np.ndarray:
        """The action to execute instead of `action`, (7,); with half the noise and no push while `careful`."""
        if self._rng.uniform() < 0.025 and self._pushed == 0 and not careful:
            self._push, self._pushed = self._rng.normal(0, 4 * self._noise, 6), 4
        slips = self._rng.uniform() < 0.002 * self._noise
        units = self._rng.normal(0, self._noise * (0.5 if careful else 1.0), 6)
        units += self._push if self._pushed and not careful else 0.0
        gripper = -action[6:] if slips else action[6:]
        self._pushed = max(self._pushed - 1, 0)
        return np.concatenate([action[TCP_POSE] + units * POSE_UNITS, gripper])
