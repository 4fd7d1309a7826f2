"""All frames of a LeRobotDataset as memory-mapped arrays, in the order of LeRobot's absolute `index`.

Reading a window of 64 steps takes about 150 ms with LeRobot's delta timestamps, below 1 ms with these arrays. They are
made from the dataset's parquet files at first use, kept in the dataset's folder (`CACHE`), and made again when the
dataset has changed (`dataset_fingerprint`). So are the pictures, for a policy that learns to see. CLIP embeddings of
the pictures are separate: `lerobot_lansar.clip.store`.
"""

import json
import logging
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from filelock import FileLock
from lerobot.datasets.io_utils import load_tasks
from torch import Tensor
from tqdm import tqdm

from ..clip.store import IMAGE_FEATURES, data_files, dataset_fingerprint
from ..datasets import INTERVENTION_FEATURE
from ..jobs.staging import write_atomically
from .scaling import ENVIRONMENT_STATE_DIM, STATE_DIM

CACHE = ".cache/huggingface/lansar_frames"
"""Where a dataset keeps its arrays: the hub's client never uploads this folder."""

COLUMNS = {"state": ("observation.state", STATE_DIM), "action": ("action", 7)}
"""Array to the dataset's column and its width."""
SCENE = {"environment_state": ("observation.environment_state", ENVIRONMENT_STATE_DIM)}
"""The same, but there is no array where the column is missing or has another width."""
NUMBERS = ("index", "episode_index", "task_index")
"""LeRobot's columns with one number per frame that are read too."""
TASK_COLUMN = "calvin.task"
"""The column with the number of each frame's CALVIN task, -1 for none."""


FLAGS = {"is_intervention": INTERVENTION_FEATURE}
"""Array to the dataset's column, with one truth value per frame; without the column there is no array."""


def read_frames(root: Path) -> dict[str, np.ndarray]:
    """Reads every frame's numbers from the parquet files, sorted by `index`.

    Returns:
        Index (T,) int64; state (T, 15), action (T, 7) float32; first and end (T,) int64, the rows where the frame's
        episode begins and ends (end exclusive). If the dataset has it, environment_state (T, 24) float32 and
        is_intervention (T,) bool, whether the demonstrator acted.

    Raises:
        ValueError: A missing column, a wrong width, NaN or infinity, an index that occurs twice, or an episode with
            more than one command.
    """
    files = data_files(root)
    tables = [_read_file(path) for path in tqdm(files, desc="Reading frames", disable=len(files) < 20)]
    frames = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    order = np.argsort(frames["index"], kind="stable")
    frames = {name: values[order] for name, values in frames.items()}
    if (np.diff(frames["index"]) < 1).any():
        raise ValueError(f"{Path(root) / 'data'} holds a frame index twice: are there files of an older dataset?")
    episode, task = frames.pop("episode_index"), frames.pop("task_index")
    starts = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
    changes = np.setdiff1d(np.flatnonzero(np.diff(task)) + 1, starts)
    if len(changes):
        raise ValueError(
            f"{root}: the command changes within episode {episode[changes[0]]} (index {frames['index'][changes[0]]}). "
            "LanSAR learns from demonstrations of one command each: convert with lansar-convert --mode=windows."
        )
    ends = np.append(starts[1:], len(episode))
    frames["first"] = np.repeat(starts, ends - starts)
    frames["end"] = np.repeat(ends, ends - starts)
    return frames


def _read_file(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `NUMBERS` and `COLUMNS` in one parquet file; raises what `read_frames` does about columns."""
    present = pq.read_schema(path).names
    columns = COLUMNS | {name: entry for name, entry in SCENE.items() if entry[0] in present}
    wanted = [*NUMBERS, *(column for column, _ in columns.values())]
    missing = [name for name in wanted if name not in present]
    if missing:
        raise ValueError(
            f"{path} has no column {', '.join(missing)}; LanSAR trains on observation.state and action as "
            "lansar-convert writes them."
        )
    table = pq.read_table(path, columns=wanted)
    frames = {name: table[name].to_numpy() for name in NUMBERS}
    for name, (column, width) in columns.items():
        values = np.concatenate([chunk.flatten().to_numpy() for chunk in table[column].chunks])
        if len(values) != width * len(table):
            if name in SCENE:
                continue
            raise ValueError(f"{path}: {column} must hold {width} numbers per frame.")
        values = values.reshape(-1, width).astype(np.float32)
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise ValueError(
                f"{path}: {column} is NaN or infinite in episode {frames['episode_index'][row]} "
                f"(index {frames['index'][row]}). Remove the episode or convert the dataset again."
            )
        frames[name] = values
    for name, column in FLAGS.items():
        if column in present:
            frames[name] = pq.read_table(path, columns=[column])[column].to_numpy().astype(bool)
    return frames


def load_frames(root: Path) -> dict[str, np.ndarray]:
    """`read_frames` through the cache in `<root>/<CACHE>/<fingerprint>`; memory-mapped, read-only.

    The cache is written under another name and then renamed, so that nobody finds half of it. If the folder cannot be
    written to, the arrays stay in memory and are read again next time.
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
            if not cache.is_dir():  # not there either because another process was faster
                logging.warning(f"Cannot keep LanSAR's frame arrays in {cache} ({error.strerror}).")
                return frames
    there = [name for name in (*SCENE, *FLAGS) if (cache / f"{name}.npy").exists()]
    names = ["index", *COLUMNS, "first", "end", *there]
    return {name: np.load(cache / f"{name}.npy", mmap_mode="r") for name in names}


def load_pictures(root: Path, size: int, resize: Callable[[Tensor], Tensor]) -> dict[str, np.ndarray]:
    """The dataset's pictures in the order of LeRobot's absolute `index`, decoded once into files beside `CACHE`.

    An interrupted pass goes on where it was; of several processes one decodes and the others wait.

    Args:
        root: The dataset's folder.
        size: Larger pictures are brought to this height and width.
        resize: Does that: (B, 3, H, W) -> (B, 3, size, size), both in [0, 1].

    Returns:
        {"static": (total_frames, H, W, 3) uint8, "gripper": ...}, memory-mapped.

    Raises:
        ValueError: The dataset lacks one of the two cameras, or its folder cannot be written to or has not the space.
        FileNotFoundError: Video files are missing.
    """
    parent = root / f"{CACHE}_pictures"
    folder = parent / f"{dataset_fingerprint(root)[:16]}-{size}"
    if not folder.is_dir():
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(
                f"--policy.finetune_clip=true keeps decoded pictures in {parent}, which cannot be made "
                f"({error.strerror}): copy the dataset to a folder that can be written to."
            ) from error
        with FileLock(parent / "lock"):
            if not folder.is_dir():
                _decode_pictures(root, size, resize, folder.with_suffix(".partial"))
                folder.with_suffix(".partial").rename(folder)
    return {camera: np.load(folder / f"{camera}.npy", mmap_mode="r") for camera in IMAGE_FEATURES}


def _decode_pictures(root: Path, size: int, resize: Callable[[Tensor], Tensor], folder: Path) -> None:
    """Writes the files of `load_pictures`; `progress.json` says how many frames they hold."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata  # takes seconds

    meta = LeRobotDatasetMetadata("local/pictures", root=root)
    missing = set(IMAGE_FEATURES.values()) - set(meta.camera_keys)
    if missing:
        raise ValueError(
            f"--policy.finetune_clip=true needs the dataset's pictures, but {root} has no "
            f"{', '.join(sorted(missing))}: convert it with --images=video or png."
        )
    for feature in set(IMAGE_FEATURES.values()) & set(meta.video_keys):
        for episode in range(meta.total_episodes):
            if not (root / meta.get_video_file_path(episode, feature)).is_file():
                raise FileNotFoundError(
                    f"{root} lacks {meta.get_video_file_path(episode, feature)}: with --policy.finetune_clip=true "
                    "download the whole dataset, without --dataset.episodes."
                )
    sides = {c: min(size, *sorted(meta.features[f]["shape"])[1:]) for c, f in IMAGE_FEATURES.items()}
    needed, free = sum(3 * side**2 for side in sides.values()) * meta.total_frames, shutil.disk_usage(root).free
    if not folder.exists() and needed > free:
        raise ValueError(
            f"--policy.finetune_clip=true decodes the dataset's pictures into its folder {root}, which takes "
            f"{needed / 1e9:.0f} GB; {free / 1e9:.0f} GB are free."
        )
    dataset = LeRobotDataset("local/pictures", root=root)
    folder.mkdir(exist_ok=True)
    progress = folder / "progress.json"
    done = json.loads(progress.read_text()) if progress.exists() else 0
    arrays: dict[str, np.ndarray] = {}
    for camera, side in sides.items():
        file = folder / f"{camera}.npy"
        arrays[camera] = (
            np.load(file, mmap_mode="r+")
            if done
            else np.lib.format.open_memmap(file, "w+", np.uint8, (len(dataset), side, side, 3))
        )
    for row in tqdm(range(done, len(dataset)), initial=done, total=len(dataset), desc="decoding", unit="frame"):
        found = dataset[row]
        for camera, feature in IMAGE_FEATURES.items():
            picture = found[feature][None]
            picture = resize(picture) if picture.shape[-1] > size else picture
            arrays[camera][row] = (255 * picture[0]).round().to(torch.uint8).permute(1, 2, 0).numpy()
        if row % 1000 == 999:
            for array in arrays.values():
                array.flush()  # type: ignore[attr-defined]
            write_atomically(progress, json.dumps(row + 1))
    for array in arrays.values():
        array.flush()  # type: ignore[attr-defined]


def load_sentence_tasks(root: Path) -> dict[str, set[int]]:
    """The CALVIN tasks that each of the dataset's sentences can mean; an empty set where the frames name none.

    They are read from the frames' columns, so that datasets edited or merged by LeRobot's tools have them too.

    Raises:
        ValueError: The dataset has no such column.
    """
    pairs: set[tuple[int, int]] = set()
    for path in data_files(root):
        if TASK_COLUMN not in pq.read_schema(path).names:
            raise ValueError(
                f"--policy.paraphrases and --policy.contrastive_weight need the CALVIN task of each sentence, but "
                f"{path} has no column {TASK_COLUMN}, as lansar-convert writes it. Train without them."
            )
        columns = pq.read_table(path, columns=["task_index", TASK_COLUMN]).group_by(["task_index", TASK_COLUMN])
        pairs.update(tuple(row.values()) for row in columns.aggregate([]).to_pylist())
    sentences = load_tasks(Path(root)).reset_index().set_index("task_index")["task"]
    sentence_tasks: dict[str, set[int]] = {}
    for index, task in sorted(pairs):
        sentence_tasks.setdefault(sentences[index], set()).update({task} - {-1})
    return sentence_tasks


def find_paraphrases(sentence_tasks: dict[str, set[int]]) -> dict[str, list[str]]:
    """For each sentence all sentences that can mean its tasks, itself included.

    A sentence for two tasks is only paraphrased by sentences for both, and one for no task only by itself.

    Args:
        sentence_tasks: From `load_sentence_tasks`.
    """
    return {
        sentence: sorted(other for other in sentence_tasks if tasks <= sentence_tasks[other]) if tasks else [sentence]
        for sentence, tasks in sentence_tasks.items()
    }
