"""Compares the frames of a converted dataset with its source: what `lansar-verify` does file by file.

What each column must hold is worked out here from the source again. The converter's code for it (order of blocks, roll,
columns) is not used on purpose: it would hide its own errors.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from dataset_convert.frames import INTERVENTION, STATES, VECTORS, digest
from dataset_convert.verify_cameras import camera_matrices
from dataset_convert.verify_claims import Dataset, Mismatch, chunk_and_file
from lerobot_lansar.calvin import COLORS, CONTROL_HZ, TASKS
from lerobot_lansar.datasets import INTERVENTION_FEATURE, IS_INTERVENTION
from lerobot_lansar.pictures import resize

_BETTER = 0.9
"""Wrong pictures fit better than the right ones if their squared error is less than this share of it. A video of the
desk that is a frame off has more than twice the error of a right one."""


@dataclass
class Found:
    """What one file of frames holds, or several.

    Attributes:
        frames: How many.
        psnr: Feature to the signal-to-noise ratio (dB) of each picture.
        sums: Feature to (smallest, largest, sum) of each dimension.
        shared: Numbers of frames of training that are in validation too.
    """

    frames: int = 0
    psnr: dict[str, list[float]] = field(default_factory=dict)
    sums: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    shared: set[int] = field(default_factory=set)

    def add(self, other: "Found") -> None:
        """Takes in what another file holds."""
        self.frames += other.frames
        self.shared |= other.shared
        for key, values in other.psnr.items():
            self.psnr.setdefault(key, []).extend(values)
        for key, sums in other.sums.items():
            self._add_sums(key, sums)

    def add_values(self, key: str, values: np.ndarray) -> None:
        """Takes in some frames of a feature, (n, length)."""
        values = values.astype(np.float64)
        self._add_sums(key, (values.min(axis=0), values.max(axis=0), values.sum(axis=0)))

    def _add_sums(self, key: str, sums: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        if key in self.sums:
            (low, high, total), before = sums, self.sums[key]
            sums = np.minimum(before[0], low), np.maximum(before[1], high), before[2] + total
        self.sums[key] = sums


@dataclass
class _RowGroup:
    """Some consecutive frames of one episode, and their source.

    Attributes:
        rows: The frames in the dataset.
        source: CALVIN's arrays of the same frames.
        episode: The episode's number.
        first: The first frame's number in the episode.
        place: Where this is, for messages.
    """

    rows: pa.Table
    source: dict[str, np.ndarray]
    episode: int
    first: int
    place: str


def verify_file(dataset: Dataset, path: Path, min_psnr: float) -> Found:
    """Compares one file of frames, and the videos that belong to it, with the source.

    Args:
        dataset: Whose file it is.
        path: The parquet file.
        min_psnr: Smallest signal-to-noise ratio (dB) that a picture may have.

    Raises:
        Mismatch: See `verify`.
    """
    cameras = {key: feature for key, feature in dataset.features.items() if feature["dtype"] in ("video", "image")}
    videos = {
        key: _decoded(_video_of(dataset, key, path), feature)
        for key, feature in cameras.items()
        if feature["dtype"] == "video"
    }
    numbers = [*VECTORS, *(INTERVENTION if dataset.says_who_acted else ())]
    arrays = [*numbers, *dict.fromkeys(dataset.source_of(key)[0] for key in cameras)]
    found = Found()
    hashes: dict[int, Any] = {}
    with pq.ParquetFile(path) as table:
        for number in range(table.num_row_groups):
            group = _with_source(dataset, path, table.read_row_group(number), arrays)
            hashes[group.episode] = digest(group.source, hashes.get(group.episode))
            _compare_columns(dataset, group, found)
            found.shared |= _in_validation(dataset, group)
            for key in cameras:
                if key in videos:
                    _compare_video(dataset, group, key, videos[key], min_psnr, found)
                else:
                    _compare_images(dataset, group, key)
            found.frames += len(group.rows)
    for key, video in videos.items():
        if next(video, None) is not None:
            raise Mismatch(f"{_video_of(dataset, key, path)} holds more pictures than {path} frames")
    for episode, state in hashes.items():
        if state.hexdigest() != dataset.manifest["episodes"][episode]["sha256"]:
            raise Mismatch(f"{dataset.split.folder}: frames of episode {episode} changed since they were converted")
    return found


def _with_source(dataset: Dataset, path: Path, rows: pa.Table, arrays: list[str]) -> _RowGroup:
    episode, first = (int(_numbers(rows[name])[0]) for name in ("episode_index", "frame_index"))
    start = dataset.spans[episode].start + first
    frames = range(start, start + len(rows))
    place = f"{path}: episode {episode}, frames {frames.start}-{frames.stop - 1}"
    return _RowGroup(rows, dataset.split.read(frames, arrays), episode, first, place)


def _in_validation(dataset: Dataset, group: _RowGroup) -> set[int]:
    """Numbers of the group's source frames that validation holds too."""
    if dataset.validation is None:
        return set()
    states = [{key: group.source[key][row] for key in STATES} for row in range(len(group.rows))]
    frames = group.rows["calvin.frame"].to_pylist()
    files = map(dataset.split.frame_file, frames)
    return {frame for frame, file, s in zip(frames, files, states, strict=True) if dataset.validation.hold(file, s)}


# ---- columns of numbers


def _compare_columns(dataset: Dataset, group: _RowGroup, found: Found) -> None:
    """Compares all columns but the pictures, which must be equal, and takes them into `found`."""
    wanted_poses = {
        key: matrices.reshape(len(group.rows), -1).astype(np.float32)
        for key, matrices in camera_matrices(dataset, group.source["robot_obs"]).items()
    }
    for name, wanted in (_wanted(dataset, group) | wanted_poses).items():
        stored = _numbers(group.rows[name])
        # Poses are computed here in another way than by the converter, so their last digits may differ.
        if not (np.allclose(stored, wanted, atol=2e-6) if name in wanted_poses else np.array_equal(stored, wanted)):
            raise Mismatch(f"{group.place}: column {name} is not what the source says")
        if name in dataset.features and wanted.dtype == np.float32:
            found.add_values(name, wanted)


def _wanted(dataset: Dataset, group: _RowGroup) -> dict[str, np.ndarray]:
    """Every column but the pictures, from the source alone."""
    episode, first, source = group.episode, group.first, group.source
    span, manifest = dataset.spans[episode], dataset.manifest
    n = len(source["actions"])
    start = dataset.starts[episode] + first
    windows = dataset.windows[episode][first : first + n]
    listed = dataset.split.windows
    tasks = np.array([manifest["task_names"].index(listed[w].task) if w >= 0 else -1 for w in windows])
    absolute, relative = _without_jumps(source["actions"]), source["rel_actions"]
    action, other, name = relative, absolute, "calvin.actions"
    if manifest["request"]["action"] == "abs":
        action, other, name = absolute, relative, "calvin.rel_actions"
    order = dataset.orders[span.scene]
    blocks = [6 + 6 * order.index(color) + i for color in COLORS for i in range(6)]
    scene = source["scene_obs"][:, [*range(6), *blocks]]
    told = scene if manifest["request"].get("scene_state", True) else scene[:, :0]
    if manifest["request"].get("task_in_state"):
        told = np.hstack([told, np.eye(len(TASKS) + 1)[tasks, :-1]])  # task -1 takes the last row: all zeros
    acted = source[IS_INTERVENTION][:, 0] if dataset.says_who_acted else np.full(n, True)
    number = {row["task"]: row["task_index"] for row in dataset.tasks}
    return {
        "observation.state": _without_jumps(source["robot_obs"]).astype(np.float32),
        **({"observation.environment_state": told.astype(np.float32)} if told.shape[1] else {}),
        "action": action.astype(np.float32),
        name: other.astype(np.float32),
        "calvin.frame": np.arange(span.start + first, span.start + first + n),
        "calvin.window": windows,
        "calvin.task": tasks,
        "calvin.scene": np.full(n, manifest["scene_names"].index(span.scene)),
        **({INTERVENTION_FEATURE: acted} if INTERVENTION_FEATURE in dataset.features else {}),
        "timestamp": (np.arange(first, first + n) / CONTROL_HZ).astype(np.float32),
        "frame_index": np.arange(first, first + n),
        "episode_index": np.full(n, episode),
        "index": np.arange(start, start + n),
        "task_index": np.array([number[dataset.sentence_of(window)] for window in windows]),
    }


def _without_jumps(poses: np.ndarray) -> np.ndarray:
    """Poses whose roll, pitch and yaw lie in [0, 2 pi), [-pi, pi) and [-pi/2, 3 pi/2)."""
    poses = poses.astype(np.float64)  # a copy; turns are added before rounding
    for column, lowest in ((3, 0.0), (4, -np.pi), (5, -np.pi / 2)):
        for _ in range(100):  # turns; CALVIN's angles need one
            poses[poses[:, column] < lowest, column] += 2 * np.pi
            poses[poses[:, column] >= lowest + 2 * np.pi, column] -= 2 * np.pi
    return poses


def _numbers(column: Any) -> np.ndarray:
    """A column as (n,) or (n, length)."""
    flat = column.combine_chunks()
    if not hasattr(flat, "flatten") or not hasattr(flat.type, "list_size"):
        return flat.to_numpy(zero_copy_only=False)
    return flat.flatten().to_numpy().reshape(len(flat), -1)


# ---- pictures


def _compare_images(dataset: Dataset, group: _RowGroup, key: str) -> None:
    """Compares a camera's pictures in the frame table, which must be equal."""
    stored = np.stack([np.array(Image.open(io.BytesIO(cell["bytes"]))) for cell in group.rows[key].to_pylist()])
    if not np.array_equal(stored, _pictures(dataset, group, key).astype(stored.dtype)):
        raise Mismatch(f"{group.place}: pictures of {key} are not the source's")


def _compare_video(
    dataset: Dataset, group: _RowGroup, key: str, video: Iterator[np.ndarray], min_psnr: float, found: Found
) -> None:
    """Compares a camera's next pictures in its video, by their signal-to-noise ratio."""
    place = f"{group.place}: {key}"
    stored = _take(video, len(group.rows), place)
    psnr = _psnr(stored, _pictures(dataset, group, key), dataset.features[key], place)
    if min(psnr) < min_psnr:
        raise Mismatch(f"{place}: PSNR {min(psnr):.1f} dB, --min_psnr={min_psnr}")
    found.psnr.setdefault(key, []).extend(psnr)


def _pictures(dataset: Dataset, group: _RowGroup, key: str) -> np.ndarray:
    """The source's pictures that a camera feature shows."""
    array, part = dataset.source_of(key)
    pictures = group.source[array]
    size = dataset.manifest["request"].get("image_size", 0)
    if size and not array.endswith("_tactile"):
        pictures = np.stack([resize(picture, size) for picture in pictures])
    return pictures if pictures.ndim == 3 else pictures[..., part]


def _video_of(dataset: Dataset, key: str, data: Path) -> Path:
    """The video that belongs to a file of frames: the same chunk and file number."""
    chunk, file = chunk_and_file(data)
    return dataset.folder / dataset.info["video_path"].format(video_key=key, chunk_index=chunk, file_index=file)


def _decoded(path: Path, feature: dict[str, Any]) -> Iterator[np.ndarray]:
    """A video's pictures: (H, W, 3) uint8, or (H, W) uint16, LeRobot's quantized distances."""
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24" if feature["shape"][2] == 3 else "gray12le")


def _take(video: Iterator[np.ndarray], n: int, place: str) -> np.ndarray:
    """The next n pictures."""
    pictures = [picture for _, picture in zip(range(n), video, strict=False)]
    if len(pictures) < n:
        raise Mismatch(f"{place}: the video ends too early")
    return np.stack(pictures)


def _psnr(stored: np.ndarray, wanted: np.ndarray, feature: dict[str, Any], place: str) -> list[float]:
    """Peak signal-to-noise ratio (dB) of each picture of a video; the peak of distances is the codec's farthest.

    Raises:
        Mismatch: The pictures fit better moved by one frame, or with red and blue exchanged.
    """
    peak = 255.0
    if feature["shape"][2] == 1:
        stored, peak = _distances(stored, feature)
    if stored.shape != wanted.shape:
        raise Mismatch(f"{place}: pictures are {stored.shape[1:]}, the source's {wanted.shape[1:]}")
    error = _squared_errors(stored, wanted)
    visible = (peak / 255) ** 2  # below this the codec's rounding decides what fits best
    here = error.mean()
    if wanted.ndim == 4 and here > visible and _squared_errors(stored, wanted[..., ::-1]).mean() < _BETTER * here:
        raise Mismatch(f"{place}: red and blue are exchanged")
    if len(stored) > 2:
        here = error[1:-1].mean()
        for name, moved in (("late", wanted[:-2]), ("early", wanted[2:])):
            if _squared_errors(stored[1:-1], moved).mean() < _BETTER * here and here > visible:
                raise Mismatch(f"{place}: the video is a frame {name}")
    return (10 * np.log10(peak**2 / np.maximum(error, 1e-9))).tolist()


def _distances(stored: np.ndarray, feature: dict[str, Any]) -> tuple[np.ndarray, float]:
    """The distances (m) that a depth video's pictures stand for, and the farthest that it can hold."""
    # Take seconds to import, and workers need them for depth alone.
    from lerobot.configs import DepthEncoderConfig
    from lerobot.datasets.depth_utils import dequantize_depth

    codec = DepthEncoderConfig.from_video_info(feature["info"])
    quantizer = {name: getattr(codec, name) for name in ("depth_min", "depth_max", "shift", "use_log")}
    distances = dequantize_depth(stored[:, None], **quantizer, output_unit="m", output_tensor=False)[:, 0]
    return distances, codec.depth_max


def _squared_errors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mean squared difference of each of n pictures, (n,)."""
    difference = a.astype(np.float32) - b.astype(np.float32)
    return (difference**2).reshape(len(a), -1).mean(axis=1)
