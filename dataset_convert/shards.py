"""The conversion's work: shards of episodes that can be written anywhere, in any order, and again."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_convert import checks
from dataset_convert.calvin import VECTORS, CalvinSplit
from dataset_convert.episodes import NO_COMMAND, Span, window_of_frames
from dataset_convert.layout import Layout
from dataset_convert.writer import Block, Place, Written, digest, write_shard
from lerobot_lansar.calvin import TASKS
from lerobot_lansar.clip.store import sha256
from lerobot_lansar.jobs.staging import write_atomically

DATASET, SHARDS = "dataset", "shards"
"""Folders in a staging folder: what will be published, and one note per finished shard."""

BLOCK = 256
"""Frames read at a time."""


@dataclass
class Job:
    """Everything that a shard's work needs; it is sent to every worker.

    Attributes:
        split: The source.
        folder: The staging folder.
        spans: The episodes in order.
        shards: (first, end) of each shard's episodes.
        layout: Of the files.
        action: "rel" or "abs".
        block_orders: Scene -> colours of its block columns.
        tasks: Sentences in the order of their numbers.
        task_names, scene_names: What the numbers in `calvin.task` and `calvin.scene` mean.
        skip_bad: Leave defective episodes out instead of stopping.
    """

    split: CalvinSplit
    folder: Path
    spans: list[Span]
    shards: list[tuple[int, int]]
    layout: Layout
    action: str
    task_in_state: bool
    block_orders: dict[str, tuple[str, ...]]
    tasks: list[str]
    task_names: list[str]
    scene_names: list[str]
    skip_bad: bool

    @property
    def dataset(self) -> Path:
        """The folder that will be published."""
        return self.folder / DATASET

    def note(self, shard: int) -> Path:
        """What a finished shard says of itself; the table of its episodes is beside it."""
        return self.folder / SHARDS / f"{shard:06d}.json"

    def arrays(self) -> list[str]:
        """CALVIN's picture arrays that are needed."""
        return list(dict.fromkeys(picture.array for picture in self.layout.pictures))

    def limits(self) -> dict[str, tuple[float, float]]:
        """For CALVIN's arrays that become depth videos the distances (m) that these can hold."""
        codecs = {picture.array: picture.codec for picture in self.layout.pictures}
        return {
            array: (codec.depth["depth_min"], codec.depth["depth_max"])
            for array, codec in codecs.items()
            if codec and codec.depth
        }


class BadEpisode(Exception):
    """An episode of the source is defective.

    Attributes:
        number: Its number among the job's spans.
        reason: The error it gave.
    """

    def __init__(self, number: int, reason: Exception):
        super().__init__(number, reason)
        self.number, self.reason = number, reason


def cut_into_shards(lengths: list[int], most: int, least: int = 16) -> list[tuple[int, int]]:
    """Runs of whole episodes, about equally long, as (first, end).

    The cut depends on the episodes alone, so the files are the same for any number of workers.

    Args:
        lengths: Frames of each episode.
        most: Frames that a shard should hold at most, when there are many.
        least: Shards that there should be at least, when there are few episodes.
    """
    size = min(most, -(-sum(lengths) // least))
    shards, first, frames = [], 0, 0
    for number, length in enumerate(lengths):
        frames += length
        if frames >= size:
            shards.append((first, number + 1))
            first, frames = number + 1, 0
    return [*shards, (first, len(lengths))] if first < len(lengths) else shards


def convert_shard(job: Job, shard: int) -> None:
    """Writes one shard, unless it is there already.

    Raises:
        FileNotFoundError, ValueError: The source is defective and `skip_bad` is off.
    """
    note = job.note(shard)
    if note.exists() and _is_intact(job, note):
        return
    note.unlink(missing_ok=True)
    first, end = job.shards[shard]
    bad: dict[int, str] = {}
    if job.skip_bad:
        for number in range(first, end):
            try:
                for _ in _blocks(job, number, with_pictures=False):
                    pass
            except BadEpisode as error:
                bad[number] = str(error.reason)
    before = [len(span) for span in job.spans[:first]]
    place = Place(shard, first, sum(before))
    while True:
        progress = _Progress(note.with_suffix(".count"))
        hashes: list[str] = []
        episodes = ((len(job.spans[n]), _hashed(job, n, progress, hashes)) for n in range(first, end) if n not in bad)
        try:
            written = write_shard(job.dataset, job.layout, place, episodes, job.tasks)
            break
        except BadEpisode as error:
            if not job.skip_bad:
                raise error.reason from None
            bad[error.number] = str(error.reason)  # it was partly written: write the others again
    progress.set(sum(len(span) for span in job.spans[first:end]))
    kept = [number for number in range(first, end) if number not in bad]
    if not kept:
        for name in job.layout.files(shard):
            (job.dataset / name).unlink(missing_ok=True)
    _write_rows(note.with_suffix(".parquet"), written)
    content = {
        "episodes": [{"number": n, "sha256": sha} for n, sha in zip(kept, hashes, strict=True)],
        "left_out": [describe(job.spans[number]) | {"reason": reason} for number, reason in bad.items()],
        "files": {name: sha256(job.dataset / name) for name in job.layout.files(shard)} if kept else {},
    }
    write_atomically(note, json.dumps(content))


def _hashed(job: Job, number: int, progress: "_Progress", hashes: list[str]) -> Iterator[Block]:
    """An episode's blocks; its hash is added to `hashes` after the last one."""
    state = None
    for block, arrays in _blocks(job, number, with_pictures=True):
        state = digest(arrays, state)
        yield block
        progress.add(len(block.tasks))
    assert state is not None
    hashes.append(state.hexdigest())


def _blocks(job: Job, number: int, with_pictures: bool) -> Iterator[tuple[Block, dict[str, np.ndarray]]]:
    """An episode's blocks with the source's arrays as they were read.

    Raises:
        BadEpisode: The source is defective.
    """
    span = job.spans[number]
    windows = window_of_frames(span, job.split.windows)
    keys = [*VECTORS, *(job.arrays() if with_pictures else [])]
    for start in range(span.start, span.end, BLOCK):
        frames = range(start, min(start + BLOCK, span.end))
        try:
            arrays = job.split.read(frames, keys)
            checks.check_frames(arrays, frames, job.split, job.limits())
        except (FileNotFoundError, ValueError) as error:
            raise BadEpisode(number, error) from error
        here = windows[start - span.start :][: len(frames)]
        yield to_block(job, span, frames, here, arrays), arrays


def to_block(job: Job, span: Span, frames: range, windows: np.ndarray, arrays: dict[str, np.ndarray]) -> Block:
    """A block of source frames as the dataset holds it.

    Args:
        job: What to make of them.
        span: Their episode.
        frames: Their numbers.
        windows: (n,) the window each belongs to, or -1.
        arrays: CALVIN's arrays.
    """
    # -1, "none", is a window that does not exist, a task and a sentence for play without a command
    listed = job.split.windows
    task_of = {n: job.task_names.index(listed[n].task) if n >= 0 else -1 for n in set(windows.tolist())}
    tasks = np.array([task_of[n] for n in windows.tolist()])
    scene = checks.reorder_blocks(arrays["scene_obs"], job.block_orders[span.scene])
    if job.task_in_state:
        scene = np.concatenate([scene, tasks[:, None] == np.arange(len(TASKS))], axis=1)
    absolute = job.action == "abs"
    other = "calvin.rel_actions" if absolute else "calvin.actions"
    columns = {
        "observation.state": arrays["robot_obs"],
        "observation.environment_state": scene,
        "action": checks.without_roll_jump(arrays["actions"]) if absolute else arrays["rel_actions"],
        other: arrays["rel_actions" if absolute else "actions"],
    }
    columns = {key: column.astype(np.float32) for key, column in columns.items()}
    sentence_of = {n: job.tasks.index(listed[n].sentence if n >= 0 else NO_COMMAND) for n in task_of}
    columns["calvin.frame"] = np.arange(frames.start, frames.stop)
    columns["calvin.window"] = windows
    columns["calvin.task"] = tasks
    columns["calvin.scene"] = np.full(len(frames), job.scene_names.index(span.scene))
    sentences = np.array([sentence_of[n] for n in windows.tolist()])
    return Block(columns, sentences, {key: arrays[key] for key in job.arrays() if key in arrays})


class _Progress:
    """How many frames of a shard are done, in a file that the process with the progress bar reads."""

    def __init__(self, file: Path):
        self._file, self._frames = file, 0
        self.add(0)

    def add(self, frames: int) -> None:
        self.set(self._frames + frames)

    def set(self, frames: int) -> None:
        self._frames = frames
        self._file.write_text(str(frames))


def frames_done(folder: Path) -> int:
    """Of all shards in a staging folder."""
    return sum(int(file.read_text() or 0) for file in (folder / SHARDS).glob("*.count"))


def _is_intact(job: Job, note: Path) -> bool:
    """Whether a finished shard's files are what they were."""
    content = json.loads(note.read_text())
    table = note.with_suffix(".parquet")
    files = {job.dataset / name: sha for name, sha in content["files"].items()}
    return table.exists() and all(path.exists() and sha256(path) == sha for path, sha in files.items())


def describe(span: Span) -> dict[str, Any]:
    """An episode's place in the source, for the manifest."""
    return {"start": span.start, "end": span.end, "scene": span.scene, "windows": list(span.windows)}


def _write_rows(path: Path, written: Written) -> None:
    """A table of meta/episodes; the numbers in it are right as long as no episode before was left out."""
    table = []
    for row, stats in zip(written.rows, written.stats, strict=True):
        flat = {f"stats/{key}/{name}": v.tolist() for key, of in stats.items() for name, v in of.items()}
        place = {f"meta/episodes/{name}": row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table.append({**row, **flat, **place})
    pq.write_table(pa.Table.from_pylist(table), path)
