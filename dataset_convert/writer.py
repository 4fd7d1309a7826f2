"""Writing LeRobotDataset v3 files shard by shard.

A shard is a run of consecutive episodes: one parquet file of frames, one of episode metadata and one mp4 per
camera, all with the same chunk and file number. Shards do not depend on each other, so they can be written by
several processes; the files that describe the whole (``tasks.parquet``, ``stats.json``, ``info.json``) come
last.

Why not LeRobot's own recorder: it is made for one robot at 30 Hz and takes 100 to 600 ms per episode, most of
it in statistics and in muxing the growing mp4 again (measured with LeRobot 0.6.1). The tests hold these files
against its.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.compute_stats import aggregate_stats, auto_downsample_height_width, get_feature_stats
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.feature_utils import create_empty_dataset_info, get_hf_features_from_features
from lerobot.datasets.io_utils import write_info, write_stats, write_tasks
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_EPISODES_PATH, DEFAULT_VIDEO_PATH, DatasetInfo
from lerobot.datasets.video_utils import get_video_info
from lerobot.utils.constants import DEFAULT_FEATURES
from lerobot.utils.utils import flatten_dict

from dataset_convert.calvin import CAMERAS, COLOURS, FPS

type Stats = dict[str, dict[str, np.ndarray]]
"""Feature -> name of a statistic -> its value."""

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""LeRobot's."""

IMAGE_KEYS = {"rgb_static": "observation.images.static", "rgb_gripper": "observation.images.gripper"}
"""CALVIN camera -> LeRobot feature."""

_REL_NAMES = ["delta_x", "delta_y", "delta_z", "delta_roll", "delta_pitch", "delta_yaw", "gripper"]
_ABS_NAMES = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
_STATE_NAMES = [
    *("tcp_x", "tcp_y", "tcp_z", "tcp_roll", "tcp_pitch", "tcp_yaw", "gripper_width"),
    *(f"joint_{i}" for i in range(1, 8)),
    "gripper_action",
]
_SCENE_NAMES = ["slider", "drawer", "button", "switch", "lightbulb", "led"] + [
    f"{colour}_block_{axis}" for colour in COLOURS for axis in ("x", "y", "z", "roll", "pitch", "yaw")
]


def dataset_features(action: str, videos: bool) -> dict[str, dict]:
    """LeRobot's description of the dataset's columns.

    Args:
        action: "rel" or "abs", the form that ``action`` holds; the other one is kept as ``calvin.…``.
        videos: whether both cameras are stored.

    Returns:
        Feature name -> {"dtype", "shape", "names"}, LeRobot's own columns (``index``, …) included.
    """

    def vector(names: list[str]) -> dict:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    other = "calvin.actions" if action == "rel" else "calvin.rel_actions"
    features = {
        "observation.state": vector(_STATE_NAMES),
        "observation.environment_state": vector(_SCENE_NAMES),
        "action": vector(_REL_NAMES if action == "rel" else _ABS_NAMES),
        other: vector(_ABS_NAMES if action == "rel" else _REL_NAMES),
        "calvin.frame": {"dtype": "int64", "shape": (1,), "names": None},
    }
    if videos:
        for camera, key in IMAGE_KEYS.items():
            axes = ["height", "width", "channels"]
            features[key] = {"dtype": "video", "shape": CAMERAS[camera], "names": axes}
    return {**features, **DEFAULT_FEATURES}


@dataclass
class Episode:
    """One episode ready to be written.

    Attributes:
        task: its sentence.
        columns: the vector features by name, each (n, length), and ``calvin.frame`` (n,).
        images: LeRobot image feature -> (n, H, W, 3) uint8; empty without videos.
    """

    task: str
    columns: dict[str, np.ndarray]
    images: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.columns["calvin.frame"])


def episode_stats(columns: dict[str, np.ndarray], images: dict[str, np.ndarray]) -> Stats:
    """What LeRobot's ``compute_episode_stats`` computes, for all dimensions of a column at once.

    LeRobot fills a histogram of 5000 bins per dimension to read quantiles from, 25 ms per episode. Sorting
    gives the same quantiles exactly instead of to within a bin: the smallest value that at least a share q of
    the frames do not exceed. Pictures go through LeRobot's own function.

    Args:
        columns: feature -> (n,) or (n, length).
        images: feature -> (n, H, W, 3) uint8.

    Returns:
        Feature -> {"min", "max", "mean", "std", "count", "q01", …}, of shape (length,) or (3, 1, 1), pictures
        in [0, 1].
    """
    stats: Stats = {}
    for key, column in columns.items():
        values = np.sort(column.reshape(len(column), -1).astype(np.float64), axis=0)
        stats[key] = {
            "min": values[0],
            "max": values[-1],
            "mean": values.mean(axis=0),
            "std": values.std(axis=0),
            "count": np.array([len(values)]),
        }
        for q in QUANTILES:
            stats[key][f"q{int(q * 100):02d}"] = values[max(int(np.ceil(q * len(values))) - 1, 0)]
    for key, pictures in images.items():
        small = np.stack([auto_downsample_height_width(picture.transpose(2, 0, 1)) for picture in pictures])
        values = get_feature_stats(small, axis=(0, 2, 3), keepdims=True)
        stats[key] = {k: v if k == "count" else np.squeeze(v / 255.0, axis=0) for k, v in values.items()}
    return stats


class _Video:
    """An mp4 file that takes pictures one by one."""

    def __init__(self, path: Path, shape: tuple[int, ...], encoder: RGBEncoderConfig, threads: int | None):
        path.parent.mkdir(parents=True, exist_ok=True)
        self.container = av.open(str(path), "w")
        options = encoder.get_codec_options(threads, as_strings=True)
        self.stream: Any = self.container.add_stream(encoder.vcodec, FPS, options=options)
        self.stream.pix_fmt = encoder.pix_fmt
        self.stream.height, self.stream.width = shape[:2]

    def __enter__(self) -> "_Video":
        return self

    def add(self, pictures: np.ndarray) -> None:
        for picture in pictures:
            self.container.mux(self.stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def __exit__(self, *_: object) -> None:
        self.container.mux(self.stream.encode())
        self.container.close()


@dataclass
class Place:
    """Where a shard goes: known before anything is written, because the windows say how long every episode
    is.

    Attributes:
        shard: its number.
        first_episode: number of its first episode.
        first_index: absolute index of its first frame.
    """

    shard: int
    first_episode: int
    first_index: int


def write_shard(
    root: Path,
    info: DatasetInfo,
    place: Place,
    episodes: Iterator[Episode],
    task_index: dict[str, int],
    vcodec: str,
    encoder_threads: int | None,
) -> Stats:
    """Writes one shard's data, episode metadata and videos.

    Args:
        root: the dataset's folder.
        info: the dataset's description, of :func:`empty_info`.
        place: the shard's numbers.
        episodes: yields the shard's episodes one at a time, so that one episode's pictures are in memory.
        task_index: sentence -> number.
        vcodec: LeRobot's name of a video codec.
        encoder_threads: threads per video, None: the codec decides.

    Returns:
        The statistics of the shard's frames.
    """
    chunk, file = divmod(place.shard, info.chunks_size)
    schema = get_hf_features_from_features(info.features).arrow_schema
    numbers = {"chunk_index": chunk, "file_index": file}
    data_path = root / DEFAULT_DATA_PATH.format(**numbers)
    data_path.parent.mkdir(parents=True, exist_ok=True)
    index = place.first_index
    rows: list[dict[str, Any]] = []
    stats: list[Stats] = []
    with ExitStack() as stack:
        videos = {
            key: stack.enter_context(
                _Video(
                    root / DEFAULT_VIDEO_PATH.format(video_key=key, **numbers),
                    feature["shape"],
                    RGBEncoderConfig(vcodec=vcodec),
                    encoder_threads,
                )
            )
            for key, feature in info.features.items()
            if feature["dtype"] == "video"
        }
        data = stack.enter_context(pq.ParquetWriter(data_path, schema))
        for number, episode in enumerate(episodes, start=place.first_episode):
            n = len(episode)
            columns = {
                **episode.columns,
                "timestamp": (np.arange(n) / FPS).astype(np.float32),
                "frame_index": np.arange(n),
                "episode_index": np.full(n, number),
                "index": np.arange(index, index + n),
                "task_index": np.full(n, task_index[episode.task]),
            }
            # One row group per episode, as LeRobot writes it.
            arrays = [_arrow(columns[field.name], field) for field in schema]
            data.write_table(pa.Table.from_arrays(arrays, schema=schema))
            row = {
                "episode_index": number,
                "tasks": [episode.task],
                "length": n,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": index,
                "dataset_to_index": index + n,
            }
            for key, video in videos.items():
                video.add(episode.images[key])
                row[f"videos/{key}/chunk_index"] = chunk
                row[f"videos/{key}/file_index"] = file
                row[f"videos/{key}/from_timestamp"] = (index - place.first_index) / FPS
                row[f"videos/{key}/to_timestamp"] = (index - place.first_index + n) / FPS
            stats.append(episode_stats(columns, episode.images))
            rows.append(row)
            index += n
    _write_episodes(root / DEFAULT_EPISODES_PATH.format(**numbers), rows, stats)
    return aggregate_stats(stats)


def _arrow(column: np.ndarray, field: pa.Field) -> pa.Array:
    if column.ndim == 1:
        return pa.array(column, field.type)
    flat = pa.array(column.astype(np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, column.shape[1]).cast(field.type)


def _write_episodes(path: Path, rows: list[dict[str, Any]], stats: list[Stats]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = []
    for row, of_row in zip(rows, stats, strict=True):
        flat = {key: value.tolist() for key, value in flatten_dict({"stats": of_row}).items()}
        place = {f"meta/episodes/{name}": row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table.append({**row, **flat, **place})
    pq.write_table(pa.Table.from_pylist(table), path)


def empty_info(action: str, videos: bool) -> DatasetInfo:
    """The dataset's description before anything was written."""
    return create_empty_dataset_info(CODEBASE_VERSION, FPS, dataset_features(action, videos), videos, "panda")


def check_codec(vcodec: str) -> None:
    """Raises ValueError if LeRobot cannot encode with a codec of this name here."""
    try:
        RGBEncoderConfig(vcodec=vcodec)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"--vcodec={vcodec}: {error}") from error


def write_whole(
    root: Path, info: DatasetInfo, tasks: list[str], lengths: list[int], stats: list[Stats], vcodec: str
) -> None:
    """Writes the files that describe the whole dataset, after all shards.

    Args:
        root: the dataset's folder.
        info: of :func:`empty_info`; its counters are filled in.
        tasks: the sentences in the order of their numbers.
        lengths: frames of each episode.
        stats: each shard's statistics.
        vcodec: the codec that the shards were written with.
    """
    encoder = RGBEncoderConfig(vcodec=vcodec)
    for key, feature in info.features.items():
        if feature["dtype"] == "video":
            path = root / DEFAULT_VIDEO_PATH.format(video_key=key, chunk_index=0, file_index=0)
            feature["info"] = get_video_info(path, video_encoder=encoder)
    info.total_episodes, info.total_frames, info.total_tasks = len(lengths), sum(lengths), len(tasks)
    info.splits = {"train": f"0:{len(lengths)}"}
    write_tasks(pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task")), root)
    write_stats(aggregate_stats(stats), root)
    write_info(info, root)
