"""Writing the frames of a LeRobotDataset v3, shard by shard.

A shard is a run of consecutive episodes: one parquet file of frames, one mp4 per camera and one table of episode
metadata, all with the same chunk and file number. Shards do not depend on each other, so several processes, on several
machines, can write them; `dataset_convert.features` writes what describes the whole. Nothing here imports LeRobot: a
worker would wait 20 s for that.

Why not LeRobot's own recorder: it is made for one robot at 30 Hz and takes 100 to 600 ms per episode, most of it in
statistics and in muxing the growing mp4 again (measured with LeRobot 0.6.1). The tests hold these files against its.
"""

import hashlib
import io
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from dataset_convert.layout import Layout, Picture
from dataset_convert.stats import EpisodeStats, Stats, sampled
from lerobot_lansar.calvin import CONTROL_HZ


@dataclass
class Block:
    """Some consecutive frames of an episode.

    Attributes:
        columns: Vector features by name, (n, length) or (n,).
        tasks: (n,) number of each frame's task.
        arrays: CALVIN's picture arrays, each (n, …).
    """

    columns: dict[str, np.ndarray]
    tasks: np.ndarray
    arrays: dict[str, np.ndarray]


@dataclass
class Place:
    """Where a shard goes; known before anything is written, because the source says how long every episode is.

    Attributes:
        shard: Its number.
        first_episode: Number of its first episode.
        first_index: Absolute index of its first frame.
    """

    shard: int
    first_episode: int
    first_index: int


@dataclass
class Written:
    """What became of a shard.

    Attributes:
        rows: One of meta/episodes per episode, without statistics.
        stats: Each episode's.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    stats: list[Stats] = field(default_factory=list)


def write_shard(
    root: Path,
    layout: Layout,
    place: Place,
    episodes: Iterable[tuple[int, Iterator[Block]]],
    tasks: list[str],
) -> Written:
    """Writes one shard's frame table and videos.

    Args:
        root: The dataset's folder.
        layout: How its files look.
        place: The shard's numbers.
        episodes: Yields the shard's episodes one at a time, each as its number of frames and its blocks: one block
            is in memory.
        tasks: Sentences in the order of their numbers.
    """
    data_path = root / layout.data_file(place.shard)
    data_path.parent.mkdir(parents=True, exist_ok=True)
    written = Written()
    has_depth = any(picture.is_depth for picture in layout.pictures)
    index = place.first_index
    with ExitStack() as stack:
        videos = {
            picture.key: stack.enter_context(Video(root / layout.video_file(place.shard, picture.key), picture))
            for picture in layout.pictures
            if picture.codec
        }
        data = stack.enter_context(pq.ParquetWriter(data_path, layout.schema))
        for number, (length, blocks) in enumerate(episodes, start=place.first_episode):
            stats = EpisodeStats()
            chosen = sampled(length) if has_depth else np.ones(length, dtype=bool)
            n = 0
            for block in blocks:
                size = len(block.tasks)
                columns: dict[str, Any] = {
                    **block.columns,
                    "timestamp": (np.arange(n, n + size) / CONTROL_HZ).astype(np.float32),
                    "frame_index": np.arange(n, n + size),
                    "episode_index": np.full(size, number),
                    "index": np.arange(index + n, index + n + size),
                    "task_index": block.tasks,
                }
                stats.add(columns)
                for picture in layout.pictures:
                    pictures = picture.of(block.arrays)
                    stats.add_pictures(picture, pictures[chosen[n : n + size]] if picture.is_depth else pictures)
                    if picture.key in videos:
                        videos[picture.key].add(pictures)
                    else:
                        columns[picture.key] = [_encoded(p, n + i) for i, p in enumerate(pictures)]
                # One row group per block, so per episode unless it is long: LeRobot writes one per episode.
                arrays = [_arrow(columns[name.name], name) for name in layout.schema]
                data.write_table(pa.Table.from_arrays(arrays, schema=layout.schema))
                n += size
            row = {
                "episode_index": number,
                "tasks": [tasks[task] for task in stats.in_order("task_index")],
                "length": n,
                **{f"data/{name}": value for name, value in layout.numbers(place.shard).items()},
                "dataset_from_index": index,
                "dataset_to_index": index + n,
            }
            for key in videos:
                for name, value in layout.numbers(place.shard).items():
                    row[f"videos/{key}/{name}"] = value
                row[f"videos/{key}/from_timestamp"] = (index - place.first_index) / CONTROL_HZ
                row[f"videos/{key}/to_timestamp"] = (index - place.first_index + n) / CONTROL_HZ
            written.rows.append(row)
            written.stats.append(stats.result())
            index += n
    return written


class Video:
    """An mp4 file that takes pictures one by one."""

    def __init__(self, path: Path, picture: Picture):
        assert picture.codec is not None
        self._codec = picture.codec
        path.parent.mkdir(parents=True, exist_ok=True)
        av.logging.set_level(av.logging.ERROR)  # x264 tells a dozen lines per file
        self.container: Any = av.open(str(path), "w")
        options = dict(self._codec.options)
        if "x265-params" in options:  # it does not go through libav's log
            options["x265-params"] += ":log-level=error"
        stream: Any = self.container.add_stream(self._codec.name, CONTROL_HZ, options=options)
        stream.codec_context.thread_count = 1  # workers share the cores; and the same bytes on every machine
        stream.pix_fmt = self._codec.pix_fmt
        stream.height, stream.width = picture.shape[:2]
        self.stream = stream

    def __enter__(self) -> "Video":
        return self

    def add(self, pictures: np.ndarray) -> None:
        """Appends pictures, (n, H, W, 3) uint8 or (n, H, W) float32 (m) that fit into the codec's range."""
        depth = self._codec.depth
        if depth is not None:
            from lerobot.datasets.depth_utils import quantize_depth

        for picture in pictures:
            if depth is None:
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            else:
                frame = quantize_depth(picture, **depth)
            self.container.mux(self.stream.encode(frame))

    def __exit__(self, *_: object) -> None:
        self.container.mux(self.stream.encode())
        self.container.close()


def _encoded(picture: np.ndarray, frame: int) -> dict[str, Any]:
    """A PNG of colours or a TIFF of distances, as `datasets.Image` stores it."""
    buffer = io.BytesIO()
    image, kind = Image.fromarray(np.ascontiguousarray(picture)), "png" if picture.ndim == 3 else "tiff"
    image.save(buffer, kind, **({"compress_level": 1} if kind == "png" else {}))
    return {"bytes": buffer.getvalue(), "path": f"frame-{frame:06d}.{kind}"}


def _arrow(column: Any, field: pa.Field) -> pa.Array:
    if isinstance(column, list) or column.ndim == 1:
        return pa.array(column, field.type)
    flat = pa.array(column.astype(np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, column.shape[1]).cast(field.type)


def digest(arrays: dict[str, np.ndarray], so_far: Any = None) -> Any:
    """SHA-256 of a block of source frames, continued from the block before."""
    so_far = so_far or hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        so_far.update(f"{key} {array.dtype.str} {array.shape}".encode())
        so_far.update(array)
    return so_far
