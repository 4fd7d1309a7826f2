"""Training windows: which steps of which demonstration a sampled frame stands for, and what is to be predicted there.

LeRobot samples every frame of every episode once per epoch, in random order. Here each sampled frame stands for a
window of at most n = `window` steps. A fixed rule says which, so that a resumed run sees the same windows and
validation losses are comparable:

* "episode": the demonstration from its start (thesis). If it is longer than n, frame j stands for the window that
  starts at j * (L - n + 1) / L, rounded down: every start occurs equally often, give or take one frame.
* "anywhere": at most n steps from the sampled frame, up to the demonstration's end. Step k of a demonstration is then
  in min(k + 1, n) windows, once with each history length, so the network learns to act on short histories
  everywhere: that is its situation at inference after the history was cleared.
* "mixed": frames with an even index by the first rule, those with an odd index by the second.

Where a dataset says who acted (`lansar-record --mode=takeovers`), only the demonstrator's frames count in the loss, and
the policy's before them are history. Such an episode is then treated as if it began n - 1 frames before the
demonstrator's first frame and ended with its last one, so that windows hold a frame that counts.

A demonstration of L frames is thus seen L times per epoch, long ones more often than short ones.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..calvin import ACTION_NAMES, POSE_UNITS, TCP_POSE, wrap_angle
from ..clip.model import ImageEncoder
from ..clip.store import load_embeddings
from .configuration_lansar import LanSARConfig
from .frames import find_paraphrases, load_frames, load_pictures, load_sentence_tasks
from .scaling import ENVIRONMENT_STATE_DIM


def action_form(features: dict) -> str:
    """Whether a dataset's `action` is relative ("rel") or absolute ("abs"), as its names say.

    Raises:
        ValueError: The names are neither.
    """
    names = features.get("action", {}).get("names")
    for form, expected in ACTION_NAMES.items():
        if names is not None and tuple(names) == expected:
            return form
    raise ValueError(
        f"The dataset's action has the names {names}; LanSAR expects relative actions, {list(ACTION_NAMES['rel'])}, or "
        f"absolute ones, {list(ACTION_NAMES['abs'])}, as lansar-convert names them."
    )


def make_targets(frames: dict[str, np.ndarray], form: str, target: str) -> np.ndarray:
    """What the network should predict at every frame (thesis section 4.2, Eq 4.3-4.5).

    Args:
        frames: From `load_frames`.
        form: "rel" or "abs", the recorded action's form.
        target: "commanded": the pose that the action commands minus the current pose; a relative action is this
            difference already, in units of (0.02 m, 0.05 rad). "achieved": the pose one frame later minus the current
            pose; meaningless in an episode's last frame.

    Returns:
        (T, 7) float32: position (m), orientation (rad, wrapped to [-pi, pi)), gripper command 0 close / 1 open.
    """
    pose = frames["state"][:, TCP_POSE].astype(np.float64)
    action = frames["action"].astype(np.float64)
    if target == "achieved":
        delta = np.roll(pose, -1, axis=0) - pose
    elif form == "abs":
        delta = action[:, TCP_POSE] - pose
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
        images: The image encoder that is trained too; None: the pictures' stored embeddings are read.

    Attributes:
        frames: The arrays of `load_frames`.
        targets: (T, 7) from `make_targets`.
        has_target: (T,) bool, False for an episode's last frame with achieved targets.
        counts: (T,) float32, 1 where the demonstrator acted and 0 elsewhere; None where it always did.
        embeddings: {"static", "gripper"}: (total_frames, D), empty without `use_images` and with `finetune_clip`.
        pictures: {"static", "gripper"}: (total_frames, H, W, 3) uint8, empty without `finetune_clip`.
        clip_info: The contents of clip.json, empty without `embeddings`.
        sentence_tasks: The CALVIN tasks that each sentence can mean; empty unless `paraphrases` or the contrastive
            loss need them.

    Raises:
        ValueError, FileNotFoundError: The dataset cannot be used; the message says why and what to do.
    """

    def __init__(
        self,
        root: Path,
        features: dict,
        total_frames: int,
        config: LanSARConfig,
        images: ImageEncoder | None = None,
    ) -> None:
        self.length, self.rule = config.window, config.window_start
        self.pad_fully = config.compile_model
        form = action_form(features)
        self.frames = load_frames(root)
        self.targets = make_targets(self.frames, form, config.target)
        self.has_target: np.ndarray = np.ones(len(self.targets), dtype=bool)
        if config.target == "achieved":
            self.has_target = np.arange(len(self.targets)) < self.frames["end"] - 1
            if (self.frames["end"] - self.frames["first"] < 2).any():
                raise ValueError("--policy.target=achieved needs episodes of at least two frames; one is shorter.")
        demonstrated = self.frames.get("is_intervention", np.ones(len(self.targets), bool))
        self.counts: np.ndarray | None = None if demonstrated.all() else demonstrated.astype(np.float32)
        self._crop_episodes()
        self.arrays: dict[str, np.ndarray | Tensor] = {
            "state": self.frames["state"],
            "target": self.targets,
        }
        if config.use_spatial_context:
            if "environment_state" not in self.frames:
                raise ValueError(
                    f"{root} lacks the scene's state, observation.environment_state with {ENVIRONMENT_STATE_DIM} "
                    "numbers, which the policy reads: convert again without --scene_state=false and "
                    "--task_in_state=true, or train a policy with --policy.use_spatial_context=false"
                )
            self.arrays["environment_state"] = self.frames["environment_state"]
        self.since_command = config.since_command
        if self.counts is not None:
            self.arrays["counts"] = self.counts
        self.embeddings: dict[str, np.ndarray | Tensor] = {}
        self.clip_info: dict = {}
        self.pictures: dict[str, np.ndarray | Tensor] = {}
        if images is not None:
            self.pictures.update(load_pictures(root, images.size[0], images.resize))
        elif config.use_images:
            self._load_embeddings(root, total_frames, config)
        self.paraphrases = config.paraphrases
        self.contrasts = config.contrastive_weight > 0
        self.sentence_tasks = load_sentence_tasks(root) if self.paraphrases or self.contrasts else {}
        self._paraphrases_of = find_paraphrases(self.sentence_tasks)
        known = sorted(set[int]().union(*self.sentence_tasks.values()))
        self._task_rows = {s: [float(task in tasks) for task in known] for s, tasks in self.sentence_tasks.items()}
        self.device = torch.device(config.device or "cpu")
        self.on_gpu = self._move_to_gpu(self.arrays, self.embeddings)
        self.pictures_on_gpu = self._move_to_gpu(self.pictures)

    @property
    def is_demonstrated(self) -> np.ndarray:
        """Whether the demonstrator acted in each frame, (T,) bool."""
        return np.ones(len(self.targets), bool) if self.counts is None else self.counts > 0

    def _crop_episodes(self) -> None:
        """Sets where each frame's episode begins and ends as far as windows are concerned, see above.

        Raises:
            ValueError: The demonstrator acted in no frame.
        """
        first, end = self.frames["first"], self.frames["end"]
        end = end - ~self.has_target[end - 1]
        self._first, self._end, self._lengths = first, end, end - first
        if self.counts is None:
            return
        rows = np.flatnonzero((self.counts > 0) & self.has_target)
        if not len(rows):
            raise ValueError("The demonstrator acted in no frame of the dataset: there is nothing to learn from.")
        before, after = np.searchsorted(rows, first), np.searchsorted(rows, end) - 1
        acted = before <= after  # in this episode
        earliest = np.maximum(rows[np.minimum(before, len(rows) - 1)] - self.length + 1, first)
        self._first = np.where(acted, earliest, self._first)
        self._end = np.where(acted, rows[after] + 1, self._end)

    def _load_embeddings(self, root: Path, total_frames: int, config: LanSARConfig) -> None:
        embeddings, self.clip_info = load_embeddings(root, total_frames)
        self.embeddings.update(embeddings)
        model, size = self.clip_info["model"], self.clip_info["embed_dim"]
        if (model, size) != (config.clip.model, config.network.clip_dim):
            raise ValueError(
                f"The dataset's pictures were embedded with CLIP {model} ({size} numbers), the policy is set to "
                f"{config.clip.model} ({config.network.clip_dim}). Set --policy.clip.model and "
                "--policy.clip.pretrained to those of the conversion, or convert the dataset again."
            )

    def bounds(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [start, end) of the windows that sampled frames stand for.

        Args:
            index: (B,) absolute frame numbers.

        Raises:
            IndexError: The dataset has no frame of such a number.
        """
        known = self.frames["index"]
        row = np.searchsorted(known, index)
        if (row >= len(known)).any() or (known[np.minimum(row, len(known) - 1)] != index).any():
            raise IndexError("The batch holds a frame index that the dataset's parquet files do not have.")
        first, end = self._first[row], self._end[row]  # a last frame without target belongs to no window
        place = row - self.frames["first"][row]
        row = first + place * (end - first) // self._lengths[row]  # the same row, unless its episode was cropped
        anywhere = np.minimum(row, end - 1)
        spare = np.maximum(end - first - self.length, 0)
        spread = first + (anywhere - first) * (spare + 1) // (end - first)
        mixed = np.where(index % 2 == 0, spread, anywhere)
        start = {"episode": spread, "anywhere": anywhere, "mixed": mixed}[self.rule]
        return start, np.minimum(start + self.length, end)

    def batch(self, index: np.ndarray) -> dict[str, Tensor]:
        """Windows for sampled frames, padded at their end to n steps: the longest of this batch, or the longest there
        can be with `compile_model`.

        Args:
            index: (B,) absolute frame numbers.

        Returns:
            State (B, n, 15), target (B, n, 7), with `use_spatial_context` environment_state (B, n, 24) and, with
            `use_images`, static and gripper (B, n, D), all float32; with `finetune_clip` static and gripper are instead
            the pictures of the steps that are not padding, (N, H, W, 3) uint8; with `since_command` start (B, 1, 24),
            the environment state when the command began; counts (B, n) float32, 1 where the demonstrator acted, unless
            it always did; valid_steps (N,) int64, which of the B * n steps are not padding. Padding repeats the
            window's last step. On the GPU if the frames fit there.
        """
        start, end = self.bounds(index)
        longest = self.length if self.pad_fully else (end - start).max()
        rows = start[:, None] + np.arange(longest)  # (B, n)
        valid_steps = np.flatnonzero(rows < end[:, None])
        rows = np.minimum(rows, end[:, None] - 1)
        frame_rows, embedding_rows = rows, self.frames["index"][rows] if self.embeddings else rows
        picture_rows = self.frames["index"][rows.flat[valid_steps]] if self.pictures else valid_steps
        if self.on_gpu:
            frame_rows, embedding_rows = (torch.from_numpy(r).to(self.device) for r in (frame_rows, embedding_rows))
        if self.pictures_on_gpu:
            picture_rows = torch.from_numpy(picture_rows).to(self.device)
        found = {name: array[frame_rows] for name, array in self.arrays.items()}
        found |= {name: array[embedding_rows] for name, array in self.embeddings.items()}
        if self.since_command:
            found["start"] = self.arrays["environment_state"][self.frames["first"][start][:, None]]
        window = {name: torch.as_tensor(values).float() for name, values in found.items()}
        window |= {name: torch.as_tensor(array[picture_rows]) for name, array in self.pictures.items()}
        return window | {"valid_steps": torch.from_numpy(valid_steps)}

    def paraphrase(self, commands: list[str]) -> list[str]:
        """The commands of a batch, with `paraphrases` each in random words (drawn from torch's generator).

        Skipped under no_grad, so held-out losses stay comparable.
        """
        if not self.paraphrases or not torch.is_grad_enabled():
            return commands
        choices = [self._paraphrases_of.get(command, [command]) for command in commands]
        draws = torch.rand(len(choices)).tolist()
        return [sentences[int(draw * len(sentences))] for sentences, draw in zip(choices, draws, strict=True)]

    def command_tasks(self, commands: list[str]) -> Tensor | None:
        """(B, tasks) float32, 1 for the CALVIN tasks that each command can mean; None without the contrastive loss."""
        if not self.contrasts:
            return None
        return torch.tensor([self._task_rows[command] for command in commands])

    def _move_to_gpu(self, *groups: dict[str, np.ndarray | Tensor]) -> bool:
        """Moves arrays to the GPU if they take at most half of its free memory: lookups then need no transfer."""
        size = sum(array.nbytes for arrays in groups for array in arrays.values())
        fits = self.device.type == "cuda" and size <= torch.cuda.mem_get_info(self.device)[0] / 2
        if fits:
            for arrays in groups:
                for name, array in arrays.items():
                    arrays[name] = torch.tensor(array, device=self.device)
        return fits


_current: list[Windows] = []


def set_current(windows: Windows) -> None:
    """Makes `windows` those of the next `WindowStep`; called by a policy built for training.

    LeRobot tells only the policy where the dataset is, and rebuilds a checkpoint's pipeline from JSON alone.
    """
    _current[:] = [windows]


def get_current() -> Windows | None:
    """The windows of the policy that was last built for training; None in an evaluation."""
    return _current[0] if _current else None
