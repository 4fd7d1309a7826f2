"""All frames of one LeRobotDataset as memory-mapped arrays, ordered by LeRobot's absolute `index`.

Why: reading a window of 64 steps through LeRobot's delta timestamps costs 150 ms and more, from these arrays
0.05 ms. They are made from the dataset's parquet files at first use, kept in the dataset's folder (`CACHE`), and made
again when the dataset changed (`dataset_fingerprint`). CLIP embeddings of the pictures are not made here:
`lansar-convert` and `lansar-embed` put them into `<root>/clip` (see `clip_dir`).
"""

import hashlib
import json
import logging
import shutil
import uuid
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import load_tasks
from tqdm import tqdm

CACHE = ".cache/huggingface/lansar_frames"
"""The hub's client never uploads what lies in this folder of a dataset."""

COLUMNS = {"state": ("observation.state", 15), "environment_state": ("observation.environment_state", 24)}
COLUMNS["action"] = ("action", 7)
TASK_COLUMN = "calvin.task"
CAMERAS = {"static": "observation.images.static", "gripper": "observation.images.gripper"}


def clip_dir(root: Path) -> Path:
    """Where a dataset keeps its CLIP embeddings.

    It holds `observation.images.static.npy` and `observation.images.gripper.npy`, (total_frames, D) float16
    each in the order of `index`, and `clip.json` {model, pretrained, weights_sha256, embed_dim, frames,
    fingerprint}.
    """
    return Path(root) / "clip"


def data_files(root: Path) -> list[Path]:
    """The dataset's frame tables, in order.

    Raises:
        FileNotFoundError: there are none.
    """
    files = sorted((Path(root) / "data").rglob("*.parquet"))
    if not files:
        raise FileNotFoundError(
            f"{Path(root) / 'data'} has no parquet files: not a complete LeRobotDataset v3."
        )
    return files


def dataset_fingerprint(root: Path) -> str:
    """Identifies the contents of a dataset's frame tables, the same wherever the dataset lies.

    Of each parquet file it reads name, size and the last 64 KiB: that is where parquet keeps row counts, the
    sizes of all column chunks and their smallest and largest values, so rewritten frames show, at once, unless they
    keep all of these to the byte.

    Args:
        root: the LeRobotDataset's folder.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for path in data_files(root):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(root).as_posix()} {size}\n".encode())
        with path.open("rb") as file:
            file.seek(max(0, size - 65536))
            digest.update(file.read())
    return digest.hexdigest()


def read_frames(root: Path) -> dict[str, np.ndarray]:
    """Every frame's numbers from the parquet files, sorted by `index`.

    Returns:
        index (T,) int64; state (T, 15), environment_state (T, 24), action (T, 7) float32; first and end (T,)
        int64: the rows where the frame's episode begins and ends (end exclusive).

    Raises:
        ValueError: a missing column, a wrong width, NaN or infinity, an index that occurs twice, an episode with
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


def load_embeddings(root: Path, total_frames: int) -> tuple[dict[str, np.ndarray], dict]:
    """The dataset's CLIP embeddings.

    Args:
        root: the LeRobotDataset's folder.
        total_frames: frames in the whole dataset.

    Returns:
        {"static": (total_frames, D) float16, "gripper": ...} memory-mapped, by absolute index; the contents
        of clip.json.

    Raises:
        FileNotFoundError: the dataset has none.
        ValueError: they belong to other frames than the dataset's.
    """
    folder = clip_dir(root)
    needed = ["clip.json", *(f"{key}.npy" for key in CAMERAS.values())]
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{folder} lacks {', '.join(missing)}: the dataset has no CLIP embeddings of its pictures. "
            "Convert it with `lansar-convert --embed=true`, or train without: --policy.use_images=false. "
            "(With --dataset.episodes LeRobot fetches only a part from the hub: download the whole dataset.)"
        )
    info = json.loads((folder / "clip.json").read_text())
    arrays = {name: np.load(folder / f"{key}.npy", mmap_mode="r") for name, key in CAMERAS.items()}
    shape = (total_frames, info["embed_dim"])
    shapes = {array.shape for array in arrays.values()}
    if shapes != {shape} or info["fingerprint"] != dataset_fingerprint(root):
        raise ValueError(
            f"The CLIP embeddings in {folder} were made for other frames than the dataset now has "
            f"(arrays {shapes}, expected {shape}, or another fingerprint). "
            "Delete that folder and convert again with `lansar-convert --embed=true`; if the dataset came from "
            "the hub with --dataset.episodes, download all of it."
        )
    return arrays, info


def load_sentences(root: Path) -> dict[str, set[int]]:
    """Which CALVIN tasks each of the dataset's sentences asks for; none where the frames do not say.

    They come from the frames' own columns, so that datasets edited or merged by LeRobot's tools have them too.

    Raises:
        ValueError: the dataset has no such column.
    """
    pairs: set[tuple[int, int]] = set()
    for path in data_files(root):
        if TASK_COLUMN not in pq.read_schema(path).names:
            raise ValueError(
                f"--policy.paraphrases and --policy.contrastive_weight need to know which CALVIN task a sentence asks "
                f"for; {path} has no column {TASK_COLUMN}, as lansar-convert writes it. Train without them."
            )
        columns = pq.read_table(path, columns=["task_index", TASK_COLUMN]).group_by(
            ["task_index", TASK_COLUMN]
        )
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
        asked: from `load_sentences`.
    """
    return {
        sentence: sorted(other for other in asked if tasks <= asked[other]) if tasks else [sentence]
        for sentence, tasks in asked.items()
    }
