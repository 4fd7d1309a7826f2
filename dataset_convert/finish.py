"""The conversion's last step: all shards become one dataset."""

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_convert import features
from dataset_convert.language import EMBEDDINGS, LANG_FOLDER, read_embeddings, write_embeddings
from dataset_convert.layout import RGBEncoder
from dataset_convert.shards import Job, describe
from dataset_convert.stats import Stats
from lerobot_lansar.clip.store import sha256
from lerobot_lansar.datasets import MANIFEST

_EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def finish(job: Job, info: Any, encoder: RGBEncoder, request: dict[str, Any], report: dict[str, Any]) -> dict[str, Any]:
    """Joins all shards to one dataset in the staging folder and describes it; may be done again.

    Args:
        job: The work, whose shards are all written.
        info: LeRobot's description.
        encoder: Encoded the colour videos.
        request: What was asked for.
        report: What else the manifest should say; `left_out` is completed here.

    Returns:
        The manifest, as written to `MANIFEST`.

    Raises:
        ValueError: Every episode was left out.
    """
    episodes, frames, first_shard = 0, 0, None
    files: dict[str, str] = {}
    left_out, kept = list(report["left_out"]), []
    shared = set(report["shared_frames"])
    stats: list[Stats] = []
    for shard in range(len(job.shards)):
        note = json.loads(job.note(shard).read_text())
        left_out += note["left_out"]
        shared.update(note["shared"])
        if not note["episodes"]:
            continue
        first_shard = shard if first_shard is None else first_shard
        table = pq.read_table(job.note(shard).with_suffix(".parquet"))
        files |= note["files"]
        if table["episode_index"][0].as_py() != episodes:
            table = _renumber(table, episodes, frames)
            data = job.layout.data_file(shard)
            _renumber_frames(job.dataset / data, episodes, frames)
            files[data] = sha256(job.dataset / data)
        path = job.dataset / _EPISODES_PATH.format(**job.layout.numbers(shard))
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
        episodes, frames = episodes + len(table), table["dataset_to_index"][-1].as_py()
        stats.append(features.merge_stats(_stats_of(table)))
        kept += note["episodes"]
    if first_shard is None:
        first = f"; the first: {left_out[0]['reason']}" if left_out else ""
        raise ValueError(f"{job.split.folder}: no episode is left to convert{first}")
    features.write_description(
        job.dataset,
        info,
        job.layout,
        encoder,
        first_shard,
        job.sentences,
        episodes,
        frames,
        features.merge_stats(stats),
    )
    if request.get("lang_embeddings"):
        rows = read_embeddings(job.split.language, len(job.split.windows))
        write_embeddings(job.dataset, request.get("lang_folder", LANG_FOLDER), rows)
    # The manifest is what is left in meta: it is written last and cannot hold its own hash.
    for path in sorted(path for part in ("meta", EMBEDDINGS) for path in (job.dataset / part).rglob("*")):
        if path.is_file() and path != job.dataset / MANIFEST:
            files[path.relative_to(job.dataset).as_posix()] = sha256(path)
    here = f"{job.split.root}{os.sep}"  # no path of this machine is published
    left_out = [{**episode, "reason": episode["reason"].replace(here, "")} for episode in left_out]
    orders = job.block_orders.items()
    manifest = {
        "request": request,
        "scenes": {s: {"frames": list(job.split.scenes[s]), "block_order": list(order)} for s, order in orders},
        "task_names": job.task_names,
        "scene_names": job.scene_names,
        "versions": {name: version(name) for name in ("lerobot_policy_lansar", "lerobot", "numpy", "av")},
        **report,
        "shared_frames": sorted(shared),
        "left_out": left_out,
        "windows": [
            {"start": w.start, "end": w.end, "task": w.task, "sentence": w.sentence, "scene": w.scene}
            for w in job.split.windows
        ],
        "episodes": [{**describe(job.spans[e["number"]]), "sha256": e["sha256"]} for e in kept],
        "files": files,
    }
    (job.dataset / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return manifest


def _stats_of(table: pa.Table) -> list[Stats]:
    """Each episode's statistics, out of its row of meta/episodes."""
    columns = {name: table[name].to_pylist() for name in table.column_names if name.startswith("stats/")}
    found: list[Stats] = [{} for _ in range(len(table))]
    for column, values in columns.items():
        _, key, name = column.split("/")
        for stats, value in zip(found, values, strict=True):
            stats.setdefault(key, {})[name] = np.array(value)
    return found


def _renumber(table: pa.Table, first_episode: int, first_index: int) -> pa.Table:
    """A table of meta/episodes, numbered from these on."""
    lengths = np.array(table["length"])
    ends = first_index + np.cumsum(lengths)
    columns: dict[str, Any] = {
        "episode_index": np.arange(first_episode, first_episode + len(table)),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
    for key, start in (("episode_index", "episode_index"), ("index", "dataset_from_index")):
        moved = columns[start] - np.array(table[start])
        for name in table.column_names:
            if name.startswith(f"stats/{key}/") and name.rsplit("/", 1)[1] not in ("std", "count"):
                numbers = np.array(table[name].to_pylist())
                columns[name] = (numbers + moved.reshape(-1, *[1] * (numbers.ndim - 1))).tolist()
    for name, values in columns.items():
        field = table.schema.field(name)
        table = table.set_column(table.schema.get_field_index(name), field, pa.array(values, field.type))
    return table


def _renumber_frames(path: Path, first_episode: int, first_index: int) -> None:
    """Numbers the episodes and frames of one file from these on; doing it again changes nothing."""
    partial = path.with_suffix(".partial")
    before, episode, index = None, first_episode - 1, first_index
    with pq.ParquetFile(path) as source, pq.ParquetWriter(partial, source.schema_arrow) as target:
        for group in range(source.num_row_groups):
            table = source.read_row_group(group)
            old = np.array(table["episode_index"])  # all of one episode: a row group is a batch
            episode += old[0] != before
            before = old[0]
            numbers = {
                "episode_index": np.full(len(old), episode),
                "index": np.arange(index, index + len(old)),
            }
            for name, values in numbers.items():
                field = table.schema.field(name)
                table = table.set_column(table.schema.get_field_index(name), field, pa.array(values, field.type))
            target.write_table(table)
            index += len(old)
    partial.rename(path)
