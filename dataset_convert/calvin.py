"""Reading one split of a CALVIN dataset from disk: the language index, the scenes and the frames.

Layout of a split (``training/`` or ``validation/``), of the public data and of ``lansar-record`` alike::

    episode_0000000.npz ...            one file per frame
    ep_start_end_ids.npy               (N, 2) first and last frame of each uninterrupted recording
    scene_info.npy                     pickled {scene name: [first frame, last frame]}
    lang_annotations/auto_lang_ann.npy pickled {"language": {"ann", "task"}, "info": {"indx"}}

A language window is ``[start, end)``: its end is exclusive. Recordings and scenes include their last frame.
"""

import errno
import hashlib
import io
import os
import pickle
import pickletools
import re
import reprlib
import zipfile
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

_MOST_BYTES = 1 << 20
"""No array of a frame is half as large."""

_BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Ways to pack an array of which zipfile unpacks no more than it is asked for; numpy uses no others."""

_REPAIR = "download or record it again"
_NO_PICTURES = "recorded without cameras? then use --images=none and no --embed"
_NO_EXTRA = "not recorded? then leave out --depth and --tactile"

_DTYPE = re.compile(r"b1|[iu][1248]|f[248]|[SU][1-9]\d*|O8?")
"""How numpy names the dtypes that an index file may hold."""


@dataclass
class _Dtype:
    """Stands in for ``numpy.dtype``: a kind, a size and a byte order; the rest of its state is ignored.

    numpy believes a dtype's state whatever it says: with a size that does not fit it reads beyond its arrays.
    """

    name: Any
    order: Any = "="

    def __setstate__(self, state: Any) -> None:
        self.order = state[1]

    def numpy(self) -> np.dtype:
        if not _DTYPE.fullmatch(self.name):
            raise pickle.UnpicklingError(f"refused dtype {self.name!r}")
        return np.dtype(self.name).newbyteorder(self.order)


@dataclass
class _Array:
    """Stands in for an array: what the file says of it, not checked before the file is read to its end.

    ``data`` are bytes, or for an array of objects the list of them in C order, whatever the array's own order.
    """

    shape: Any = None
    dtype: Any = None
    fortran_order: Any = None
    data: Any = None

    def __setstate__(self, state: Any) -> None:
        _version, self.shape, self.dtype, self.fortran_order, self.data = state

    def numpy(self, done: dict[int, Any]) -> np.ndarray:
        """The array, its objects passed through :func:`_with_arrays`."""
        dtype = self.dtype.numpy()
        if not all(type(length) is int and length >= 0 for length in self.shape):
            raise pickle.UnpicklingError(f"refused shape {self.shape!r}")
        if dtype.hasobject:
            objects = [_with_arrays(item, done) for item in self.data]
            return np.fromiter(objects, dtype, len(objects)).reshape(self.shape)
        array = np.frombuffer(self.data, dtype).copy()
        if dtype.kind == "U":
            array.tolist()  # numpy notices characters that do not exist only when a string is taken out
        return array.reshape(self.shape, order="F" if self.fortran_order else "C")


def _scalar(dtype: _Dtype, data: bytes) -> Any:
    """Stands in for numpy's constructor of scalars, and makes Python's numbers and strings of them."""
    return np.frombuffer(data, dtype.numpy()).item()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    """Stands in for the constructor with which pickle protocol 5 spells arrays."""
    return _Array(shape, dtype, order == "F", data)


def _encode_latin1(text: str, encoding: str) -> bytes:
    """Stands in for ``codecs.encode``, with which pickle protocol 2 spells bytes."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"refused encoding {encoding!r}")
    return text.encode("latin1")


# All that a file may name, before and after numpy 2 moved it, and what stands in for it. numpy's own constructors
# believe their arguments and their state: a crafted file could read the process's memory through them, or crash it.
_STAND_INS: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): _encode_latin1,
    ("__builtin__", "bytes"): lambda: b"",  # how protocol 2 spells no bytes
    ("numpy", "ndarray"): None,  # only ever an argument of _reconstruct
    ("numpy", "dtype"): lambda name, *_: _Dtype(name),
    **{(f"numpy.{core}.multiarray", "_reconstruct"): lambda *_: _Array() for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles dicts, lists, tuples, strings, numbers and stand-ins for arrays, and refuses the rest."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STAND_INS:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}")
        return _STAND_INS[module, name]


def _unpickle(content: bytes) -> Any:
    """What a pickle holds, with arrays.

    Raises:
        Exception: nearly any, where the pickle is damaged or asks for anything but arrays, strings and numbers.
    """
    # The unpickler itself reserves memory for whatever sizes and places it reads; genops raises at a wrong size.
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name.endswith("PUT") and (argument or 0) > len(content):
            raise pickle.UnpicklingError(f"refused place {argument} for an object")
    return _with_arrays(_ArrayUnpickler(io.BytesIO(content)).load(), {})


def _with_arrays(stored: Any, done: dict[int, Any]) -> Any:
    """Copies containers with arrays in place of their stand-ins.

    Args:
        stored: what the unpickler returned, or a part of it.
        done: the copies made so far, by the id of what was copied; what occurs often in the file is copied once.

    Returns:
        The copy, of dicts, lists, tuples, arrays, strings and numbers alone.

    Raises:
        pickle.UnpicklingError: there is anything else in it.
        TypeError, ValueError: an array contradicts itself.
        RecursionError: it is nested too deeply.
    """
    if stored is None or isinstance(stored, (str, bytes, int, float)):
        return stored
    if id(stored) in done:
        return done[id(stored)]
    copy: Any
    if isinstance(stored, _Array):
        copy = stored.numpy(done)
    elif isinstance(stored, dict):
        copy = {_with_arrays(key, done): _with_arrays(value, done) for key, value in stored.items()}
    elif isinstance(stored, list):
        copy = [_with_arrays(item, done) for item in stored]
    elif isinstance(stored, tuple):
        copy = tuple([_with_arrays(item, done) for item in stored])
    else:
        raise pickle.UnpicklingError(f"refused {type(stored).__name__}")
    done[id(stored)] = copy
    return copy


def _read_index(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: --root must hold a complete CALVIN split") from error


def load_object_array(path: Path) -> Any:
    """Loads the object stored in a 0-d object ``.npy`` file without running or believing anything in it.

    Args:
        path: a file written by ``numpy.save`` from a dict.

    Returns:
        The stored object: containers of arrays, strings and numbers; numpy's scalars become Python's.

    Raises:
        FileNotFoundError: the file is missing.
        OSError: the machine cannot read it.
        ValueError: it is not such a file, it is damaged, or it names anything but numpy arrays.
    """
    content = _read_index(path)
    try:
        header = _npy_header_of(content)
        if not _parse_npy_header(header)[2].hasobject:
            raise ValueError("holds no pickled object")
        stored = _unpickle(content[len(header) :])
        return stored.item() if isinstance(stored, np.ndarray) and stored.ndim == 0 else stored
    except Exception as error:  # see _unpickle
        raise ValueError(f"{path}: not an index file of arrays, strings and numbers ({error!r})") from error


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
            OSError: the machine cannot read a file, about which this says nothing.
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
            members = stored.NameToInfo
            missing = [key for key in keys if f"{key}.npy" not in members]
            if not missing:
                return {key: _parse_npy(_read_member(stored, members[f"{key}.npy"])) for key in keys}
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} is missing: the split is incomplete, {_REPAIR}") from error
    except MemoryError:
        raise  # the machine's fault: what is read is small, whatever the file says
    except Exception as error:  # damaged bytes make zipfile and numpy raise nearly anything
        fault = error.__context__ if isinstance(error, zipfile.BadZipFile) else error  # zipfile hides some
        if isinstance(fault, OSError) and fault.errno != errno.EINVAL:  # EINVAL comes of a damaged offset
            raise OSError(fault.errno, fault.strerror, str(path)) from error
        raise ValueError(f"{path}: truncated or not an npz file ({error!r}); {_REPAIR}") from error
    remedy = _NO_PICTURES if missing[0] in CAMERAS else _REPAIR if missing[0] in VECTORS else _NO_EXTRA
    raise ValueError(f"{path}: array {missing[0]!r} is missing; {remedy}")


def _read_member(stored: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Reads no more than an array takes, whatever the file says and whatever would come out of it."""
    if member.file_size > _MOST_BYTES:
        raise ValueError(f"{member.filename} has {member.file_size} bytes, more than any array of a frame")
    if member.compress_type not in _BOUNDED:
        raise ValueError(f"{member.filename} is packed by method {member.compress_type}, not as numpy does")
    with stored.open(member) as file:
        return file.read(member.file_size)


def _npy_header_of(content: bytes) -> bytes:
    return content[: 10 + int.from_bytes(content[8:10], "little")]


def _parse_npy(content: bytes) -> np.ndarray:
    """What ``numpy.load`` does, 3 times faster for small arrays: all frames share a handful of headers."""
    header = _npy_header_of(content)
    shape, fortran_order, dtype = _parse_npy_header(header)
    array = np.frombuffer(content, dtype, offset=len(header))
    return array.reshape(shape, order="F" if fortran_order else "C")


@lru_cache(maxsize=64)
def _parse_npy_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    file = io.BytesIO(header)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"unknown npy version {version}")
    try:
        return np.lib.format.read_array_header_1_0(file)
    except MemoryError as error:  # Python's parser, not the machine
        raise ValueError("npy header is nested too deeply") from error


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
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        wanted = "{scene name: [first frame, last frame]}"
        raise ValueError(f"{path}: expected {wanted}, found {reprlib.repr(stored)}") from error
    if not scenes:
        raise ValueError(f"{path}: names no scene")
    return scenes


def _read_recordings(path: Path) -> np.ndarray:
    content = _read_index(path)
    try:
        recordings = _parse_npy(content).reshape(-1, 2)
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
