"""What the peers check of datasets and environments, and how they prepare pictures."""

from typing import Any

import torch
import torch.nn.functional as F
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from ..calvin import ACTION_NAMES, CONTROL_MODES, ROBOT_OBS_NAMES
from ..clip.store import IMAGE_FEATURES


def check_features(config: PreTrainedConfig) -> None:
    """Checks that a policy has pictures, robot state and actions, and drops all other inputs from its options.

    Raises:
        ValueError: Features are missing or have the wrong shape; the message names each.
    """
    inputs = config.input_features or {}
    features = {**inputs, **(config.output_features or {})}
    if not features:
        return  # a policy built by hand
    problems = [f"{name} is missing" for name in IMAGE_FEATURES.values() if name not in features]
    for name, size in ((OBS_STATE, len(ROBOT_OBS_NAMES)), (ACTION, 7)):
        if name not in features:
            problems.append(f"{name} is missing")
        elif tuple(features[name].shape) != (size,):
            problems.append(f"{name} has shape {tuple(features[name].shape)}, not ({size},)")
    if problems:
        raise ValueError(
            f"--policy.type={config.type} cannot use these features: {'; '.join(problems)}. It needs "
            f"{', '.join(IMAGE_FEATURES.values())}, observation.state (15,) and action (7,), as lansar-convert "
            "writes them and --env.type=calvin provides them."
        )
    for name in inputs.keys() - {*IMAGE_FEATURES.values(), OBS_STATE}:
        del inputs[name]


def check_actions(features: dict, control_mode: str) -> None:
    """Raises ValueError unless a dataset's actions are of this control mode, as their names say."""
    names = features.get(ACTION, {}).get("names")
    if names is None or tuple(names) != ACTION_NAMES[control_mode]:
        raise ValueError(
            f"--policy.control_mode={control_mode} needs actions named {list(ACTION_NAMES[control_mode])}; the "
            f"dataset's are {names}. Convert with lansar-convert --action={control_mode}."
        )


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


def shift(pictures: Tensor, by: int, alike: int = 1) -> Tensor:
    """Pictures moved by up to `by` pixels in each direction, with their edges repeated (Yarats et al. 2021).

    Args:
        pictures: (N, 3, H, W).
        by: Pixels.
        alike: So many successive pictures are moved alike.
    """
    if not by:
        return pictures
    count, _, height, width = pictures.shape
    padded = F.pad(pictures, (by,) * 4, mode="replicate")
    device = pictures.device
    starts = torch.randint(0, 2 * by + 1, (2, count // alike, 1), device=device).repeat_interleave(alike, dim=1)
    rows, columns = (s + torch.arange(size, device=device) for s, size in zip(starts, (height, width), strict=True))
    which = torch.arange(count, device=device)[:, None, None]
    return padded[which, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)
