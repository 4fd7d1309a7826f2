"""``lansar-verify``: compares a converted dataset with its source, frame by frame."""

import io
import json
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import av
import draccus
import numpy as np
import pyarrow.parquet as pq
from draccus.utils import DraccusException
from PIL import Image
from tqdm import tqdm

from dataset_convert import checks
from dataset_convert.calvin import CAMERAS, DEPTH, FPS, TACTILE, VECTORS, CalvinSplit
from dataset_convert.convert import folder_of
from dataset_convert.episodes import NO_COMMAND, Span, window_of_frames
from dataset_convert.shards import sha256
from dataset_convert.writer import digest

_BETTER = 0.9  # of the squared error; a video of the desk that is a frame off has more than twice that of a right one


@dataclass
class VerifyConfig:
    """Compares every frame of a converted dataset with the CALVIN folder it came from."""

    # name of the dataset, you/name
    repo_id: str
    # folder of the CALVIN dataset, the one that holds training/ and validation/
    root: Path
    # the dataset's folder; by default where LeRobot looks for a dataset of that name
    dataset_dir: Path | None = None
    # smallest peak signal-to-noise ratio (dB) of a picture in a video; PNG must be equal
    min_psnr: float = 22.0
    # processes
    workers: int = 1


class Mismatch(Exception):
    """The dataset is not what its source says it should be."""


@dataclass
class Found:
    """What one file of frames holds.

    Attributes:
        frames: how many.
        psnr: feature -> signal-to-noise ratio (dB) of each picture.
        sums: feature -> (smallest, largest, sum) of each dimension.
    """

    frames: int = 0
    psnr: dict[str, list[float]] = field(default_factory=dict)
    sums: dict[str, list[np.ndarray]] = field(default_factory=dict)


class Dataset:
    """What a converted dataset says of itself, beside its source.

    Raises:
        FileNotFoundError: it is no dataset of ``lansar-convert``.
        Mismatch: it was made from another source.
    """

    def __init__(self, folder: Path, root: Path):
        self.folder = folder
        for name in ("meta/info.json", "meta/calvin_source.json"):
            if not (folder / name).is_file():
                raise FileNotFoundError(
                    f"{folder / name} is missing: --dataset_dir must hold a result of lansar-convert"
                )
        self.info = json.loads((folder / "meta/info.json").read_text())
        self.manifest = json.loads((folder / "meta/calvin_source.json").read_text())
        self.split = CalvinSplit(root, self.manifest["request"]["split"])
        if self.split.source_sha256 != self.manifest["request"]["source_sha256"]:
            raise Mismatch(f"{self.split.folder}: its index files are not those that {folder} was made from")
        self.tasks = pq.read_table(folder / "meta/tasks.parquet").to_pylist()
        self.sentence = {row["task_index"]: row["task"] for row in self.tasks}
        self.spans = [
            Span(e["start"], e["end"], e["scene"], tuple(e["windows"])) for e in self.manifest["episodes"]
        ]
        self.windows = [window_of_frames(span, self.split.windows) for span in self.spans]

    def source_of(self, feature: str) -> tuple[str, Any]:
        """CALVIN's array that a camera feature shows, and the part of its last axis."""
        name = feature.removeprefix("observation.images.")
        if name.startswith("tactile_"):
            finger = int(name[8])
            return (
                ("depth_tactile", finger)
                if name.endswith("_depth")
                else ("rgb_tactile", slice(3 * finger, 3 * finger + 3))
            )
        array = f"depth_{name.removesuffix('_depth')}" if name.endswith("_depth") else f"rgb_{name}"
        assert array in CAMERAS | DEPTH | TACTILE, feature
        return array, slice(None)


def verify(config: VerifyConfig) -> str:
    """Compares a dataset with its source.

    Returns:
        A few lines that say what was compared.

    Raises:
        FileNotFoundError: files of one of them are missing.
        Mismatch: they differ; the message says where.
        ValueError: the source is defective.
    """
    folder = folder_of(config.repo_id, config.dataset_dir)
    dataset = Dataset(folder, config.root)
    _check_files(dataset)
    _check_episodes(dataset)
    files = sorted((folder / "data").rglob("*.parquet"))
    frames = 0
    psnr: dict[str, list[float]] = {}
    sums: dict[str, Any] = {}
    work = partial(verify_file, dataset, min_psnr=config.min_psnr)
    with tqdm(total=dataset.info["total_frames"], desc="verifying", unit="frame") as bar:
        for found in _each(work, files, config.workers):
            bar.update(found.frames)
            frames += found.frames
            for key, values in found.psnr.items():
                psnr.setdefault(key, []).extend(values)
            for key, (low, high, total) in found.sums.items():
                before = sums.get(key, (low, high, 0))
                sums[key] = np.minimum(before[0], low), np.maximum(before[1], high), before[2] + total
    if frames != dataset.info["total_frames"]:
        raise Mismatch(
            f"{folder}/data holds {frames} frames, meta/info.json says {dataset.info['total_frames']}"
        )
    _check_stats(dataset, sums, frames)
    lines = [
        f"{folder}: {len(dataset.spans)} episodes, {frames} frames equal {dataset.split.folder}: state, scene and both "
        "forms of the action exactly, as are commands, tasks, scenes, windows and times"
    ]
    for key, feature in dataset.info["features"].items():
        if key in psnr:
            lines.append(
                f"{key}: video, PSNR {np.mean(psnr[key]):.1f} dB on average, {np.min(psnr[key]):.1f} at worst"
            )
        elif feature["dtype"] == "image":
            lines.append(f"{key}: equal, pixel by pixel")
    return "\n".join(lines)


def _each(work: Any, files: list[Path], workers: int) -> Iterator[Found]:
    if workers == 1:
        yield from map(work, files)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(work, files)


def _check_files(dataset: Dataset) -> None:
    """Every file of frames is there, none other, and is what was published."""
    listed = dataset.manifest["files"]
    there = {
        path.relative_to(dataset.folder).as_posix()
        for part in ("data", "videos")
        for path in (dataset.folder / part).rglob("*")
        if path.is_file()
    }
    if there != listed.keys():
        raise Mismatch(
            f"{dataset.folder}: missing or surplus files: {', '.join(sorted(there ^ listed.keys())[:5])}"
        )
    for name, sha in tqdm(listed.items(), desc="hashing", unit="file", leave=False):
        if sha256(dataset.folder / name) != sha:
            raise Mismatch(f"{dataset.folder / name} was changed since it was converted (SHA-256)")


def _check_episodes(dataset: Dataset) -> None:
    """meta/episodes and the counters of meta/info.json agree with the manifest."""
    rows: list[dict[str, Any]] = []
    columns = ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"]
    for path in sorted((dataset.folder / "meta/episodes").rglob("*.parquet")):
        rows += pq.read_table(path, columns=columns).to_pylist()
    index = 0
    for number, (row, span) in enumerate(zip(rows, dataset.spans, strict=False)):
        windows = dict.fromkeys(dataset.windows[number].tolist())
        wanted = {
            "episode_index": number,
            "tasks": list(dict.fromkeys(_sentence(dataset, window) for window in windows)),
            "length": len(span),
            "dataset_from_index": index,
            "dataset_to_index": index + len(span),
        }
        index += len(span)
        if row != wanted:
            raise Mismatch(f"{dataset.folder}/meta/episodes: episode {number} is {row}, expected {wanted}")
    info = dataset.info
    counted = len(rows), index, len(dataset.tasks), FPS
    told = info["total_episodes"], info["total_frames"], info["total_tasks"], info["fps"]
    if counted != told or len(rows) != len(dataset.spans):
        raise Mismatch(
            f"{dataset.folder}/meta/info.json says {told} episodes, frames, tasks, fps; counted {counted}"
        )


def _sentence(dataset: Dataset, window: int) -> str:
    return dataset.split.windows[window].sentence if window >= 0 else NO_COMMAND


def verify_file(dataset: Dataset, path: Path, min_psnr: float) -> Found:
    """Compares one file of frames, and the videos that belong to it, with the source.

    Args:
        dataset: whose file it is.
        path: the parquet file.
        min_psnr: smallest signal-to-noise ratio (dB) of a picture.

    Raises:
        Mismatch: see :func:`verify`.
    """
    features = dataset.info["features"]
    cameras = [key for key, feature in features.items() if feature["dtype"] in ("video", "image")]
    keys = [*VECTORS, *dict.fromkeys(dataset.source_of(key)[0] for key in cameras)]
    videos = {
        key: _decoded(_video_of(dataset, key, path), feature)
        for key, feature in features.items()
        if feature["dtype"] == "video"
    }
    found = Found()
    hashes: dict[int, Any] = {}
    with pq.ParquetFile(path) as table:
        for group in range(table.num_row_groups):
            rows = table.read_row_group(group)
            columns = {name: _numbers(rows[name]) for name in rows.column_names if name not in cameras}
            episode = int(columns["episode_index"][0])
            span, first = dataset.spans[episode], int(columns["frame_index"][0])
            frames = range(span.start + first, span.start + first + len(rows))
            source = dataset.split.read(frames, keys)
            hashes[episode] = digest(source, hashes.get(episode))
            place = f"{path}: episode {episode}, frames {frames.start}-{frames.stop - 1}"
            for name, wanted in _wanted(dataset, episode, first, source).items():
                if not np.array_equal(columns[name], wanted):
                    raise Mismatch(f"{place}: column {name} is not what the source says")
                if name in features and wanted.dtype == np.float32:
                    _add(found.sums, name, wanted)
            for key in cameras:
                array, part = dataset.source_of(key)
                pictures = source[array] if source[array].ndim == 3 else source[array][..., part]
                if key in videos:
                    stored = _take(videos[key], len(rows), f"{place}: {key}")
                    found.psnr.setdefault(key, []).extend(
                        _compare(stored, pictures, features[key], f"{place}: {key}")
                    )
                    if min(found.psnr[key][-len(rows) :]) < min_psnr:
                        raise Mismatch(
                            f"{place}: {key}: PSNR {min(found.psnr[key]):.1f} dB, --min_psnr={min_psnr}"
                        )
                else:
                    stored = np.stack(
                        [np.array(Image.open(io.BytesIO(c["bytes"]))) for c in rows[key].to_pylist()]
                    )
                    if not np.array_equal(stored, pictures.astype(stored.dtype)):
                        raise Mismatch(f"{place}: pictures of {key} are not the source's")
            found.frames += len(rows)
    for key, video in videos.items():
        if next(video, None) is not None:
            raise Mismatch(f"{_video_of(dataset, key, path)} holds more pictures than {path} frames")
    for episode, state in hashes.items():
        if state.hexdigest() != dataset.manifest["episodes"][episode]["sha256"]:
            raise Mismatch(
                f"{dataset.split.folder}: frames of episode {episode} changed since they were converted"
            )
    return found


def _wanted(
    dataset: Dataset, episode: int, first: int, source: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Every column of some frames but the pictures, from the source alone."""
    span, manifest = dataset.spans[episode], dataset.manifest
    n = len(source["actions"])
    start = sum(len(before) for before in dataset.spans[:episode]) + first
    windows = dataset.windows[episode][first : first + n]
    listed = dataset.split.windows
    forms = (
        ("rel_actions", "actions") if manifest["request"]["action"] == "rel" else ("actions", "rel_actions")
    )
    order = manifest["scenes"][span.scene]["block_order"]
    blocks = [6 + 6 * order.index(colour) + i for colour in checks.COLOURS for i in range(6)]
    number = {sentence: index for index, sentence in dataset.sentence.items()}
    return {
        "observation.state": source["robot_obs"].astype(np.float32),
        "observation.environment_state": source["scene_obs"][:, [*range(6), *blocks]].astype(np.float32),
        "action": source[forms[0]].astype(np.float32),
        f"calvin.{forms[1]}": source[forms[1]].astype(np.float32),
        "calvin.frame": np.arange(span.start + first, span.start + first + n),
        "calvin.window": windows,
        "calvin.task": np.array(
            [manifest["task_names"].index(listed[w].task) if w >= 0 else -1 for w in windows]
        ),
        "calvin.scene": np.full(n, manifest["scene_names"].index(span.scene)),
        "timestamp": (np.arange(first, first + n) / FPS).astype(np.float32),
        "frame_index": np.arange(first, first + n),
        "episode_index": np.full(n, episode),
        "index": np.arange(start, start + n),
        "task_index": np.array([number[_sentence(dataset, window)] for window in windows]),
    }


def _numbers(column: Any) -> np.ndarray:
    flat = column.combine_chunks()
    if not hasattr(flat, "flatten") or not hasattr(flat.type, "list_size"):
        return flat.to_numpy()
    return flat.flatten().to_numpy().reshape(len(flat), -1)


def _add(sums: dict[str, list[np.ndarray]], key: str, values: np.ndarray) -> None:
    values = values.astype(np.float64)
    low, high, total = values.min(axis=0), values.max(axis=0), values.sum(axis=0)
    if key in sums:
        before = sums[key]
        low, high, total = np.minimum(before[0], low), np.maximum(before[1], high), before[2] + total
    sums[key] = [low, high, total]


def _video_of(dataset: Dataset, key: str, data: Path) -> Path:
    """The video that belongs to a file of frames: the same chunk and file number."""
    chunk, file = (int(part.rpartition("-")[2]) for part in (data.parent.name, data.stem))
    return dataset.folder / dataset.info["video_path"].format(
        video_key=key, chunk_index=chunk, file_index=file
    )


def _decoded(path: Path, feature: dict[str, Any]) -> Iterator[np.ndarray]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24" if feature["shape"][2] == 3 else "gray12le")


def _take(video: Iterator[np.ndarray], n: int, place: str) -> np.ndarray:
    pictures = [picture for _, picture in zip(range(n), video, strict=False)]
    if len(pictures) < n:
        raise Mismatch(f"{place}: the video ends too early")
    return np.stack(pictures)


def _compare(stored: np.ndarray, wanted: np.ndarray, feature: dict[str, Any], place: str) -> list[float]:
    """Signal-to-noise ratio (dB) of each picture of a video; of distances against the farthest that fits.

    Raises:
        Mismatch: the pictures fit better when they are moved by one frame, or with red and blue exchanged.
    """
    peak = 255.0
    if feature["shape"][2] == 1:
        from lerobot.configs import DepthEncoderConfig
        from lerobot.datasets.depth_utils import dequantize_depth

        codec = DepthEncoderConfig.from_video_info(feature["info"])
        quantizer = {name: getattr(codec, name) for name in ("depth_min", "depth_max", "shift", "use_log")}
        stored = dequantize_depth(stored[:, None], **quantizer, output_unit="m", output_tensor=False)[:, 0]
        peak = codec.depth_max

    def errors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        difference = a.astype(np.float32) - b.astype(np.float32)
        return (difference**2).reshape(len(a), -1).mean(axis=1)

    error = errors(stored, wanted)
    visible = (peak / 255) ** 2  # below it a codec's rounding decides what fits best
    here = error.mean()
    if wanted.ndim == 4 and here > visible and errors(stored, wanted[..., ::-1]).mean() < _BETTER * here:
        raise Mismatch(f"{place}: red and blue are exchanged")
    if len(stored) > 2:
        here = error[1:-1].mean()
        for name, moved in (
            ("late", errors(stored[1:-1], wanted[:-2])),
            ("early", errors(stored[1:-1], wanted[2:])),
        ):
            if moved.mean() < _BETTER * here and here > visible:
                raise Mismatch(f"{place}: the video is a frame {name}")
    return (10 * np.log10(peak**2 / np.maximum(error, 1e-9))).tolist()


def _check_stats(dataset: Dataset, sums: dict[str, Any], frames: int) -> None:
    stats = json.loads((dataset.folder / "meta/stats.json").read_text())
    for key, (low, high, total) in sums.items():
        for name, wanted in (("min", low), ("max", high), ("mean", total / frames)):
            if not np.allclose(stats[key][name], wanted, rtol=1e-5, atol=1e-6):
                raise Mismatch(f"{dataset.folder}/meta/stats.json: {name} of {key} is not that of the frames")


def main() -> int:
    """Runs the command; returns 0, 1 if the dataset differs from its source, 2 after an error the user can mend."""
    try:
        print(verify(draccus.parse(VerifyConfig)))
    except Mismatch as error:
        print(f"mismatch: {error}", file=sys.stderr)
        return 1
    except (OSError, ValueError, DraccusException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
