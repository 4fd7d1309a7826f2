"""What the peers check of datasets and environments, and how they prepare pictures."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
import torch.nn.functional as F
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from ..calvin import ACTION_NAMES, CONTROL_MODES, ROBOT_OBS_NAMES
from ..clip.store import IMAGE_FEATURES, data_files
from ..datasets import feature_problems


def check_features(config: PreTrainedConfig, reads_state: bool) -> None:
    """Checks that a policy has what it reads, and removes all other entries of `config.input_features`.

    Raises:
        ValueError: Features are missing or have the wrong shape; the message names each.
    """
    inputs = config.input_features or {}
    features = {**inputs, **(config.output_features or {})}
    if not features:
        return  # a policy built by hand
    problems = [f"{name} is missing" for name in IMAGE_FEATURES.values() if name not in features]
    states = {OBS_STATE: len(ROBOT_OBS_NAMES)} if reads_state else {}
    problems += feature_problems(features, {**states, ACTION: 7})
    if problems:
        raise ValueError(
            f"--policy.type={config.type} cannot use these features: {'; '.join(problems)}. It needs "
            f"{', '.join([*IMAGE_FEATURES.values(), *states])} and action as lansar-convert writes them and "
            "--env.type=calvin provides them."
        )
    for name in inputs.keys() - {*IMAGE_FEATURES.values(), *states}:
        del inputs[name]


def check_actions(features: dict, control_mode: str) -> None:
    """Raises ValueError unless a dataset's actions are of this control mode, as their names say."""
    names = features.get(ACTION, {}).get("names")
    if names is None or tuple(names) != ACTION_NAMES[control_mode]:
        raise ValueError(
            f"--policy.control_mode={control_mode} needs actions named {list(ACTION_NAMES[control_mode])}; the "
            f"dataset's are {names}. Convert with lansar-convert --action={control_mode}."
        )


def command_ends(root: Path) -> np.ndarray:
    """Where the command of each frame ends: (frames,) int64, the `index` of the first frame after it.

    That is the recording's end, unless it is play with commands in between.
    """
    parts = [pq.read_table(file, columns=["index", "episode_index", "task_index"]) for file in data_files(root)]
    index, episode, task = (np.concatenate([part[name].to_numpy() for part in parts]) for name in parts[0].column_names)
    order = np.argsort(index)
    changes = np.flatnonzero(np.diff(episode[order]) | np.diff(task[order])) + 1
    bounds = np.array([0, *changes, len(order)])
    ends = np.empty(index.max() + 1, np.int64)
    ends[index[order]] = np.repeat(index[order][bounds[1:] - 1] + 1, np.diff(bounds))
    return ends


def check_control_mode(observation: dict[str, Any], control_mode: str) -> None:
    """Raises ValueError if an environment says that it takes actions of the other control mode."""
    told = observation.get("observation.control_mode")
    if told is not None and (told != CONTROL_MODES.index(control_mode)).any():
        raise ValueError(
            f"This policy's actions are {control_mode!r}, but the environment takes others: evaluate with "
            f"--env.control_mode={control_mode}."
        )


def pictures_of(observation: dict[str, Any]) -> list[Tensor]:
    """The static and the gripper pictures.

    Raises:
        ValueError: One is missing.
    """
    missing = [key for key in IMAGE_FEATURES.values() if key not in observation]
    if missing:
        raise ValueError(f"There is no {', '.join(missing)}: evaluate with --env.cameras='[static,gripper]'.")
    return [observation[key] for key in IMAGE_FEATURES.values()]


def resize(pictures: Tensor, size: int, mode: str = "bilinear") -> Tensor:
    """(N, 3, H, W) -> (N, 3, size, size)."""
    if tuple(pictures.shape[-2:]) == (size, size):
        return pictures
    return F.interpolate(pictures, (size, size), mode=mode, align_corners=False, antialias=True)


def shift(pictures: Tensor, by: int, group: int = 1) -> Tensor:
    """Pictures moved by up to `by` pixels in each direction, with their edges repeated (Yarats et al. 2021).

    Args:
        pictures: (N, 3, H, W).
        by: Pixels.
        group: So many successive pictures are moved alike.
    """
    if not by:
        return pictures
    count, _, height, width = pictures.shape
    padded = F.pad(pictures, (by,) * 4, mode="replicate")
    device = pictures.device
    starts = torch.randint(0, 2 * by + 1, (2, count // group, 1), device=device).repeat_interleave(group, dim=1)
    rows, columns = (s + torch.arange(size, device=device) for s, size in zip(starts, (height, width), strict=True))
    which = torch.arange(count, device=device)[:, None, None]
    return padded[which, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)
