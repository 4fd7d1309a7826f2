"""CLIP embeddings of a dataset's pictures, kept in the folder `clip` beside its frames.

That folder holds `<image feature>.npy`, (total_frames, D) float16 in the order of LeRobot's absolute `index`, for
each camera, and `clip.json`: {model, pretrained, weights_sha256, embed_dim, frames, fingerprint, pictures, files}.
"""

import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..calvin import CAMERAS
from ..jobs.staging import write_atomically

IMAGE_FEATURES = {camera: f"observation.images.{camera}" for camera in CAMERAS}
"""Camera to LeRobot's feature with its pictures."""

_DESCRIPTION = "clip.json"
_STATE = "state.json"  # how far an unfinished pass got
PARTIAL = Path(".cache") / "huggingface" / "lansar_clip"
"""A dataset's folder for embeddings that are not complete yet; the hub's client never uploads it."""


def clip_dir(root: Path) -> Path:
    """Where a dataset keeps its CLIP embeddings."""
    return Path(root) / "clip"


def data_files(root: Path) -> list[Path]:
    """The dataset's frame tables, in order.

    Raises:
        FileNotFoundError: There are none.
    """
    files = sorted((Path(root) / "data").rglob("*.parquet"))
    if not files:
        raise FileNotFoundError(f"{Path(root) / 'data'} has no parquet files: not a complete LeRobotDataset v3.")
    return files


def dataset_fingerprint(root: Path) -> str:
    """Identifies the contents of a dataset's frame tables, the same wherever the dataset lies.

    It reads name, size and the last 64 KiB of each parquet file, where parquet keeps row counts, the sizes of all
    column chunks and their minima and maxima. It misses only rewritten frames that leave all of these unchanged.

    Args:
        root: The LeRobotDataset's folder.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for path in data_files(root):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(root).as_posix()} {size}\n".encode())
        with path.open("rb") as file:
            file.seek(max(0, size - 65536))
            digest.update(file.read())
    return digest.hexdigest()


def sha256(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_embeddings(root: Path, total_frames: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The dataset's CLIP embeddings.

    Args:
        root: The LeRobotDataset's folder.
        total_frames: Frames in the whole dataset.

    Returns:
        {"static": (total_frames, D) float16, "gripper": ...} memory-mapped, by absolute index; the contents of
        `clip.json`.

    Raises:
        FileNotFoundError: The dataset has none.
        ValueError: They were made for other frames than the dataset has.
    """
    folder = clip_dir(root)
    needed = [_DESCRIPTION, *(f"{feature}.npy" for feature in IMAGE_FEATURES.values())]
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {', '.join(missing)}: the dataset has no CLIP embeddings of its pictures. "
            "Convert it with `lansar-convert --embed=true`, or train without pictures: --policy.use_images=false. "
            "(With --dataset.episodes LeRobot downloads only a part from the hub: download the whole dataset.)"
        )
    info = json.loads((folder / _DESCRIPTION).read_text())
    arrays = {camera: np.load(folder / f"{feature}.npy", mmap_mode="r") for camera, feature in IMAGE_FEATURES.items()}
    shape = (total_frames, info["embed_dim"])
    shapes = {array.shape for array in arrays.values()}
    if shapes != {shape} or info["fingerprint"] != dataset_fingerprint(root):
        raise ValueError(
            f"The CLIP embeddings in {folder} were made for other frames than the dataset now has "
            f"(arrays {shapes}, expected {shape}, or another fingerprint). "
            "Delete that folder and convert again with `lansar-convert --embed=true`; if the dataset came from "
            "the hub with --dataset.episodes, download all of it."
        )
    return arrays, info


class EmbeddingWriter:
    """Writes a dataset's embeddings. Their folder appears only when complete; an interrupted pass can be resumed.

    Args:
        root: The dataset's folder.
        description: The contents of `clip.json` without `files`.

    Attributes:
        finished: The folder exists already, with these embeddings.
        done: How many pictures per camera are embedded; more than 0 at the start of a resumed pass.

    Raises:
        ValueError: The folder exists with embeddings of another CLIP or of other frames.
    """

    def __init__(self, root: Path, description: dict[str, Any]):
        self.folder = clip_dir(root)
        self._partial = root / PARTIAL
        self._description = description
        self.finished, self.done = self.folder.exists(), 0
        if self.finished:
            self._check_same()
            (self.folder / _STATE).unlink(missing_ok=True)  # left over if `finish` was killed before its last line
            return
        self._begin()
        self._arrays = {
            feature: np.load(self._partial / f"{feature}.npy", mmap_mode="r+") for feature in IMAGE_FEATURES.values()
        }

    def add(self, rows: list[np.ndarray], embeddings: dict[str, np.ndarray]) -> None:
        """Adds the embeddings of the next n pictures of each camera.

        Args:
            rows: For each picture, the dataset's rows that show it.
            embeddings: Image feature to (n, D).
        """
        repeats = [len(picture_rows) for picture_rows in rows]
        for feature, array in self._arrays.items():
            array[np.concatenate(rows)] = np.repeat(embeddings[feature].astype(np.float16), repeats, axis=0)
        self.done += len(rows)

    def save(self) -> None:
        """Saves the progress: a pass with the same description resumes from here."""
        for array in self._arrays.values():
            array.flush()
        state = {"description": self._description, "done": self.done}
        write_atomically(self._partial / _STATE, json.dumps(state))

    def finish(self) -> None:
        """Moves the complete folder to its place."""
        self.save()
        self._arrays.clear()
        files = {f"{feature}.npy": sha256(self._partial / f"{feature}.npy") for feature in IMAGE_FEATURES.values()}
        (self._partial / _DESCRIPTION).write_text(json.dumps({**self._description, "files": files}, indent=2) + "\n")
        self._partial.rename(self.folder)
        # Only now: if the rename fails, the next pass needs this file to resume.
        (self.folder / _STATE).unlink()

    def _check_same(self) -> None:
        file = self.folder / _DESCRIPTION
        found = json.loads(file.read_text()) if file.is_file() else {}
        for name, what in (("weights_sha256", "another CLIP"), ("fingerprint", "other frames")):
            if found.get(name) != self._description[name]:
                wanted = f"{self._description['model']} {self._description['pretrained']}"
                raise ValueError(
                    f"{self.folder} holds embeddings of {what} ({found.get('model')} {found.get('pretrained')}): "
                    f"delete that folder to make those of {wanted}"
                )
        print(f"{self.folder} already holds these embeddings", file=sys.stderr)

    def _begin(self) -> None:
        """Resumes an earlier pass with the same description, or else starts over."""
        state = self._partial / _STATE
        if state.is_file():
            saved = json.loads(state.read_text())
            if saved["description"] == self._description:
                self.done = saved["done"]
                return
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        shape = (self._description["frames"], self._description["embed_dim"])
        for feature in IMAGE_FEATURES.values():
            np.lib.format.open_memmap(self._partial / f"{feature}.npy", "w+", np.float16, shape)
