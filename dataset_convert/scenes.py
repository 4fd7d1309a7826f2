"""Which scene the frames of a split were recorded in.

`scene_info.npy` says it: {scene name: [first frame, last frame]}. Public downloads have that file in training/ alone.
"""

import reprlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dataset_convert.frames import STATES, frame_file, read_frame
from dataset_convert.safe_pickle import load_object_array, parse_npy, read_index_file

VALIDATION_SCENE = "D"
"""The scene of every public validation split, whatever its training split was recorded in."""

SCENE_FILE = "scene_info.npy"
"""A split's file that says which frames were recorded in which scene."""

_SAMPLES = 16


@dataclass(frozen=True)
class Scenes:
    """The scenes of a split.

    Attributes:
        ranges: Scene letter to its (first, last) frame, both inclusive.
        source: Where this is known from, for people.
        file: The split's file that says it; None if it has none.
    """

    ranges: dict[str, tuple[int, int]]
    source: str
    file: Path | None = None


def find_scenes(folder: Path, recordings: np.ndarray, chosen: str) -> Scenes:
    """Finds out the scenes of a split: from its own file, else as the user says, else from what is beside it.

    Args:
        folder: The split's folder.
        recordings: (N, 2) first and last frame of each uninterrupted recording.
        chosen: Letter of the scene that the user names; "" for none.

    Raises:
        FileNotFoundError: Nothing says it.
        ValueError: The file is malformed, or contradicts the user.
    """
    own, training = folder / SCENE_FILE, folder.parent / "training" / SCENE_FILE
    is_copy = own != training and own.is_file() and training.is_file() and own.read_bytes() == training.read_bytes()
    if own.is_file() and not is_copy:
        ranges = read_scenes(own)
        if chosen and set(ranges) != {chosen}:
            raise ValueError(f"--scene={chosen}: {own} says {_told(ranges)}; correct or delete that file")
        return Scenes(ranges, own.name, own)
    whole = int(recordings.min()), int(recordings.max())
    if chosen:
        return Scenes({chosen: whole}, f"--scene={chosen}")
    if own != training and training.is_file():
        ranges = read_scenes(training)
        if _contain(ranges, recordings) and _numbers_agree(folder, training.parent, recordings):
            source = f"training/{SCENE_FILE}, whose ranges contain this split's frames"
            return Scenes(_within(ranges, recordings), source)
    if folder.name == "validation":
        return Scenes({VALIDATION_SCENE: whole}, f"validation is scene {VALIDATION_SCENE} in CALVIN's public data")
    raise FileNotFoundError(f"{own} is missing: if all of the split was recorded in one scene, name it: --scene=…")


def read_recordings(path: Path) -> np.ndarray:
    """A split's (N, 2) first and last frame of each uninterrupted recording, in order, from `ep_start_end_ids.npy`.

    Raises:
        FileNotFoundError: The file is missing.
        ValueError: It is malformed.
    """
    content = read_index_file(path)
    try:
        recordings = parse_npy(content).reshape(-1, 2)
        if recordings.dtype.kind not in "iu" or not len(recordings):
            raise ValueError(f"found {recordings.dtype} {recordings.shape}")
        if (recordings < 0).any() or (recordings[:, 1] < recordings[:, 0]).any():
            raise ValueError("a recording ends before it begins")
    except Exception as error:  # damaged bytes make numpy's header parser raise nearly anything
        raise ValueError(f"{path}: expected (N, 2) first and last frame numbers ({error!r})") from error
    return recordings[np.argsort(recordings[:, 0])].astype(np.int64)


def read_scenes(path: Path) -> dict[str, tuple[int, int]]:
    """Scene letter to its (first, last) frame, as a file says it.

    Raises:
        FileNotFoundError: The file is missing.
        ValueError: It is malformed.
    """
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


def _told(ranges: dict[str, tuple[int, int]]) -> str:
    return ", ".join(f"{letter}: frames {first}-{last}" for letter, (first, last) in ranges.items())


def _contain(ranges: dict[str, tuple[int, int]], recordings: np.ndarray) -> bool:
    """Whether each recording lies in one of the scenes."""
    inside = [(recordings[:, 0] >= first) & (recordings[:, 1] <= last) for first, last in ranges.values()]
    return bool(np.any(inside, axis=0).all())


def _within(ranges: dict[str, tuple[int, int]], recordings: np.ndarray) -> dict[str, tuple[int, int]]:
    """The ranges that hold recordings, from the first recording in each to the last."""
    found = {}
    for letter, (first, last) in ranges.items():
        inside = recordings[(recordings[:, 0] >= first) & (recordings[:, 1] <= last)]
        if len(inside):
            found[letter] = int(inside.min()), int(inside.max())
    return found


def _numbers_agree(folder: Path, training: Path, recordings: np.ndarray) -> bool:
    """Whether the split's frames are numbered together with training's: those in both agree.

    If there are none in both, the recordings of the two must at least have different numbers.

    On ABC->D they are not: training's numbers begin anew at 0 and name frames of other scenes than validation's.
    """
    lengths = recordings[:, 1] - recordings[:, 0] + 1
    places = np.linspace(0, lengths.sum() - 1, _SAMPLES).astype(int)
    rows = np.searchsorted(np.cumsum(lengths), places, side="right")
    frames = places - (np.cumsum(lengths) - lengths)[rows] + recordings[rows, 0]
    compared = False
    for frame in np.unique(frames).tolist():
        try:
            mine, theirs = (read_frame(frame_file(of, frame), STATES) for of in (folder, training))
        except (FileNotFoundError, ValueError):
            continue  # not in both; a defective frame is reported when it is converted
        compared = True
        if not all(np.array_equal(mine[key], theirs[key]) for key in STATES):
            return False
    index = training / "ep_start_end_ids.npy"
    if compared or not index.is_file():
        return compared
    others = read_recordings(index)
    return not any(((others[:, 0] <= last) & (others[:, 1] >= first)).any() for first, last in recordings)
