"""Reading one split of a CALVIN dataset from disk: the language index, the scenes and the frames.

Layout of a split (`training/` or `validation/`), of the public data and of `lansar-record` alike::

    episode_0000000.npz ...            one file per frame
    ep_start_end_ids.npy               (N, 2) first and last frame of each uninterrupted recording
    scene_info.npy                     pickled {scene name: [first frame, last frame]}
    lang_annotations/auto_lang_ann.npy pickled {"language": {"ann", "task"}, "info": {"indx"}}

A language window is `[start, end)`: its end is exclusive. Recordings and scenes include their last frame.
"""

import errno
import hashlib
import os
import reprlib
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset_convert.safe_pickle import load_object_array, parse_npy, read_index_file
from lerobot_lansar.calvin import CAMERAS

VECTORS = {"robot_obs": (15,), "scene_obs": (24,), "actions": (7,), "rel_actions": (7,)}
"""Shapes of the float vectors stored in every frame file."""

RGB = {f"rgb_{camera}": (size, size, 3) for camera, size in CAMERAS.items()}
"""Shapes of the uint8 pictures stored in a frame file, unless it was recorded without cameras."""

DEPTH = {f"depth_{camera}": (size, size) for camera, size in CAMERAS.items()}
"""Shapes of the floating-point distances (m) of both cameras, in public data."""

TACTILE = {"rgb_tactile": (160, 120, 6), "depth_tactile": (160, 120, 2)}
"""Shapes of the pictures of the two fingertip sensors side by side: uint8 colours, floating-point depth."""

_SHAPES = VECTORS | RGB | DEPTH | TACTILE

_MAX_BYTES = 1 << 20
"""Limit for one array; the largest of a frame takes less than half of it."""

_SAFE_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods of which zipfile unpacks no more than it is asked for; numpy uses no others."""

_REPAIR = "download or record it again"
_NO_PICTURES = "recorded without cameras? then use --images=none and no --embed"
_NO_EXTRA = "not recorded? then leave out --depth and --tactile"


@dataclass(frozen=True)
class Window:
    """One annotated demonstration: frames `start` to `end - 1` of the split.

    Attributes:
        start: First frame number.
        end: First frame number after the window: exclusive in CALVIN, which is easy to get wrong.
        task: Task name, such as `open_drawer`.
        sentence: The command in words.
        scene: The scene's letter, such as `D`.
    """

    start: int
    end: int
    task: str
    sentence: str
    scene: str

    def __len__(self) -> int:
        return self.end - self.start


class CalvinSplit:
    """The index of one split, read and checked once; frames are read on demand.

    Attributes:
        root: The dataset's folder.
        name: The split's name.
        folder: The split's folder.
        scenes: Scene letter to its (first, last) frame, both inclusive.
        windows: The annotated windows in the file's order.
        recordings: (N, 2) first and last frame of each uninterrupted recording, in order.
        source_sha256: Hash of the index files, which identifies what was converted.

    Raises:
        FileNotFoundError: The folder or one of its index files is missing.
        ValueError: An index file is malformed, or a window lies outside every scene or recording.
    """

    def __init__(self, root: Path, split: str):
        self.root, self.name = root, split
        self.folder = root / split
        if not self.folder.is_dir():
            found = sorted(p.parent.name for p in root.glob("*/lang_annotations"))
            raise FileNotFoundError(
                f"{self.folder} is not a folder: --root must hold --split={split}"
                + (f" (splits found: {', '.join(found)})" if found else " with CALVIN's files")
            )
        index = self.folder / "lang_annotations" / "auto_lang_ann.npy"
        scenes = self.folder / "scene_info.npy"
        recordings = self.folder / "ep_start_end_ids.npy"
        self.scenes = _read_scenes(scenes)
        self.windows = _read_windows(index, self.scenes)
        self.recordings = _read_recordings(recordings)
        _check_inside_recordings(self.windows, self.recordings, index)
        digest = hashlib.sha256()
        for path in (index, scenes, recordings):
            digest.update(path.read_bytes())
        self.source_sha256 = digest.hexdigest()

    def frame_file(self, frame: int) -> Path:
        """The file of one frame, whether or not it exists."""
        return self.folder / f"episode_{frame:07d}.npz"

    def frames(self) -> np.ndarray:
        """The numbers of all frame files there are, sorted, (n,) int64."""
        return frame_numbers(self.folder)

    def read(self, frames: Iterable[int], keys: Iterable[str]) -> dict[str, np.ndarray]:
        """Reads some arrays of some frames.

        Args:
            frames: n frame numbers.
            keys: Names out of `VECTORS`, `RGB`, `DEPTH` and `TACTILE`.

        Returns:
            For each key an array of shape (n, ...) in the file's floating dtype, or uint8 for colours.

        Raises:
            FileNotFoundError: A frame's file is missing.
            OSError: The machine cannot read a file, which need not be defective.
            ValueError: A file is truncated, or an array in it is missing or has a wrong shape or dtype; the
                message names the file and the key.
        """
        columns: dict[str, list[np.ndarray]] = {key: [] for key in keys}
        for frame in frames:
            path = self.frame_file(frame)
            for key, array in _load(path, columns).items():
                columns[key].append(_checked(array, key, path))
        return {key: np.stack(column) for key, column in columns.items()}


def digest(arrays: dict[str, np.ndarray], so_far: Any = None) -> Any:
    """SHA-256 of some frames' arrays, continued from the frames before.

    Args:
        arrays: What `CalvinSplit.read` returned.
        so_far: What this returned for the frames before.
    """
    so_far = so_far or hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        so_far.update(f"{key} {array.dtype.str} {array.shape}".encode())
        so_far.update(array)
    return so_far


def frame_numbers(folder: Path) -> np.ndarray:
    """The numbers of the frame files in a split's folder, sorted, (n,) int64."""
    names = (entry.name for entry in os.scandir(folder))
    numbers = [name[8:-4] for name in names if name.startswith("episode_") and name.endswith(".npz")]
    return np.sort(np.array([number for number in numbers if number.isdecimal()], dtype=np.int64))


def _load(path: Path, keys: Iterable[str]) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(path) as stored:
            members = stored.NameToInfo
            missing = [key for key in keys if f"{key}.npy" not in members]
            if not missing:
                return {key: parse_npy(_read_member(stored, members[f"{key}.npy"])) for key in keys}
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: the split is incomplete, {_REPAIR}") from error
    except MemoryError:
        raise  # the machine's fault: no more than _MAX_BYTES are read, whatever the file says
    except Exception as error:  # damaged bytes make zipfile and numpy raise nearly anything
        fault = error.__context__ if isinstance(error, zipfile.BadZipFile) else error  # zipfile hides some OSErrors
        if isinstance(fault, OSError) and fault.errno != errno.EINVAL:  # a damaged offset gives EINVAL
            raise OSError(fault.errno, fault.strerror, str(path)) from error
        raise ValueError(f"{path}: truncated or not an npz file ({error!r}); {_REPAIR}") from error
    remedy = _NO_PICTURES if missing[0] in RGB else _REPAIR if missing[0] in VECTORS else _NO_EXTRA
    raise ValueError(f"{path}: array {missing[0]!r} is missing; {remedy}")


def _read_member(stored: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Reads no more than an array takes, even if the file claims or would unpack to more."""
    if member.file_size > _MAX_BYTES:
        raise ValueError(f"{member.filename} has {member.file_size} bytes, more than any array of a frame")
    if member.compress_type not in _SAFE_COMPRESSION:
        raise ValueError(f"{member.filename} is compressed by method {member.compress_type}, which numpy does not use")
    with stored.open(member) as file:
        return file.read(member.file_size)


def _checked(array: np.ndarray, key: str, path: Path) -> np.ndarray:
    shape, is_color = _SHAPES[key], key.startswith("rgb_")
    is_right_kind = array.dtype == np.uint8 if is_color else array.dtype.kind == "f"
    if array.shape != shape or not is_right_kind:
        wanted = f"{'uint8' if is_color else 'float'} {shape}"
        raise ValueError(f"{path}: array {key!r} is {array.dtype} {array.shape}, expected {wanted}")
    return array


def _read_scenes(path: Path) -> dict[str, tuple[int, int]]:
    stored = load_object_array(path)
    scenes: dict[str, tuple[int, int]] = {}
    try:
        for name, (first, last) in stored.items():
            scenes[str(name).rpartition("_")[2]] = (int(first), int(last))
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        wanted = "{scene name: [first frame, last frame]}"
        raise ValueError(f"{path}: expected {wanted}, found {reprlib.repr(stored)}") from error
    if not scenes:
        raise ValueError(f"{path} names no scene")
    return scenes


def _read_recordings(path: Path) -> np.ndarray:
    content = read_index_file(path)
    try:
        recordings = parse_npy(content).reshape(-1, 2)
        if recordings.dtype.kind not in "iu":
            raise ValueError(f"found {recordings.dtype}")
    except Exception as error:  # damaged bytes make numpy's header parser raise nearly anything
        raise ValueError(f"{path}: expected (N, 2) first and last frame numbers ({error!r})") from error
    return recordings[np.argsort(recordings[:, 0])].astype(np.int64)


def _read_windows(path: Path, scenes: dict[str, tuple[int, int]]) -> list[Window]:
    stored = load_object_array(path)
    try:
        spans = [(int(start), int(end)) for start, end in stored["info"]["indx"]]
        sentences, tasks = (_strings(stored["language"][key]) for key in ("ann", "task"))
        if not len(spans) == len(sentences) == len(tasks):
            raise ValueError(f"{len(spans)} windows, {len(sentences)} sentences, {len(tasks)} tasks")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        wanted = "language.ann, language.task and info.indx of one length"
        raise ValueError(f"{path}: expected {wanted} ({error})") from error
    if not spans:
        raise ValueError(f"{path}: holds no annotated window")
    windows = []
    for (start, end), task, sentence in zip(spans, tasks, sentences, strict=True):
        if end <= start:
            raise ValueError(f"{path}: window [{start}, {end}) of {task!r} is empty")
        letters = [letter for letter, (first, last) in scenes.items() if first <= start and end - 1 <= last]
        if not letters:
            raise ValueError(
                f"{path}: window [{start}, {end}) lies in no scene of scene_info.npy {scenes}; public "
                "downloads before 2023-02-24 hold a wrong scene_info.npy: replace it"
            )
        windows.append(Window(start, end, task, sentence, letters[0]))
    return windows


def _strings(stored: Iterable[Any]) -> list[str]:
    if not all(isinstance(item, str) for item in stored):
        raise TypeError("a command or a task is not a string")
    return [str(item) for item in stored]


def _check_inside_recordings(windows: list[Window], recordings: np.ndarray, index: Path) -> None:
    """A window across two recordings would join frames that are not 1/30 s apart."""
    at = np.searchsorted(recordings[:, 0], [window.start for window in windows], side="right") - 1
    for window, row in zip(windows, at, strict=True):
        if row < 0 or window.end - 1 > recordings[row, 1]:
            span = f"[{window.start}, {window.end})"
            raise ValueError(f"{index}: window {span} is not inside one recording of ep_start_end_ids.npy")
