"""Replays a recording on a desk, and says how far that is from what was recorded."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..calvin import ARM_JOINTS, BLOCKS, wrap_angle
from ..command import CommandError
from ..desk import Desk, DeskError, Observation, SimulationError
from .recordings import Recording

MEASURES = ("TCP mm", "TCP °", "arm joints °", "blocks mm", "furniture mm")
"""What `deviations` measures: the TCP's distance and turn, and the largest of the seven arm joints, of the three
blocks' distances, and of slide, drawer, button and switch."""


@dataclass
class Outcome:
    """How a replay went.

    Attributes:
        deviations: (m, 5) of `MEASURES` in each frame; m is the recording's number of frames, unless the simulation
            diverged.
        fulfilled: Each task that was fulfilled at some time, to the first frame in which it was.
        observations: What the desk observed: of actions one more than frames, the state after the last action.
        diverged: Whether the simulation ended early because a state was no longer finite.
    """

    deviations: np.ndarray
    fulfilled: dict[str, int]
    observations: list[Observation]
    diverged: bool

    @property
    def largest(self) -> np.ndarray:
        """The largest deviation of the replay by each of `MEASURES`, (5,); infinite if the simulation diverged."""
        return np.full(len(MEASURES), np.inf) if self.diverged else self.deviations.max(axis=0)


def set_states(desk: Desk, recording: Recording) -> Outcome:
    """Sets the recorded states one after the other.

    Raises:
        CommandError: A state cannot be set.
    """
    states = zip(recording.robot_obs, recording.scene_obs, strict=True)
    return _follow(desk, recording, (desk.reset(*state) for state in states))


def carry_out_actions(desk: Desk, recording: Recording, control_mode: str) -> Outcome:
    """Carries out the recorded actions one after the other, from the first recorded state.

    Raises:
        CommandError: The recording has no actions of this control mode, or one cannot be carried out.
    """
    if control_mode not in recording.actions:
        raise CommandError(f"{recording.name} holds no actions of --control_mode={control_mode}")

    def observations() -> Iterator[Observation]:
        yield desk.reset(recording.robot_obs[0], recording.scene_obs[0], continued=True)
        for action in recording.actions[control_mode]:
            yield desk.step(action, control_mode)

    return _follow(desk, recording, observations())


def _follow(desk: Desk, recording: Recording, observations: Iterator[Observation]) -> Outcome:
    """Watches a replay; the oracle judges every frame from the first one on, as in CALVIN's evaluation."""
    seen: list[Observation] = []
    fulfilled: dict[str, int] = {}
    diverged = False
    try:
        for frame, observation in enumerate(observations):
            seen.append(observation)
            if frame == 0:
                start = desk.snapshot()
            for task in desk.completed_tasks(start):
                fulfilled.setdefault(task, frame)
    except SimulationError:
        diverged = True
    except DeskError as error:
        raise CommandError(f"{recording.name}: {error}") from error
    compared = min(len(seen), len(recording))
    robot_obs, scene_obs = (
        np.array([obs[key] for obs in seen[:compared]]).reshape(compared, -1) for key in ("robot_obs", "scene_obs")
    )
    found = deviations(robot_obs, scene_obs, recording.robot_obs[:compared], recording.scene_obs[:compared])
    return Outcome(found, fulfilled, seen, diverged)


def deviations(
    robot_obs: np.ndarray, scene_obs: np.ndarray, recorded_robot_obs: np.ndarray, recorded_scene_obs: np.ndarray
) -> np.ndarray:
    """How far n states are from recorded ones.

    Args:
        robot_obs, recorded_robot_obs: (n, 15).
        scene_obs, recorded_scene_obs: (n, 24), blocks of both in the same order.

    Returns:
        (n, 5) of `MEASURES`.
    """
    n = len(robot_obs)
    if n == 0:
        return np.zeros((0, len(MEASURES)))
    robot, scene = robot_obs - recorded_robot_obs, scene_obs - recorded_scene_obs
    # Of the turn from one orientation to the other: euler angles of one orientation may differ by any amount.
    now, then = (Rotation.from_euler("xyz", obs[:, 3:6]) for obs in (robot_obs, recorded_robot_obs))
    blocks = np.linalg.norm(scene[:, BLOCKS].reshape(n, 3, 6)[..., :3], axis=-1)
    return np.stack(
        [
            np.linalg.norm(robot[:, :3], axis=-1) * 1000,
            np.degrees((now * then.inv()).magnitude()),
            np.degrees(np.abs(wrap_angle(robot[:, ARM_JOINTS])).max(axis=-1)),
            blocks.max(axis=-1) * 1000,
            np.abs(scene[:, :4]).max(axis=-1) * 1000,
        ],
        axis=-1,
    )
