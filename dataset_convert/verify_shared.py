"""Compares training with validation again: what `lansar-verify` knows of frames that are in both.

The converter's own search is not used on purpose: it would hide its own errors.
"""

import hashlib
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dataset_convert.frames import RGB, STATES, frame_file, frame_numbers, read_frame


class ValidationFrames:
    """The frames of a validation split, by their states.

    Args:
        root: The dataset's folder.
    """

    def __init__(self, root: Path):
        self.folder = root / "validation"
        self._frames: dict[bytes, list[int]] = {}
        numbers = frame_numbers(self.folder).tolist() if self.folder.is_dir() else []
        for number in tqdm(numbers, desc="reading validation", unit="frame", leave=False, disable=len(numbers) < 5000):
            try:
                states = read_frame(frame_file(self.folder, number), STATES)
            except (FileNotFoundError, ValueError):
                continue  # it cannot be compared
            self._frames.setdefault(_digest(states), []).append(number)

    def __len__(self) -> int:
        return len(self._frames)

    def hold(self, file: Path, states: dict[str, np.ndarray] | None = None) -> bool:
        """Whether a frame of training is in validation too.

        Args:
            file: Its file.
            states: Its `robot_obs` and `scene_obs`, if they were read already.

        Raises:
            FileNotFoundError, ValueError: It cannot be read.
        """
        states = states or read_frame(file, STATES)
        others = self._frames.get(_digest(states), [])
        return any(_pictures_agree(file, frame_file(self.folder, number)) for number in others)


def _digest(states: dict[str, np.ndarray]) -> bytes:
    """16 bytes that identify a state."""
    numbers = np.hstack([states[key].astype(np.float64) for key in STATES])
    return hashlib.md5(numbers.tobytes(), usedforsecurity=False).digest()


def _pictures_agree(one: Path, other: Path) -> bool:
    """Whether two frames have no picture that differs; pictures of different sizes say nothing."""
    with np.load(one) as a, np.load(other) as b:
        pairs = [(a[key], b[key]) for key in RGB if key in a.files and key in b.files]
    return all(np.array_equal(mine, theirs) for mine, theirs in pairs if mine.shape == theirs.shape)
