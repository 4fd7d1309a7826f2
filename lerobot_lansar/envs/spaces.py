"""Observation and action spaces of `CalvinEnv`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from ..calvin import (
    ACTION_NAMES,
    CONTROL_MODES,
    HOME_EULER,
    ROBOT_OBS_NAMES,
    SCENE_OBS_NAMES,
    TASKS,
    continuous_euler,
)
from ..desk import Observation
from .pictures import Pictures

ACTION_SIZE = len(ACTION_NAMES["rel"])

# Absolute actions: x, y, z (m), roll, pitch, yaw (rad), gripper. The desk accepts angles with any number of full turns;
# these are within half a turn of the hand at rest, as in the observation, the roll within a quarter.
_TURNS = np.array([np.pi / 2, np.pi, np.pi])
_ABSOLUTE_LOW = (-1.0, -1.0, 0.2, *(HOME_EULER - _TURNS), -1.0)
_ABSOLUTE_HIGH = (1.0, 1.0, 1.0, *(HOME_EULER + _TURNS), 1.0)


@dataclass(frozen=True)
class EnvironmentState:
    """What `environment_state` holds; there is no such entry if it holds nothing.

    Attributes:
        scene: The scene's 24 numbers, privileged simulator state.
        task: 34 numbers, 1 for the commanded task and 0 for the others.
    """

    scene: bool = True
    task: bool = False

    @property
    def size(self) -> int:
        """How many numbers these are."""
        return len(SCENE_OBS_NAMES) * self.scene + len(TASKS) * self.task

    def observe(self, scene_obs: np.ndarray, task: str) -> dict[str, np.ndarray]:
        """The entry of an observation, if there is one: from (24,) and the commanded task."""
        parts = ([scene_obs] if self.scene else []) + ([[float(name == task) for name in TASKS]] if self.task else [])
        return {"environment_state": np.concatenate(parts)} if parts else {}


def observation_space(pictures: Pictures, environment_state: EnvironmentState) -> spaces.Dict:
    """The space of the observations that `CalvinEnv` describes."""
    sizes = {"agent_pos": len(ROBOT_OBS_NAMES), "environment_state": environment_state.size}
    entries: dict[str, spaces.Space] = {
        key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in sizes.items() if size
    }
    entries["control_mode"] = spaces.Box(0, 1, (1,), np.float32)
    return spaces.Dict({**entries, **pictures.spaces()})


def observe(
    obs: Observation, pictures: Pictures, control_mode: str, task: str, environment_state: EnvironmentState
) -> dict[str, Any]:
    """What a policy is given of one of the desk's observations, as `CalvinEnv` describes it; in `observation_space`."""
    robot = obs["robot_obs"].copy()
    robot[3:6] = continuous_euler(robot[3:6])
    return {
        "agent_pos": robot,
        **environment_state.observe(obs["scene_obs"], task),
        "control_mode": np.array([CONTROL_MODES.index(control_mode)], dtype=np.float32),
        **pictures.observe(obs),
    }


def action_space(control_mode: str) -> spaces.Box:
    """(7,) float32: the nominal range of relative or absolute actions; the desk takes larger ones too."""
    if control_mode == "rel":
        return spaces.Box(-1, 1, (ACTION_SIZE,), np.float32)
    low, high = (np.array(bounds, dtype=np.float32) for bounds in (_ABSOLUTE_LOW, _ABSOLUTE_HIGH))
    return spaces.Box(low, high, dtype=np.float32)
