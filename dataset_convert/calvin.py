"""Reading one split of a CALVIN dataset from disk: the language index, the scenes and the frames.

Layout of a split (``training/`` or ``validation/``), of the public data and of ``lansar-record`` alike::

    episode_0000000.npz ...            one file per frame
    ep_start_end_ids.npy               (N, 2) first and last frame of each uninterrupted recording
    scene_info.npy                     pickled {scene name: [first frame, last frame]}
    lang_annotations/auto_lang_ann.npy pickled {"language": {"ann", "task"}, "info": {"indx"}}

A language window is ``[start, end)``: its end is exclusive. Recordings and scenes include their last frame.
"""

import hashlib
import io
import os
import pickle
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

FPS = 30
"""CALVIN's control and recording frequency in Hz."""

COLOURS = ("red", "blue", "pink")
"""The order in which every dataset written here stores the blocks."""

SCENES = ("A", "B", "C", "D")

TASKS = (
    *(f"rotate_{colour}_block_{side}" for colour in COLOURS for side in ("right", "left")),
    *(f"push_{colour}_block_{side}" for colour in COLOURS for side in ("right", "left")),
    *("move_slider_left", "move_slider_right", "open_drawer", "close_drawer"),
    *(f"lift_{colour}_block_{place}" for colour in COLOURS for place in ("table", "slider", "drawer")),
    *("place_in_slider", "place_in_drawer", "stack_block", "unstack_block"),
    *("turn_on_lightbulb", "turn_off_lightbulb", "turn_on_led", "turn_off_led", "push_into_drawer"),
)
"""CALVIN's 34 tasks; a task's number in a dataset is its place here."""

VECTORS = {"robot_obs": (15,), "scene_obs": (24,), "actions": (7,), "rel_actions": (7,)}
"""Shapes of the float vectors stored in every frame file."""

CAMERAS = {"rgb_static": (200, 200, 3), "rgb_gripper": (84, 84, 3)}
"""Shapes of the uint8 pictures stored in a frame file, unless it was recorded without cameras."""

DEPTH = {"depth_static": (200, 200), "depth_gripper": (84, 84)}
"""Shapes of the floating-point distances (m) of both cameras, in public data."""

TACTILE = {"rgb_tactile": (160, 120, 6), "depth_tactile": (160, 120, 2)}
"""Shapes of the pictures of the two fingertip sensors side by side: uint8 colours, floating-point depth."""

_SHAPES = VECTORS | CAMERAS | DEPTH | TACTILE

_REPAIR = "download or record it again"
_NO_PICTURES = "recorded without cameras? then use --images=none and no --embed"
_NO_EXTRA = "not recorded? then leave out --depth and --tactile"


def _encode_latin1(text: str, encoding: str) -> bytes:
    """Stands in for ``codecs.encode``, with which pickle protocol 2 spells bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"refused encoding {encoding!r}")
    return text.encode("latin1")


# The names pickle uses for numpy's own array constructors, before and after numpy 2 moved them. None of them
# runs anything that the file chooses: only containers of arrays, strings and numbers can come out.
_CONSTRUCTORS = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles numpy arrays and scalars, dicts, lists, tuples, strings and numbers, and refuses the rest."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("_codecs", "encode"):
            return _encode_latin1
        if (module, name) in _CONSTRUCTORS:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"refused to load {module}.{name}")


def load_object_array(path: Path) -> Any:
    """Loads the object stored in a 0-d object ``.npy`` file without running anything it names.

    Args:
        path: a file written by ``numpy.save`` from a dict.

    Returns:
        The stored object: containers of arrays, strings and numbers.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not such a file, or it names anything but numpy arrays.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: --root must hold a complete CALVIN split")
    try:
        with path.open("rb") as file:
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("unknown npy version")
            if not np.lib.format.read_array_header_1_0(file)[2].hasobject:
                raise ValueError("holds no pickled object")
            stored = _ArrayUnpickler(file, encoding="latin1").load()
        return stored.item() if isinstance(stored, np.ndarray) and stored.ndim == 0 else stored
    except (pickle.UnpicklingError, ValueError, EOFError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not an index file of arrays, strings and numbers ({error})") from error


@dataclass(frozen=True)
class Window:
    """One annotated demonstration: frames ``start`` to ``end - 1`` of the split.

    Attributes:
        start: first frame number.
        end: first frame number after the window (exclusive, a CALVIN fact that is easy to get wrong).
        task: task name, such as ``open_drawer``.
        sentence: the command in words.
        scene: the scene's letter, such as ``D``.
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
        root: the dataset's folder.
        name: the split's name.
        folder: the split's folder.
        scenes: scene letter -> (first, last) frame, both inclusive.
        windows: the annotated windows in the file's order.
        recordings: (N, 2) first and last frame of each uninterrupted recording, in order.
        source_sha256: hash of the index files, which identifies what was converted.

    Raises:
        FileNotFoundError: the folder or one of its index files is missing.
        ValueError: an index file is malformed, or a window lies outside every scene or recording.
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
            keys: names out of :data:`VECTORS`, :data:`CAMERAS`, :data:`DEPTH` and :data:`TACTILE`.

        Returns:
            For each key an array of shape (n, …) in the file's floating dtype, or uint8 for colours.

        Raises:
            FileNotFoundError: a frame's file is missing.
            ValueError: a file is truncated, or an array in it is missing or has a wrong shape or dtype; the
                message names the file and the key.
        """
        columns: dict[str, list[np.ndarray]] = {key: [] for key in keys}
        for frame in frames:
            path = self.frame_file(frame)
            for key, array in _load(path, columns).items():
                columns[key].append(_checked(array, key, path))
        return {key: np.stack(column) for key, column in columns.items()}


def frame_numbers(folder: Path) -> np.ndarray:
    """The numbers of the frame files in a split's folder, sorted, (n,) int64."""
    names = (entry.name for entry in os.scandir(folder))
    numbers = [name[8:-4] for name in names if name.startswith("episode_") and name.endswith(".npz")]
    return np.sort(np.array([number for number in numbers if number.isdecimal()], dtype=np.int64))


def _load(path: Path, keys: Iterable[str]) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(path) as stored:
            names = stored.NameToInfo
            missing = [key for key in keys if f"{key}.npy" not in names]
            if not missing:
                return {key: _parse_npy(stored.read(f"{key}.npy")) for key in keys}
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: the split is incomplete, {_REPAIR}") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: truncated or not an npz file ({error}); {_REPAIR}") from error
    remedy = _NO_PICTURES if missing[0] in CAMERAS else _REPAIR if missing[0] in VECTORS else _NO_EXTRA
    raise ValueError(f"{path}: array {missing[0]!r} is missing; {remedy}")


def _parse_npy(content: bytes) -> np.ndarray:
    """What ``numpy.load`` does, 3 times faster for small arrays: all frames share a handful of headers."""
    end = 10 + int.from_bytes(content[8:10], "little")
    shape, fortran_order, dtype = _npy_header(content[:end])
    return np.frombuffer(content, dtype, offset=end).reshape(shape, order="F" if fortran_order else "C")


@lru_cache(maxsize=64)
def _npy_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    file = io.BytesIO(header)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"unknown npy version {version}")
    return np.lib.format.read_array_header_1_0(file)


def _checked(array: np.ndarray, key: str, path: Path) -> np.ndarray:
    shape, is_colour = _SHAPES[key], key.startswith("rgb_")
    is_right_kind = array.dtype == np.uint8 if is_colour else array.dtype.kind == "f"
    if array.shape != shape or not is_right_kind:
        wanted = f"{'uint8' if is_colour else 'float'} {shape}"
        raise ValueError(f"{path}: array {key!r} is {array.dtype} {array.shape}, expected {wanted}")
    return array


def _read_scenes(path: Path) -> dict[str, tuple[int, int]]:
    stored = load_object_array(path)
    scenes: dict[str, tuple[int, int]] = {}
    try:
        for name, (first, last) in stored.items():
            scenes[str(name).rpartition("_")[2]] = (int(first), int(last))
    except (AttributeError, TypeError, ValueError) as error:
        wanted = "{scene name: [first frame, last frame]}"
        raise ValueError(f"{path}: expected {wanted}, found {stored!r}") from error
    if not scenes:
        raise ValueError(f"{path}: names no scene")
    return scenes


def _read_recordings(path: Path) -> np.ndarray:
    try:
        recordings = np.load(path, allow_pickle=False).reshape(-1, 2)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: --root must hold a complete CALVIN split") from error
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected (N, 2) first and last frame numbers ({error})") from error
    return recordings[np.argsort(recordings[:, 0])].astype(np.int64)


def _read_windows(path: Path, scenes: dict[str, tuple[int, int]]) -> list[Window]:
    stored = load_object_array(path)
    try:
        spans = [(int(start), int(end)) for start, end in stored["info"]["indx"]]
        sentences = [str(sentence) for sentence in stored["language"]["ann"]]
        tasks = [str(task) for task in stored["language"]["task"]]
        if not len(spans) == len(sentences) == len(tasks):
            raise ValueError(f"{len(spans)} windows, {len(sentences)} sentences, {len(tasks)} tasks")
    except (KeyError, TypeError, ValueError, IndexError) as error:
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


def _check_inside_recordings(windows: list[Window], recordings: np.ndarray, index: Path) -> None:
    """A window across two recordings would join frames that are not 1/30 s apart."""
    at = np.searchsorted(recordings[:, 0], [window.start for window in windows], side="right") - 1
    for window, row in zip(windows, at, strict=True):
        if row < 0 or window.end - 1 > recordings[row, 1]:
            span = f"[{window.start}, {window.end})"
            raise ValueError(f"{index}: window {span} is not inside one recording of ep_start_end_ids.npy")
