"""Reads the frames of a CALVIN split: one npz file each."""

import errno
import hashlib
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dataset_convert.safe_pickle import parse_npy
from lerobot_lansar.calvin import CAMERAS
from lerobot_lansar.datasets import IS_INTERVENTION

VECTORS = {"robot_obs": (15,), "scene_obs": (24,), "actions": (7,), "rel_actions": (7,)}
"""Shapes of the float vectors stored in every frame file."""

STATES = ("robot_obs", "scene_obs")
"""The vectors that say what the simulation was like at a frame."""

RGB = {f"rgb_{camera}": (size, size, 3) for camera, size in CAMERAS.items()}
"""Shapes of the uint8 pictures stored in a frame file, unless it was recorded without cameras."""

DEPTH = {f"depth_{camera}": (size, size) for camera, size in CAMERAS.items()}
"""Shapes of the floating-point distances (m) of both cameras, in public data."""

TACTILE = {"rgb_tactile": (160, 120, 6), "depth_tactile": (160, 120, 2)}
"""Shapes of the pictures of the two fingertip sensors side by side: uint8 colours, floating-point depth."""

INTERVENTION = {IS_INTERVENTION: (1,)}
"""Shape of the truth value that says who acted, in recordings of takeovers."""

_MAX_BYTES = 1 << 20
"""Limit for one array; the largest of a frame takes less than half of it."""

_SAMPLE = 50
"""About how many frames tell what was recorded."""

_SAFE_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods of which zipfile unpacks no more than it is asked for; numpy uses no others."""

_REPAIR = "download or record it again"
_NO_PICTURES = "recorded without cameras? then use --images=none and no --embed"
_NO_EXTRA = "not recorded? then leave out --depth and --tactile"


def frame_file(folder: Path, frame: int) -> Path:
    """The file of a split's frame, whether or not it exists."""
    return folder / f"episode_{frame:07d}.npz"


def frame_numbers(folder: Path) -> np.ndarray:
    """The numbers of the frame files in a split's folder, sorted, (n,) int64."""
    names = (entry.name for entry in os.scandir(folder))
    numbers = [name[8:-4] for name in names if name.startswith("episode_") and name.endswith(".npz")]
    return np.sort(np.array([number for number in numbers if number.isdecimal()], dtype=np.int64))


def recorded_arrays(files: Iterable[Path]) -> set[str]:
    """Names of the arrays that were recorded: those in any of a sample of these files, as one may be defective."""
    files, found = list(files), set[str]()
    for file in files[:: max(1, len(files) // _SAMPLE)]:
        try:
            with zipfile.ZipFile(file) as stored:
                found |= {name.removesuffix(".npy") for name in stored.NameToInfo}
        except (OSError, zipfile.BadZipFile):  # reported when all frames are read
            continue
    return found


def shape_of(array: str, image_size: int = 0) -> tuple[int, ...]:
    """The shape of one of CALVIN's arrays.

    Args:
        array: Its name.
        image_size: Width and height of both cameras' pictures; 0: the cameras' own.
    """
    if image_size and array in RGB | DEPTH:
        return (image_size, image_size, *(RGB | DEPTH)[array][2:])
    return (VECTORS | RGB | DEPTH | TACTILE | INTERVENTION)[array]


def read_frame(path: Path, keys: Iterable[str], image_size: int = 0) -> dict[str, np.ndarray]:
    """Reads some arrays of a frame file, whose pictures are of that size; see `CalvinSplit.read`."""
    return {key: _checked(array, key, path, image_size) for key, array in _load(path, keys).items()}


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


def _checked(array: np.ndarray, key: str, path: Path, image_size: int) -> np.ndarray:
    shape, is_color = shape_of(key, image_size), key.startswith("rgb_")
    kind = "bool" if key in INTERVENTION else "uint8" if is_color else "float"
    is_right_kind = array.dtype.kind == "f" if kind == "float" else array.dtype == kind
    if array.shape != shape or not is_right_kind:
        wanted = f"{kind} {shape}"
        raise ValueError(f"{path}: array {key!r} is {array.dtype} {array.shape}, expected {wanted}")
    return array
