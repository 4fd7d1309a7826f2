"""Finds frames of training that are in validation too, by their contents: states first, then pictures.

Numbers do not decide: on ABC->D training's begin anew at 0 while validation keeps D's, so equal numbers are different
frames there. Two frames with the same 39 numbers of robot and scene show the same moment of one recording; pictures,
where both have them, must be equal too.

All of validation's states are read, 0.12 ms a frame from a warm disk. With `--exclude_shared`, which must know in
advance, so are those of every training frame to be converted. Otherwise only the likely ones are (equal numbers and the
ends of recordings), for an early report; the others are compared while they are converted, when they are read anyway.
"""

import hashlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dataset_convert.calvin import CalvinSplit
from dataset_convert.frames import RGB, STATES, frame_file, frame_numbers, read_frame
from dataset_convert.look import read_look
from lerobot_lansar.jobs.pool import in_processes

_CHUNK = 2000
"""Frames that a process reads at a time."""


@dataclass(frozen=True)
class ValidationStates:
    """What is needed to recognise validation's frames.

    Attributes:
        folder: The validation split.
        keys: (n,) uint64 hashes of its frames' states, sorted.
        frames: (n,) the frames' numbers.
        image_size: Width and height of its pictures; 0: the cameras' own.
    """

    folder: Path
    keys: np.ndarray
    frames: np.ndarray
    image_size: int

    @classmethod
    def read(cls, folder: Path, workers: int) -> "ValidationStates | None":
        """Reads a split's states, with that many processes; None if there is no such split."""
        frames = frame_numbers(folder) if folder.is_dir() else np.zeros(0, np.int64)
        if not len(frames):
            return None
        keys, readable = _read_keys(folder, frames, workers, "validation's states")
        order = np.argsort(keys[readable], kind="stable")
        return cls(folder, keys[readable][order], frames[readable][order], read_look(folder).image_size)

    def among(self, training: Path, frames: np.ndarray, keys: np.ndarray) -> list[int]:
        """Which frames of training are in validation too.

        Args:
            training: The training split's folder.
            frames: (n,) numbers of its frames.
            keys: (n,) hashes of their states, by `key_of`.
        """
        first, end = (np.searchsorted(self.keys, keys, side) for side in ("left", "right"))
        found = []
        for row in np.flatnonzero(end > first):
            mine = frame_file(training, int(frames[row]))
            theirs = (frame_file(self.folder, int(frame)) for frame in self.frames[first[row] : end[row]])
            if any(_same_pictures(mine, other, self.image_size) for other in theirs):
                found.append(int(frames[row]))
        return found


def key_of(robot_obs: np.ndarray, scene_obs: np.ndarray) -> int:
    """A 64-bit hash of a frame's state, whatever the floating dtype that it is stored in."""
    state = np.concatenate([robot_obs, scene_obs]).astype("<f8")
    return int.from_bytes(hashlib.blake2b(state.tobytes(), digest_size=8).digest(), "little")


def find_shared(
    split: CalvinSplit, validation: ValidationStates, planned: np.ndarray | None, workers: int
) -> list[int]:
    """Frames of training that are in validation too, sorted.

    Args:
        split: Training.
        validation: Validation's states.
        planned: Frames to be converted, all of which are compared; None: only the likely ones are.
        workers: Processes that read.
    """
    likely = np.concatenate([np.intersect1d(split.frames(), validation.frames), split.recordings.reshape(-1)])
    candidates = np.unique(likely if planned is None else np.concatenate([likely, planned]))
    keys, readable = _read_keys(split.folder, candidates, workers, "training's states")
    return validation.among(split.folder, candidates[readable], keys[readable])


def _read_keys(folder: Path, frames: np.ndarray, workers: int, desc: str) -> tuple[np.ndarray, np.ndarray]:
    """Hashes of some frames' states, (n,) uint64, and which of them can be read, (n,) bool.

    Those that are missing or defective are reported when they are converted.
    """
    chunks = np.array_split(frames, max(1, -(-len(frames) // _CHUNK)))
    work = partial(_keys_of_chunk, folder)
    keys: list[int | None] = []
    with tqdm(total=len(frames), desc=f"comparing {desc}", unit="frame", leave=False, disable=len(chunks) == 1) as bar:
        for chunk in in_processes(work, chunks, min(workers, len(chunks)), ordered=True):
            keys += chunk
            bar.update(len(chunk))
    readable = np.array([key is not None for key in keys], dtype=bool)
    return np.array([key or 0 for key in keys], dtype=np.uint64), readable


def _keys_of_chunk(folder: Path, frames: np.ndarray) -> list[int | None]:
    keys: list[int | None] = []
    for frame in frames.tolist():
        try:
            keys.append(key_of(**read_frame(frame_file(folder, frame), STATES)))
        except (FileNotFoundError, ValueError):
            keys.append(None)
    return keys


def _same_pictures(mine: Path, theirs: Path, image_size: int) -> bool:
    """Whether two frames have no picture that differs; pictures of another size say nothing."""
    for array in RGB:
        try:
            a, b = (read_frame(path, [array], image_size)[array] for path in (mine, theirs))
        except (FileNotFoundError, ValueError):
            continue  # recorded without this camera, or at another size
        if not np.array_equal(a, b):
            return False
    return True
