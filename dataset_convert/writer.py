"""Writes the frames of a LeRobotDataset v3, shard by shard.

A shard is a run of consecutive episodes: one parquet file of frames, one mp4 per camera and one table of episode
metadata, all with the same chunk and file number. Shards do not depend on each other, so several processes, on several
machines, can write them; `dataset_convert.features` writes the files that describe the whole.

Why not LeRobot's own recorder: it is made for one robot at 30 Hz and takes 100 to 600 ms per episode, most of it for
statistics and for muxing the growing mp4 again (measured with LeRobot 0.6.1). The tests compare these files with its.
"""

import io
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from dataset_convert.layout import Codec, Layout, Picture
from dataset_convert.stats import EpisodeStats, Stats, sampled
from lerobot_lansar.calvin import CONTROL_HZ


@dataclass
class FrameBatch:
    """Some consecutive frames of an episode.

    Attributes:
        columns: Vector features by name, (n, length) or (n,).
        sentences: (n,) each frame's command, LeRobot's `task_index`.
        arrays: CALVIN's picture arrays, each (n, ...).
    """

    columns: dict[str, np.ndarray]
    sentences: np.ndarray
    arrays: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.sentences)


@dataclass
class ShardPosition:
    """Where a shard lies in the dataset; known before anything is written, as the source tells every episode's length.

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
    """What a shard's episodes add to the dataset's metadata.

    Attributes:
        rows: Each episode's row of meta/episodes, without statistics.
        stats: Each episode's statistics.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    stats: list[Stats] = field(default_factory=list)


def write_shard(
    root: Path,
    layout: Layout,
    position: ShardPosition,
    episodes: Iterable[tuple[int, Iterator[FrameBatch]]],
    sentences: list[str],
) -> Written:
    """Writes one shard's frame table and videos.

    Args:
        root: The dataset's folder.
        layout: How its files look.
        position: The shard's numbers.
        episodes: Yields the shard's episodes one at a time, each as its number of frames and its batches; only one
            batch is in memory.
        sentences: The commands, in the order of their numbers.
    """
    data_path = root / layout.data_file(position.shard)
    data_path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as files:
        videos = {
            picture.key: files.enter_context(Video(root / layout.video_file(position.shard, picture.key), picture))
            for picture in layout.pictures
            if picture.codec
        }
        table = files.enter_context(pq.ParquetWriter(data_path, layout.schema))
        writer = _ShardWriter(layout, position, sentences, table, videos)
        for length, batches in episodes:
            writer.add_episode(length, batches)
    return writer.written


class _ShardWriter:
    """Appends episodes to a shard's open files.

    Attributes:
        written: The metadata of the episodes so far.
    """

    def __init__(
        self,
        layout: Layout,
        position: ShardPosition,
        sentences: list[str],
        table: pq.ParquetWriter,
        videos: dict[str, "Video"],
    ):
        self.written = Written()
        self._layout, self._position, self._sentences = layout, position, sentences
        self._table, self._videos = table, videos
        self._has_depth = any(picture.is_depth for picture in layout.pictures)
        self._episode, self._index = position.first_episode, position.first_index

    def add_episode(self, length: int, batches: Iterable[FrameBatch]) -> None:
        """Writes an episode of `length` frames."""
        stats = EpisodeStats()
        is_sampled = sampled(length) if self._has_depth else np.ones(length, dtype=bool)
        frames = 0
        for batch in batches:
            self._add_batch(batch, frames, stats, is_sampled[frames : frames + len(batch)])
            frames += len(batch)
        self.written.rows.append(self._row(frames, stats))
        self.written.stats.append(stats.result())
        self._episode += 1
        self._index += frames

    def _add_batch(self, batch: FrameBatch, first: int, stats: EpisodeStats, is_sampled: np.ndarray) -> None:
        """Writes the batch that begins at frame `first` of the episode."""
        columns: dict[str, Any] = {**batch.columns, **self._numbers(batch, first)}
        stats.add(columns)
        for picture in self._layout.pictures:
            pictures = picture.of(batch.arrays)
            stats.add_pictures(picture, pictures[is_sampled] if picture.is_depth else pictures)
            if picture.key in self._videos:
                self._videos[picture.key].add(pictures)
            else:
                columns[picture.key] = [_encoded(p, frame) for frame, p in enumerate(pictures, start=first)]
        # One row group per batch, so one per episode unless it is long; LeRobot writes one per episode.
        schema = self._layout.schema
        arrays = [_arrow(columns[feature.name], feature) for feature in schema]
        self._table.write_table(pa.Table.from_arrays(arrays, schema=schema))

    def _numbers(self, batch: FrameBatch, first: int) -> dict[str, np.ndarray]:
        """LeRobot's own columns."""
        frames = np.arange(first, first + len(batch))
        return {
            "timestamp": (frames / CONTROL_HZ).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(len(batch), self._episode),
            "index": self._index + frames,
            "task_index": batch.sentences,
        }

    def _row(self, frames: int, stats: EpisodeStats) -> dict[str, Any]:
        """The episode's row of meta/episodes: where its `frames` frames lie."""
        numbers = self._layout.numbers(self._position.shard)
        row = {
            "episode_index": self._episode,
            "tasks": [self._sentences[number] for number in stats.in_order("task_index")],
            "length": frames,
            **{f"data/{name}": value for name, value in numbers.items()},
            "dataset_from_index": self._index,
            "dataset_to_index": self._index + frames,
        }
        before = self._index - self._position.first_index
        for key in self._videos:
            row |= {f"videos/{key}/{name}": value for name, value in numbers.items()}
            row[f"videos/{key}/from_timestamp"] = before / CONTROL_HZ
            row[f"videos/{key}/to_timestamp"] = (before + frames) / CONTROL_HZ
        return row


class Video:
    """An mp4 file that takes pictures one by one."""

    def __init__(self, path: Path, picture: Picture):
        assert picture.codec is not None
        self._codec = picture.codec
        path.parent.mkdir(parents=True, exist_ok=True)
        av.logging.set_level(av.logging.ERROR)  # otherwise x264 prints a dozen lines per file
        self.container: Any = av.open(str(path), "w")
        stream: Any = self.container.add_stream(self._codec.name, CONTROL_HZ, options=_options(self._codec))
        stream.codec_context.thread_count = 1  # workers share the cores
        stream.pix_fmt = self._codec.pix_fmt
        stream.height, stream.width = picture.shape[:2]
        self.stream = stream

    def __enter__(self) -> "Video":
        return self

    def add(self, pictures: np.ndarray) -> None:
        """Appends pictures.

        Args:
            pictures: (n, H, W, 3) uint8, or (n, H, W) float32 distances (m) within the codec's range.
        """
        depth = self._codec.depth
        if depth is not None:
            from lerobot.datasets.depth_utils import quantize_depth  # seconds; workers need it for depth alone

        for picture in pictures:
            if depth is None:
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            else:
                frame = quantize_depth(picture, **depth)
            self.container.mux(self.stream.encode(frame))

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.container.mux(self.stream.encode())
                self.container.close()
        finally:
            with suppress(OSError):  # on a full disk; a container that is not closed prints a traceback when freed
                self.container.close()


def _options(codec: Codec) -> dict[str, str]:
    """The codec's options, made quiet and repeatable."""
    options = dict(codec.options)
    if "x265-params" in options:  # x265 does not go through libav's log
        options["x265-params"] += ":log-level=error"
    if av.codec.Codec(codec.name, "w").name == "libx264":
        # Without it x264's AVX-512 code lets uninitialised memory decide the first frames: other bytes in every run.
        options["x264-params"] = "cpu-independent=1"
    return options


def _encoded(picture: np.ndarray, frame: int) -> dict[str, Any]:
    """A PNG of colours or a TIFF of distances, as `datasets.Image` stores it."""
    buffer = io.BytesIO()
    image, kind = Image.fromarray(np.ascontiguousarray(picture)), "png" if picture.ndim == 3 else "tiff"
    image.save(buffer, kind, **({"compress_level": 1} if kind == "png" else {}))
    return {"bytes": buffer.getvalue(), "path": f"frame-{frame:06d}.{kind}"}


def _arrow(column: Any, feature: pa.Field) -> pa.Array:
    if isinstance(column, list) or column.ndim == 1:
        return pa.array(column, feature.type)
    flat = pa.array(column.astype(np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, column.shape[1]).cast(feature.type)
