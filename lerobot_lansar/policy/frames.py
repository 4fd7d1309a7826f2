"""All frames of one LeRobotDataset as memory-mapped arrays, ordered by LeRobot's absolute `index`.

Why: reading a window of 64 steps through LeRobot's delta timestamps costs 150 ms and more, from these arrays
0.05 ms. They are made from the dataset's parquet files at first use, kept in the dataset's folder (`CACHE`), and made
again when the dataset changed (`dataset_fingerprint`). CLIP embeddings of the pictures are not made here: see
`lerobot_lansar.clip.store`.
"""

import logging
import shutil
import uuid
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import load_tasks
from tqdm import tqdm

from ..clip.store import data_files, dataset_fingerprint

CACHE = ".cache/huggingface/lansar_frames"
"""The hub's client never uploads what lies in this folder of a dataset."""

COLUMNS = {"state": ("observation.state", 15), "environment_state": ("observation.environment_state", 24)}
COLUMNS["action"] = ("action", 7)
TASK_COLUMN = "calvin.task"


def read_frames(root: Path) -> dict[str, np.ndarray]:
    """Every frame's numbers from the parquet files, sorted by `index`.

    Returns:
        Index (T,) int64; state (T, 15), environment_state (T, 24), action (T, 7) float32; first and end (T,)
        int64: the rows where the frame's episode begins and ends (end exclusive).

    Raises:
        ValueError: A missing column, a wrong width, NaN or infinity, an index that occurs twice, an episode with
            more than one command.
    """
    parts: dict[str, list[np.ndarray]] = {}
    files = data_files(root)
    for path in tqdm(files, desc="Reading frames", disable=len(files) < 20):
        present = pq.read_schema(path).names
        wanted = ["index", "episode_index", "task_index", *(column for column, _ in COLUMNS.values())]
        missing = [name for name in wanted if name not in present]
        if missing:
            raise ValueError(
                f"{path} has no column {', '.join(missing)}; LanSAR trains on observation.state, "
                "observation.environment_state and action as lansar-convert writes them."
            )
        table = pq.read_table(path, columns=wanted)
        for name in ("index", "episode_index", "task_index"):
            parts.setdefault(name, []).append(table[name].to_numpy())
        for name, (column, width) in COLUMNS.items():
            values = np.concatenate([chunk.flatten().to_numpy() for chunk in table[column].chunks])
            if len(values) != width * len(table):
                raise ValueError(f"{path}: {column} must hold {width} numbers per frame.")
            values = values.reshape(-1, width).astype(np.float32)
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
                raise ValueError(
                    f"{path}: {column} is NaN or infinite in episode {parts['episode_index'][-1][row]} "
                    f"(index {parts['index'][-1][row]}). Remove the episode or convert the dataset again."
                )
            parts.setdefault(name, []).append(values)
    frames = {name: np.concatenate(values) for name, values in parts.items()}
    order = np.argsort(frames["index"], kind="stable")
    frames = {name: values[order] for name, values in frames.items()}
    if (np.diff(frames["index"]) < 1).any():
        raise ValueError(f"{Path(root) / 'data'} holds a frame index twice: files left over from before?")
    episode, task = frames.pop("episode_index"), frames.pop("task_index")
    starts = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
    changes = np.setdiff1d(np.flatnonzero(np.diff(task)) + 1, starts)
    if len(changes):
        raise ValueError(
            f"{root}: the command changes within episode {episode[changes[0]]} (index {frames['index'][changes[0]]}). "
            "LanSAR learns demonstrations of one command each: convert with lansar-convert --mode=windows."
        )
    ends = np.append(starts[1:], len(episode))
    frames["first"] = np.repeat(starts, ends - starts)
    frames["end"] = np.repeat(ends, ends - starts)
    return frames


def load_frames(root: Path) -> dict[str, np.ndarray]:
    """`read_frames` through the cache in `<root>/<CACHE>/<fingerprint>`; memory-mapped, read-only.

    A half-written cache is never seen: it is written beside and renamed. In a folder that cannot be written
    to the arrays are kept in memory, and read again next time.
    """
    root = Path(root)
    cache = root / CACHE / dataset_fingerprint(root)[:16]
    if not cache.is_dir():
        frames = read_frames(root)
        scratch = root / CACHE / f"{uuid.uuid4().hex}.partial"
        try:
            scratch.mkdir(parents=True)
            for name, values in frames.items():
                np.save(scratch / f"{name}.npy", values)
            scratch.rename(cache)
        except OSError as error:
            shutil.rmtree(scratch, ignore_errors=True)
            if not cache.is_dir():  # no other process was faster
                logging.warning(f"Cannot keep LanSAR's frame arrays in {cache} ({error.strerror}).")
                return frames
    names = ("index", *COLUMNS, "first", "end")
    return {name: np.load(cache / f"{name}.npy", mmap_mode="r") for name in names}


def load_sentences(root: Path) -> dict[str, set[int]]:
    """Which CALVIN tasks each of the dataset's sentences asks for; none where the frames do not say.

    They come from the frames' own columns, so that datasets edited or merged by LeRobot's tools have them too.

    Raises:
        ValueError: The dataset has no such column.
    """
    pairs: set[tuple[int, int]] = set()
    for path in data_files(root):
        if TASK_COLUMN not in pq.read_schema(path).names:
            raise ValueError(
                f"--policy.paraphrases and --policy.contrastive_weight need to know which CALVIN task a sentence asks "
                f"for; {path} has no column {TASK_COLUMN}, as lansar-convert writes it. Train without them."
            )
        columns = pq.read_table(path, columns=["task_index", TASK_COLUMN]).group_by(["task_index", TASK_COLUMN])
        pairs.update(tuple(row.values()) for row in columns.aggregate([]).to_pylist())
    sentences = load_tasks(Path(root)).reset_index().set_index("task_index")["task"]
    asked: dict[str, set[int]] = {}
    for index, task in sorted(pairs):
        asked.setdefault(sentences[index], set()).update({task} - {-1})
    return asked


def paraphrases(asked: dict[str, set[int]]) -> dict[str, list[str]]:
    """For each sentence the sentences that ask for its task, itself included; one that names two tasks keeps to
    sentences that do so too, and one that names none to itself.

    Args:
        asked: From `load_sentences`.
    """
    return {
        sentence: sorted(other for other in asked if tasks <= asked[other]) if tasks else [sentence]
        for sentence, tasks in asked.items()
    }
