"""Converts shards of episodes: anywhere, in any order, and again if their files are damaged."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_convert import blocks, checks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.episodes import Span, window_of_frames
from dataset_convert.frames import INTERVENTION, STATES, VECTORS, digest
from dataset_convert.layout import Layout
from dataset_convert.poses import pose_columns
from dataset_convert.shared import ValidationStates, key_of
from dataset_convert.writer import FrameBatch, ShardPosition, Written, write_shard
from lerobot_lansar.calvin import TASKS, continuous_euler
from lerobot_lansar.clip.store import sha256
from lerobot_lansar.datasets import INTERVENTION_FEATURE, IS_INTERVENTION, NO_COMMAND
from lerobot_lansar.jobs.staging import write_atomically

DATASET, SHARDS = "dataset", "shards"
"""Folders in a staging folder: what will be published, and one note per finished shard."""

BATCH_FRAMES = 256
"""Frames read at a time."""


@dataclass
class Job:
    """Everything that a worker needs to convert a shard; it is sent to every worker.

    Attributes:
        split: The source.
        folder: The staging folder.
        spans: The episodes in order.
        shards: (first, end) of each shard's episodes.
        layout: How the files look.
        action: `"rel"` or `"abs"`.
        scene_state: Keep the scene's state.
        task_in_state: Append the commanded task to it.
        block_orders: Scene to the colours of its block columns.
        sentences: The commands; a frame's `task_index` is a place in this list.
        task_names, scene_names: What the numbers in `calvin.task` and `calvin.scene` mean.
        skip_bad: Leave defective episodes out instead of stopping.
        camera_poses: The cameras' poses and intrinsics are observations too.
        interventions: Who acted: `"recorded"` in the frames, `"all"` frames the demonstrator, `""` not said.
        also_checked: CALVIN's picture arrays that must be readable too, although the dataset may not hold them.
        validation: States by which frames that are in validation too are noted; None: they are not looked for.
    """

    split: CalvinSplit
    folder: Path
    spans: list[Span]
    shards: list[tuple[int, int]]
    layout: Layout
    action: str
    scene_state: bool
    task_in_state: bool
    block_orders: dict[str, tuple[str, ...]]
    sentences: list[str]
    task_names: list[str]
    scene_names: list[str]
    skip_bad: bool
    camera_poses: bool = False
    interventions: str = ""
    also_checked: tuple[str, ...] = ()
    validation: ValidationStates | None = None

    @property
    def dataset(self) -> Path:
        """The folder that will be published."""
        return self.folder / DATASET

    def episodes(self, shard: int) -> range:
        """Numbers of a shard's episodes."""
        return range(*self.shards[shard])

    def note(self, shard: int) -> Path:
        """The file that says that a shard is finished, and how; the table of its episodes is beside it."""
        return self.folder / SHARDS / f"{shard:06d}.json"

    def numbers(self) -> list[str]:
        """CALVIN's arrays that are needed, but pictures."""
        return [*VECTORS, *(INTERVENTION if self.interventions == "recorded" else ())]

    def arrays(self) -> list[str]:
        """CALVIN's picture arrays that are needed."""
        return list(dict.fromkeys([*self.stored_arrays(), *self.also_checked]))

    def stored_arrays(self) -> list[str]:
        """CALVIN's picture arrays that the dataset holds."""
        return list(dict.fromkeys(picture.array for picture in self.layout.pictures))

    def limits(self) -> dict[str, tuple[float, float]]:
        """CALVIN's arrays that become depth videos, and the distances (m) that these can hold."""
        codecs = {picture.array: picture.codec for picture in self.layout.pictures}
        return {
            array: (codec.depth["depth_min"], codec.depth["depth_max"])
            for array, codec in codecs.items()
            if codec and codec.depth
        }


@dataclass
class Seen:
    """What writing a shard showed of its source.

    Attributes:
        hashes: Of each written episode's source frames.
        shared: Frames that are in validation too.
    """

    hashes: list[str] = field(default_factory=list)
    shared: set[int] = field(default_factory=set)


class BadEpisode(Exception):
    """An episode of the source is defective.

    Attributes:
        number: Its number among the job's spans.
        reason: The error that reading it gave.
    """

    def __init__(self, number: int, reason: Exception):
        super().__init__(number, reason)
        self.number, self.reason = number, reason


def staging_of(output_dir: Path) -> Path:
    """Where a dataset is prepared: a hidden folder beside its place, on the same file system.

    Raises:
        ValueError: Its place is a file system of its own, into which no folder can be moved.
    """
    if output_dir.is_mount():
        raise ValueError(f"--output_dir={output_dir} is a mount point: give a folder in it")
    return output_dir.parent / f".{output_dir.name}.incomplete"


def cut_into_shards(lengths: list[int], max_frames: int, min_shards: int = 16) -> list[tuple[int, int]]:
    """Cuts the episodes into runs of about equally many frames.

    The cuts depend on the episodes alone, so the files are the same for any number of workers.

    Args:
        lengths: Frames of each episode.
        max_frames: A shard is closed when it reaches this many frames.
        min_shards: Make the shards smaller to get about this many from few frames.

    Returns:
        (first, end) of each shard's episodes.
    """
    size = min(max_frames, -(-sum(lengths) // min_shards))
    shards, first, frames = [], 0, 0
    for number, length in enumerate(lengths):
        frames += length
        if frames >= size:
            shards.append((first, number + 1))
            first, frames = number + 1, 0
    return [*shards, (first, len(lengths))] if first < len(lengths) else shards


def frames_done(folder: Path) -> int:
    """Frames of all shards in a staging folder that are written."""
    return sum(int(file.read_text() or 0) for file in (folder / SHARDS).glob("*.count"))


def describe(span: Span) -> dict[str, Any]:
    """An episode's place in the source, for the manifest."""
    return {"start": span.start, "end": span.end, "scene": span.scene, "windows": list(span.windows)}


# ---- one shard: write the good episodes, note


def convert_shard(job: Job, shard: int) -> None:
    """Writes one shard, unless it is there already.

    Raises:
        FileNotFoundError, ValueError: The source is defective and `skip_bad` is off.
    """
    note = job.note(shard)
    if note.exists() and _is_intact(job, note):
        return
    note.unlink(missing_ok=True)
    written, seen, bad = _write_good(job, shard)
    _take_note(job, shard, bad, written, seen)


def _is_intact(job: Job, note: Path) -> bool:
    """Whether a finished shard's files are unchanged."""
    content = json.loads(note.read_text())
    table = note.with_suffix(".parquet")
    files = {job.dataset / name: sha for name, sha in content["files"].items()}
    return table.exists() and all(path.exists() and sha256(path) == sha for path, sha in files.items())


def _find_bad(job: Job, shard: int) -> dict[int, str]:
    """Episodes with defective vectors, and why; pictures take longer to read and show their defects when written."""
    bad = {}
    for number in job.episodes(shard):
        try:
            for _ in _read_batches(job, number, with_pictures=False):
                pass
        except BadEpisode as error:
            bad[number] = str(error.reason)
    return bad


def _write_good(job: Job, shard: int) -> tuple[Written, Seen, dict[int, str]]:
    """Writes the episodes that are not defective; the others are returned with what is wrong with them."""
    bad: dict[int, str] = {}
    first = job.shards[shard][0]
    position = ShardPosition(shard, first, sum(len(span) for span in job.spans[:first]))
    while True:
        progress = _Progress(job.note(shard).with_suffix(".count"))
        seen = Seen()
        good = (number for number in job.episodes(shard) if number not in bad)
        episodes = ((len(job.spans[number]), _observed(job, number, progress, seen)) for number in good)
        try:
            written = write_shard(job.dataset, job.layout, position, episodes, job.sentences)
        except BadEpisode as error:
            if not job.skip_bad:
                raise error.reason from None
            bad = bad or _find_bad(job, shard)
            bad.setdefault(error.number, str(error.reason))  # a part of it was written: write the others again
        else:
            progress.set(sum(len(job.spans[number]) for number in job.episodes(shard)))
            return written, seen, bad


def _take_note(job: Job, shard: int, bad: dict[int, str], written: Written, seen: Seen) -> None:
    """Notes that a shard is finished: its episodes, what was left out and why, the hashes of its files."""
    kept = [number for number in job.episodes(shard) if number not in bad]
    files = job.layout.files(shard)
    if not kept:
        for name in files:
            (job.dataset / name).unlink(missing_ok=True)
    _write_rows(job.note(shard).with_suffix(".parquet"), written)
    content = {
        "episodes": [{"number": n, "sha256": sha} for n, sha in zip(kept, seen.hashes, strict=True)],
        "shared": sorted(seen.shared),
        "left_out": [describe(job.spans[number]) | {"reason": reason} for number, reason in bad.items()],
        "files": {name: sha256(job.dataset / name) for name in files} if kept else {},
    }
    write_atomically(job.note(shard), json.dumps(content))


def _write_rows(path: Path, written: Written) -> None:
    """Writes a table of meta/episodes; `finish` renumbers it if an earlier episode was left out."""
    table = []
    for row, stats in zip(written.rows, written.stats, strict=True):
        flat = {f"stats/{key}/{name}": v.tolist() for key, of in stats.items() for name, v in of.items()}
        file = {f"meta/episodes/{name}": row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table.append({**row, **flat, **file})
    pq.write_table(pa.Table.from_pylist(table), path)


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


# ---- one episode: from the source's arrays to the dataset's columns


def _observed(job: Job, number: int, progress: _Progress, seen: Seen) -> Iterator[FrameBatch]:
    """An episode's batches; what they show of the source is added to `seen`."""
    state = None
    for batch, arrays in _read_batches(job, number, with_pictures=True):
        state = digest({key: arrays[key] for key in (*job.numbers(), *job.stored_arrays())}, state)
        if job.validation is not None:
            keys = np.array([key_of(*rows) for rows in zip(*(arrays[key] for key in STATES), strict=True)], np.uint64)
            seen.shared.update(job.validation.among(job.split.folder, batch.columns["calvin.frame"], keys))
        yield batch
        progress.add(len(batch))
    assert state is not None
    seen.hashes.append(state.hexdigest())


def _read_batches(job: Job, number: int, with_pictures: bool) -> Iterator[tuple[FrameBatch, dict[str, np.ndarray]]]:
    """An episode's batches, each with the source's arrays as they were read.

    Raises:
        BadEpisode: The source is defective.
    """
    span = job.spans[number]
    windows = window_of_frames(span, job.split.windows)
    keys = [*job.numbers(), *(job.arrays() if with_pictures else [])]
    for start in range(span.start, span.end, BATCH_FRAMES):
        frames = range(start, min(start + BATCH_FRAMES, span.end))
        try:
            arrays = job.split.read(frames, keys)
            checks.check_frames(arrays, frames, job.split, job.limits())
        except (FileNotFoundError, ValueError) as error:
            raise BadEpisode(number, error) from error
        here = windows[start - span.start :][: len(frames)]
        yield to_batch(job, span, frames, here, arrays), arrays


def to_batch(job: Job, span: Span, frames: range, windows: np.ndarray, arrays: dict[str, np.ndarray]) -> FrameBatch:
    """Turns n source frames into what the dataset holds.

    Args:
        job: Says how.
        span: Their episode.
        frames: Their numbers.
        windows: (n,) window that each belongs to; -1 for none, a frame of play without a command.
        arrays: CALVIN's arrays, each (n, ...).
    """
    listed, numbers = job.split.windows, windows.tolist()
    task_of = {w: job.task_names.index(listed[w].task) if w >= 0 else -1 for w in set(numbers)}
    sentence_of = {w: job.sentences.index(listed[w].sentence if w >= 0 else NO_COMMAND) for w in set(numbers)}
    tasks = np.array([task_of[w] for w in numbers])
    scene = blocks.reorder_blocks(arrays["scene_obs"], job.block_orders[span.scene])
    told = [scene] if job.scene_state else []
    if job.task_in_state:
        told.append(tasks[:, None] == np.arange(len(TASKS)))
    absolute, relative = with_continuous_angles(arrays["actions"]), arrays["rel_actions"]
    is_absolute = job.action == "abs"
    vectors = {
        "observation.state": with_continuous_angles(arrays["robot_obs"]),
        **({"observation.environment_state": np.concatenate(told, axis=1)} if told else {}),
        "action": absolute if is_absolute else relative,
        "calvin.rel_actions" if is_absolute else "calvin.actions": relative if is_absolute else absolute,
        **pose_columns(arrays["robot_obs"], job.layout.camera_sizes(), job.camera_poses),
    }
    columns = {
        **{key: vector.astype(np.float32) for key, vector in vectors.items()},
        "calvin.frame": np.arange(frames.start, frames.stop),
        "calvin.window": windows,
        "calvin.task": tasks,
        "calvin.scene": np.full(len(frames), job.scene_names.index(span.scene)),
    }
    if job.interventions:
        acted = arrays[IS_INTERVENTION][:, 0] if job.interventions == "recorded" else np.ones(len(frames), bool)
        columns[INTERVENTION_FEATURE] = acted
    sentences = np.array([sentence_of[w] for w in numbers])
    return FrameBatch(columns, sentences, {key: arrays[key] for key in job.stored_arrays() if key in arrays})


def with_continuous_angles(poses: np.ndarray) -> np.ndarray:
    """TCP poses, with whatever follows them, with `continuous_euler` angles: (n, 15) states or (n, 7) actions."""
    turned = poses.copy()
    turned[:, 3:6] = continuous_euler(poses[:, 3:6])
    return turned
