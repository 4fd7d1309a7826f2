"""Training windows: which steps of which demonstration the network sees for a sampled frame, and what it
should predict.

LeRobot samples every frame of every episode once per epoch, in random order. Here a sampled frame stands for
a window of at most n = `window` steps, chosen by a fixed rule, so that a run can be resumed and a validation
loss compared:

* "episode": the demonstration from its start (thesis). Of a demonstration longer than n, frame j stands for
  the window that starts at j * (L - n) / (L - 1): every start equally often, the first and the last n steps
  included.
* "anywhere": from the sampled frame on, at most n steps, up to the demonstration's end. Step k of a
  demonstration is then in min(k + 1, n) windows, with every history length equally often: it learns to act on
  short histories everywhere, which is what it meets at inference after the history was cleared.
* "mixed": frames with an even index by the first rule, odd ones by the second.

A demonstration of L frames is therefore seen L times per epoch, long ones more often than short ones.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..calvin import ACTION_NAMES, POSE_UNITS, TCP_POSE, wrap_angle
from ..clip.store import load_embeddings
from .frames import load_frames, load_sentences, paraphrases

if TYPE_CHECKING:
    from .configuration_lansar import LanSARConfig


def action_form(features: dict) -> str:
    """Whether a dataset's `action` is relative ("rel") or absolute ("abs"), told by its names.

    Raises:
        ValueError: The names are neither.
    """
    names = features.get("action", {}).get("names")
    for form, expected in ACTION_NAMES.items():
        if names is not None and tuple(names) == expected:
            return form
    raise ValueError(
        f"The dataset's action is named {names}; LanSAR must know whether it is relative "
        f"{list(ACTION_NAMES['rel'])} or absolute {list(ACTION_NAMES['abs'])}. Datasets made by lansar-convert say so."
    )


def motion_targets(frames: dict[str, np.ndarray], form: str, target: str) -> np.ndarray:
    """What the network should predict at every frame (thesis section 4.2, Eq 4.3-4.5).

    Args:
        frames: From `load_frames`.
        form: "rel" or "abs", what the recorded action is.
        target: "commanded": where the action wants the TCP minus where it is; a relative action is exactly
            that, in units of (0.02 m, 0.05 rad). "achieved": where the TCP is one frame later minus where it
            is; nothing for an episode's last frame, whose row is meaningless.

    Returns:
        (T, 7) float32: position (m), orientation (rad, wrapped to [-pi, pi)), gripper command 0 close / 1
        open.
    """
    pose = frames["state"][:, TCP_POSE].astype(np.float64)
    action = frames["action"].astype(np.float64)
    if target == "achieved":
        delta = np.roll(pose, -1, axis=0) - pose
    elif form == "abs":
        delta = action[:, :6] - pose
    else:
        delta = action[:, :6] * POSE_UNITS
    delta[:, 3:] = wrap_angle(delta[:, 3:])
    return np.concatenate([delta, action[:, 6:] > 0], axis=1).astype(np.float32)


class Windows:
    """Turns sampled frame numbers into batches of padded windows.

    Args:
        root: The LeRobotDataset's folder.
        features: Its features (`dataset.meta.features`).
        total_frames: Frames in the whole dataset.
        config: The policy's options.

    Attributes:
        frames: The arrays of `load_frames`.
        targets: (T, 7) from `motion_targets`.
        has_target: (T,) bool, False for an episode's last frame with achieved targets.
        embeddings: {"static", "gripper"} (total_frames, D), empty without `use_images`.
        clip_info: Clip.json's contents, empty without `use_images`.
        clip: The policy's choice of CLIP.
        asked: The CALVIN tasks that each command asks for; empty unless `paraphrases` or the contrastive loss need
            them.

    Raises:
        ValueError, FileNotFoundError: The dataset cannot be used; the message says why and what to do.
    """

    def __init__(self, root: Path, features: dict, total_frames: int, config: "LanSARConfig") -> None:
        self.length, self.rule = config.window, config.window_start
        form = action_form(features)
        self.frames = load_frames(root)
        self.targets = motion_targets(self.frames, form, config.target)
        rows = np.arange(len(self.targets))
        self.has_target: np.ndarray = np.ones(len(rows), dtype=bool)
        if config.target == "achieved":
            self.has_target = rows < self.frames["end"] - 1
            if (self.frames["end"] - self.frames["first"] < 2).any():
                raise ValueError("--policy.target=achieved needs episodes of at least two frames; one is shorter.")
        self.clip = config.clip
        self.arrays: dict[str, np.ndarray | Tensor] = {
            "state": self.frames["state"],
            "environment_state": self.frames["environment_state"],
            "target": self.targets,
        }
        self.embeddings: dict[str, np.ndarray | Tensor] = {}
        self.clip_info: dict = {}
        if config.use_images:
            embeddings, self.clip_info = load_embeddings(root, total_frames)
            self.embeddings.update(embeddings)
            named = (self.clip_info["model"], self.clip_info["embed_dim"])
            if named != (config.clip.model, config.network.clip_dim):
                raise ValueError(
                    f"The dataset's pictures were embedded with CLIP {named[0]} ({named[1]} numbers), the "
                    f"policy is set to {config.clip.model} ({config.network.clip_dim}). Set "
                    "--policy.clip.model and --policy.clip.pretrained to those of the conversion, or convert "
                    "the dataset again."
                )
        self.paraphrases = config.paraphrases
        self.asked = load_sentences(root) if config.paraphrases or config.contrastive_weight else {}
        self._choices = paraphrases(self.asked)
        known = sorted(set[int]().union(*self.asked.values()))
        self._names = {s: [float(task in tasks) for task in known] for s, tasks in self.asked.items()}
        self.device = torch.device(config.device or "cpu")
        self._move_to_gpu()

    def bounds(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [start, end) of the windows that sampled frames stand for.

        Args:
            index: (B,) absolute frame numbers.

        Raises:
            IndexError: A number the dataset does not have.
        """
        known = self.frames["index"]
        row = np.searchsorted(known, index)
        if (row >= len(known)).any() or (known[np.minimum(row, len(known) - 1)] != index).any():
            raise IndexError("The batch holds a frame index that the dataset's parquet files do not have.")
        first, end = self.frames["first"][row], self.frames["end"][row]
        end = end - ~self.has_target[end - 1]  # a last frame without target is no step of any window
        spare = np.maximum(end - first - self.length, 0)
        spread = first + np.rint((row - first) * spare / np.maximum(end - first - 1, 1)).astype(np.int64)
        spread = np.minimum(spread, first + spare)
        anywhere = np.minimum(row, end - 1)
        mixed = np.where(index % 2 == 0, spread, anywhere)
        start = {"episode": spread, "anywhere": anywhere, "mixed": mixed}[self.rule]
        return start, np.minimum(start + self.length, end)

    def batch(self, index: np.ndarray) -> dict[str, Tensor]:
        """Windows for sampled frames, padded at their end to the longest of this batch (n steps).

        Args:
            index: (B,) absolute frame numbers.

        Returns:
            State (B, n, 15), environment_state (B, n, 24), target (B, n, 7) float32, valid_steps (N,) int64, the
            places of the steps that are no padding among the B * n, and with `use_images` static and gripper
            (B, n, D) float32. Padded steps repeat the window's last step. On a GPU if the frames fit there.
        """
        start, end = self.bounds(index)
        rows = start[:, None] + np.arange((end - start).max())
        valid = np.flatnonzero(rows < end[:, None])
        rows = np.minimum(rows, end[:, None] - 1)
        places = {"rows": rows, "embeddings": self.frames["index"][rows] if self.embeddings else rows}
        if self.on_gpu:
            places = {name: torch.from_numpy(value).to(self.device) for name, value in places.items()}
        out = {name: array[places["rows"]] for name, array in self.arrays.items()}
        out |= {name: array[places["embeddings"]] for name, array in self.embeddings.items()}
        return {name: torch.as_tensor(value).float() for name, value in out.items()} | {
            "valid_steps": torch.from_numpy(valid)
        }

    def say(self, tasks: list[str]) -> list[str]:
        """The commands of a batch, with `paraphrases` in random words (from torch's generator).

        Not where no gradient is asked for: held-out losses are to be compared.
        """
        if not self.paraphrases or not torch.is_grad_enabled():
            return tasks
        choices = [self._choices.get(task, [task]) for task in tasks]
        draws = torch.rand(len(choices)).tolist()
        return [listed[int(draw * len(listed))] for listed, draw in zip(choices, draws, strict=True)]

    def groups(self, tasks: list[str]) -> Tensor | None:
        """(B, tasks) float32, 1 for the CALVIN tasks that each command asks for; None where nothing needs it."""
        if not self.asked:
            return None
        return torch.tensor([self._names[task] for task in tasks])

    def _move_to_gpu(self) -> None:
        """The arrays onto the GPU if they take at most half of what is free there: lookups then cost no transfer."""
        size = sum(array.nbytes for array in (*self.arrays.values(), *self.embeddings.values()))
        self.on_gpu = self.device.type == "cuda" and size <= torch.cuda.mem_get_info(self.device)[0] / 2
        if self.on_gpu:
            for arrays in (self.arrays, self.embeddings):
                for name, array in arrays.items():
                    arrays[name] = torch.tensor(array, device=self.device)


_current: list[Windows] = []


def set_current(windows: Windows) -> None:
    """Called by a policy built for training; the window step made right after it takes them from
    `get_current`.

    LeRobot gives the dataset's folder to the policy only, and rebuilds a checkpoint's pipeline from JSON
    alone.
    """
    _current[:] = [windows]


def get_current() -> Windows | None:
    """The windows of the policy built last for training, None in an evaluation."""
    return _current[0] if _current else None
