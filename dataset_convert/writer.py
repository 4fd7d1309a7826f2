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
from collections import Counter, defaultdict
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

from dataset_convert.calvin import FPS

type Stats = dict[str, dict[str, np.ndarray]]
"""Feature -> name of a statistic -> its value."""

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""LeRobot's."""


@dataclass
class RGBEncoder:
    """How videos are encoded, in LeRobot's words.

    H.264 at these settings keeps pictures as well as LeRobot's default (libsvtav1, crf 30) in a tenth of the time,
    takes a sixth more bytes, and decodes faster (docs/dataset.md).
    """

    # codec, as LeRobot names it
    vcodec: str = "h264"
    # quality: lower is better and larger
    crf: int = 18
    # speed against size, in the codec's words; empty: the codec's default
    preset: str = "veryfast"
    # distance of key frames; 2 lets training jump to any frame
    g: int = 2


@dataclass(frozen=True)
class Codec:
    """How a video is encoded, in the words of FFmpeg.

    Attributes:
        name: of the codec.
        pix_fmt: pixel format.
        options: the codec's.
        depth: arguments of LeRobot's ``quantize_depth``; None for colours.
    """

    name: str
    pix_fmt: str
    options: dict[str, str]
    depth: dict[str, Any] | None = None


@dataclass(frozen=True)
class Picture:
    """One camera feature.

    Attributes:
        key: LeRobot's feature.
        array: CALVIN's array.
        channels: which part of the array's last axis, ``slice(None)`` for all of it.
        shape: (H, W, C) of the feature.
        codec: of its video; None: single pictures in the parquet files (PNG, depth as 32-bit float TIFF).
    """

    key: str
    array: str
    channels: slice | int
    shape: tuple[int, int, int]
    codec: Codec | None = None

    @property
    def is_depth(self) -> bool:
        """Whether it holds distances (m) and not colours."""
        return self.shape[2] == 1

    def of(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Its pictures among a block's arrays: (n, H, W, 3) uint8, or (n, H, W) float32 (m)."""
        found = arrays[self.array]
        if self.is_depth:
            found = found if found.ndim == 3 else found[..., self.channels]
            return found.astype(np.float32)
        return found[..., self.channels]


@dataclass(frozen=True)
class Layout:
    """How the frame tables and videos look.

    Attributes:
        schema: of the parquet files.
        pictures: all camera features.
        chunks_size: files per folder.
        data_path, video_path: LeRobot's templates.
    """

    schema: pa.Schema
    pictures: tuple[Picture, ...]
    chunks_size: int
    data_path: str
    video_path: str

    def numbers(self, shard: int) -> dict[str, int]:
        """Chunk and file number of a shard."""
        chunk, file = divmod(shard, self.chunks_size)
        return {"chunk_index": chunk, "file_index": file}

    def data_file(self, shard: int) -> str:
        """The shard's frame table, relative to the dataset's folder."""
        return self.data_path.format(**self.numbers(shard))

    def video_file(self, shard: int, key: str) -> str:
        """The shard's video of one camera, relative to the dataset's folder."""
        return self.video_path.format(video_key=key, **self.numbers(shard))

    def files(self, shard: int) -> list[str]:
        """All files of a shard's frames."""
        videos = [self.video_file(shard, picture.key) for picture in self.pictures if picture.codec]
        return [self.data_file(shard), *videos]


@dataclass
class Block:
    """Some consecutive frames of an episode.

    Attributes:
        columns: vector features by name, (n, length) or (n,).
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
        shard: its number.
        first_episode: number of its first episode.
        first_index: absolute index of its first frame.
    """

    shard: int
    first_episode: int
    first_index: int


@dataclass
class Written:
    """What became of a shard.

    Attributes:
        rows: one of meta/episodes per episode, without statistics.
        stats: each episode's.
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
        root: the dataset's folder.
        layout: how its files look.
        place: the shard's numbers.
        episodes: yields the shard's episodes one at a time, each as its number of frames and its blocks: one block
            is in memory.
        tasks: sentences in the order of their numbers.
    """
    data_path = root / layout.data_file(place.shard)
    data_path.parent.mkdir(parents=True, exist_ok=True)
    written = Written()
    has_depth = any(picture.is_depth for picture in layout.pictures)
    index = place.first_index
    with ExitStack() as stack:
        videos = {
            picture.key: stack.enter_context(
                Video(root / layout.video_file(place.shard, picture.key), picture)
            )
            for picture in layout.pictures
            if picture.codec
        }
        data = stack.enter_context(pq.ParquetWriter(data_path, layout.schema))
        for number, (length, blocks) in enumerate(episodes, start=place.first_episode):
            stats = EpisodeStats()
            sampled = _sampled(length) if has_depth else np.ones(length, dtype=bool)
            n = 0
            for block in blocks:
                size = len(block.tasks)
                columns: dict[str, Any] = {
                    **block.columns,
                    "timestamp": (np.arange(n, n + size) / FPS).astype(np.float32),
                    "frame_index": np.arange(n, n + size),
                    "episode_index": np.full(size, number),
                    "index": np.arange(index + n, index + n + size),
                    "task_index": block.tasks,
                }
                stats.add(columns)
                for picture in layout.pictures:
                    pictures = picture.of(block.arrays)
                    stats.add_pictures(
                        picture, pictures[sampled[n : n + size]] if picture.is_depth else pictures
                    )
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
                row[f"videos/{key}/from_timestamp"] = (index - place.first_index) / FPS
                row[f"videos/{key}/to_timestamp"] = (index - place.first_index + n) / FPS
            written.rows.append(row)
            written.stats.append(stats.result())
            index += n
    return written


class EpisodeStats:
    """What LeRobot's ``compute_episode_stats`` computes, block by block and exactly.

    LeRobot fills a histogram of 5000 bins per dimension to read quantiles from, 25 ms per episode and 8 ms per frame
    with pictures. Sorting, and counting colours, give the same quantiles exactly instead of to within a bin (the
    smallest value that at least a share q of the samples do not exceed) in a thirtieth of the time. LeRobot looks at
    every picture of an episode of up to 100 frames and at fewer of a longer one; here all colours are counted. Depth
    goes through LeRobot's own histograms, which take the pictures that LeRobot looks at block by block.
    """

    def __init__(self) -> None:
        self._columns: dict[str, list[np.ndarray]] = defaultdict(list)
        self._colours: dict[str, np.ndarray] = {}
        self._depths: dict[str, Any] = {}
        self._depth_pictures: Counter[str] = Counter()
        self._frames = 0

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Takes a block's vectors, each (n,) or (n, length)."""
        for key, column in columns.items():
            self._columns[key].append(column)
        self._frames += len(next(iter(columns.values())))

    def add_pictures(self, picture: Picture, pictures: np.ndarray) -> None:
        """Takes a block's pictures of one camera: all colours, (n, H, W, 3), or some distances, (n, H, W)."""
        if picture.is_depth:
            from lerobot.datasets.compute_stats import RunningQuantileStats

            if len(pictures):
                running = self._depths.setdefault(picture.key, RunningQuantileStats())
                running.update(pictures.reshape(-1, 1))
                self._depth_pictures[picture.key] += len(pictures)
            return
        flat = np.ascontiguousarray(pictures).reshape(-1, pictures.shape[2], 3)
        counts = np.array(Image.fromarray(flat).histogram(), dtype=np.int64).reshape(3, 256)
        self._colours[picture.key] = self._colours.get(picture.key, 0) + counts

    def in_order(self, key: str) -> list[int]:
        """A column's distinct values in the order in which they first occur."""
        return list(dict.fromkeys(np.concatenate(self._columns[key]).tolist()))

    def result(self) -> Stats:
        """Feature -> {"min", "max", "mean", "std", "count", "q01", …}, of shape (length,), for cameras (C, 1, 1),
        colours in [0, 1] and distances in metres.
        """
        stats: Stats = {}
        for key, parts in self._columns.items():
            column = np.concatenate(parts)
            values = np.sort(column.reshape(len(column), -1).astype(np.float64), axis=0)
            stats[key] = {
                "min": values[0],
                "max": values[-1],
                "mean": values.mean(axis=0),
                "std": values.std(axis=0),
                "count": np.array([len(values)]),
            }
            for q in QUANTILES:
                stats[key][_name(q)] = values[max(int(np.ceil(q * len(values))) - 1, 0)]
        for key, counts in self._colours.items():
            stats[key] = _colour_stats(counts, self._frames)
        for key, running in self._depths.items():
            found = {name: value.reshape(1, 1, 1) for name, value in running.get_statistics().items()}
            stats[key] = {**found, "count": np.array([self._depth_pictures[key]])}
        return stats


def _sampled(length: int) -> np.ndarray:
    """Which pictures of an episode LeRobot's statistics look at: of 54,000 every fifteenth; (length,) bool."""
    from lerobot.datasets.compute_stats import sample_indices

    chosen = np.zeros(length, dtype=bool)
    chosen[sample_indices(length)] = True
    return chosen


def _name(q: float) -> str:
    return f"q{int(q * 100):02d}"


def _colour_stats(counts: np.ndarray, frames: int) -> dict[str, np.ndarray]:
    """From (3, 256) counts of the values of each channel."""
    levels = np.arange(256) / 255.0
    total = counts.sum(axis=1)
    cumulated = counts.cumsum(axis=1)
    mean = counts @ levels / total

    def level(at_least: np.ndarray) -> np.ndarray:
        return levels[(cumulated < at_least[:, None]).sum(axis=1)]

    stats = {
        "min": level(np.ones(3)),
        "max": level(total.astype(float)),
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
        **{_name(q): level(np.maximum(np.ceil(q * total), 1)) for q in QUANTILES},
    }
    shaped = {name: value.reshape(3, 1, 1) for name, value in stats.items()}
    return {**shaped, "count": np.array([frames])}


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
        stream: Any = self.container.add_stream(self._codec.name, FPS, options=options)
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
    """A PNG of colours or a TIFF of distances, as ``datasets.Image`` stores it."""
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
