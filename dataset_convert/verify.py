"""`lansar-verify`: compares a converted dataset with its source, frame by frame."""

import io
import json
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import av
import draccus
import numpy as np
import pyarrow.parquet as pq
from PIL import Image
from tqdm import tqdm

from dataset_convert import checks
from dataset_convert.calvin import DEPTH, RGB, TACTILE, VECTORS, CalvinSplit
from dataset_convert.episodes import (
    NO_COMMAND,
    Span,
    as_ranges,
    play_spans,
    shared_frames,
    window_of_frames,
    window_spans,
)
from dataset_convert.hub import find_dataset
from dataset_convert.layout import MANIFEST
from dataset_convert.writer import digest
from lerobot_lansar.calvin import COLORS, CONTROL_HZ, SCENE_NAMES, TASKS
from lerobot_lansar.clip.store import dataset_fingerprint, sha256
from lerobot_lansar.command import run_command

_BETTER = 0.9  # of the squared error; a video of the desk that is a frame off has more than twice that of a right one


@dataclass
class VerifyConfig:
    """Compares every frame of a converted dataset with the CALVIN folder it came from."""

    # name of the dataset, you/name
    repo_id: str
    # folder of the CALVIN dataset, the one that holds training/ and validation/
    root: Path
    # the dataset's folder; by default where LeRobot looks for a dataset of that name, or its download from the hub
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
        frames: How many.
        psnr: Feature -> signal-to-noise ratio (dB) of each picture.
        sums: Feature -> (smallest, largest, sum) of each dimension.
    """

    frames: int = 0
    psnr: dict[str, list[float]] = field(default_factory=dict)
    sums: dict[str, list[np.ndarray]] = field(default_factory=dict)


class Dataset:
    """What a converted dataset says of itself, beside its source.

    Attributes:
        folder, info, manifest, tasks, sentence: The dataset's.
        split: The source.
        spans: Its episodes in the source, as the manifest lists them.
        windows: Per episode the window of each frame.
        orders: Scene -> colours of its block columns, established from the source again.

    Raises:
        FileNotFoundError: It is no dataset of `lansar-convert`.
        Mismatch: It was made from another source, or its files were changed since.
    """

    def __init__(self, folder: Path, root: Path):
        if not (folder / MANIFEST).is_file():
            raise FileNotFoundError(
                f"{folder / MANIFEST} is missing: --dataset_dir must hold a result of lansar-convert"
            )
        self.folder = folder
        self.manifest = json.loads((folder / MANIFEST).read_text())
        self.split = CalvinSplit(root, self.manifest["request"]["split"])
        if self.split.source_sha256 != self.manifest["request"]["source_sha256"]:
            raise Mismatch(f"{self.split.folder}: its index files are not those that {folder} was made from")
        _check_files(folder, self.manifest["files"])
        self.info = json.loads((folder / "meta/info.json").read_text())
        self.tasks = pq.read_table(folder / "meta/tasks.parquet").to_pylist()
        self.sentence = {row["task_index"]: row["task"] for row in self.tasks}
        self.spans = [_span(episode) for episode in self.manifest["episodes"]]
        self.windows = [window_of_frames(span, self.split.windows) for span in self.spans]
        self.orders: dict[str, tuple[str, ...]] = {}
        for scene in sorted({span.scene for span in self.spans}):
            self.orders[scene] = checks.block_order(scene, checks.block_votes(self.split, scene))

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
        assert array in RGB | DEPTH | TACTILE, feature
        return array, slice(None)


def _span(described: dict[str, Any]) -> Span:
    return Span(described["start"], described["end"], described["scene"], tuple(described["windows"]))


def verify(config: VerifyConfig) -> str:
    """Compares a dataset with its source.

    Returns:
        A few lines that say what was compared.

    Raises:
        FileNotFoundError: Files of one of them are missing.
        Mismatch: They differ; the message says where.
        ValueError: The source is defective.
    """
    folder = find_dataset(config.repo_id, config.dataset_dir)
    dataset = Dataset(folder, config.root)
    _check_manifest(dataset)
    _check_spans(dataset)
    _check_pictures(dataset)
    _check_episodes(dataset)
    clip = _check_clip(dataset)
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
        raise Mismatch(f"{folder}/data holds {frames} frames, meta/info.json says {dataset.info['total_frames']}")
    _check_stats(dataset, sums, frames)
    lines = [
        f"{folder}: {len(dataset.spans)} episodes, {frames} frames equal {dataset.split.folder}: state, scene and both "
        "forms of the action exactly, as are commands, tasks, scenes, windows and times",
        f"{len(dataset.manifest['left_out'])} defective episodes are listed as left out; no other one is missing",
    ]
    for key, feature in dataset.info["features"].items():
        if key in psnr:
            lines.append(f"{key}: video, PSNR {np.mean(psnr[key]):.1f} dB on average, {np.min(psnr[key]):.1f} at worst")
        elif feature["dtype"] == "image":
            lines.append(f"{key}: equal, pixel by pixel")
    return "\n".join(lines + clip)


def _each(work: Any, files: list[Path], workers: int) -> Iterator[Found]:
    if workers == 1:
        yield from map(work, files)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(work, files)


def _check_manifest(dataset: Dataset) -> None:
    """What the manifest says of the source is so: windows, names, block columns, frames of both splits."""
    manifest, split = dataset.manifest, dataset.split
    scenes = {
        scene: {"frames": list(split.scenes[scene]), "block_order": list(order)}
        for scene, order in dataset.orders.items()
    }
    for name, told, found in (
        ("windows", manifest["windows"], [asdict(window) for window in split.windows]),
        ("task_names", manifest["task_names"][: len(TASKS)], list(TASKS)),
        ("scene_names", manifest["scene_names"][: len(SCENE_NAMES)], list(SCENE_NAMES)),
        ("scenes", manifest["scenes"], scenes),
    ):
        if told != found:
            what = f"{told}, {found}" if name == "scenes" else "something else"
            raise Mismatch(f"{dataset.folder}/{MANIFEST}: {name} are not what {split.folder} says: {what}")
    if manifest["request"]["split"] == "training":
        shared = shared_frames(split)
        if shared and shared != manifest["shared_frames"]:  # none: the source has no validation/ here
            raise Mismatch(
                f"{dataset.folder}/{MANIFEST}: training and validation share frames {as_ranges(shared)}, it says "
                f"{as_ranges(manifest['shared_frames']) or 'none'}"
            )


def _check_spans(dataset: Dataset) -> None:
    """Every episode that was asked for is here or on the list of what was left out, and no other is."""
    manifest, split = dataset.manifest, dataset.split
    request = manifest["request"]
    excluded = manifest["shared_frames"] if request["exclude_shared"] else []
    if request["mode"] == "play":
        wanted = play_spans(split, excluded)
    else:
        wanted = window_spans(split.windows, request["dedup"], excluded)
    left_out = [_span(e) for e in manifest["left_out"]]
    place = f"{dataset.folder}/{MANIFEST}"
    if left_out and not request["skip_bad"]:
        raise Mismatch(f"{place}: {len(left_out)} episodes were left out without --skip_bad=true")
    listed, known = {*dataset.spans, *left_out}, set(wanted)
    for what, spans in (
        ("missing and not listed as left out", [span for span in wanted if span not in listed]),
        ("not asked for", [span for span in (*dataset.spans, *left_out) if span not in known]),
    ):
        if spans:
            first = f"frames {spans[0].start}-{spans[0].end - 1}, windows {list(spans[0].windows)}"
            raise Mismatch(f"{place}: {len(spans)} episodes are {what}; the first: {first}")
    if dataset.spans != [span for span in wanted if span not in set(left_out)]:
        raise Mismatch(f"{place}: episodes are in another order than the source's, or there twice")


def _check_files(folder: Path, listed: dict[str, str]) -> None:
    """Every file of data, videos and meta is there, none other, and is what was published."""
    there = {
        path.relative_to(folder).as_posix()
        for part in ("data", "videos", "meta")
        for path in (folder / part).rglob("*")
        if path.is_file()
    }
    _check_hashes(folder, there - {MANIFEST}, listed, "was converted")


def _check_hashes(folder: Path, there: set[str], listed: dict[str, str], since: str) -> None:
    """Compares file names and hashes with a list of them."""
    if there != listed.keys():
        names = ", ".join(sorted(there ^ listed.keys())[:5])
        raise Mismatch(f"{folder}: missing or surplus files: {names}")
    for name, sha in tqdm(listed.items(), desc="hashing", unit="file", leave=False):
        if sha256(folder / name) != sha:
            raise Mismatch(f"{folder / name} was changed since it {since} (SHA-256)")


def _check_clip(dataset: Dataset) -> list[str]:
    """Embeddings, if there are any, belong to these frames and are what was written; a line that says so."""
    folder = dataset.folder / "clip"
    if not folder.exists():
        return []
    if not (folder / "clip.json").is_file():
        raise Mismatch(f"{folder} holds no clip.json: delete that folder and run lansar-embed")
    told = json.loads((folder / "clip.json").read_text())
    there = {path.name for path in folder.iterdir()} - {"clip.json", "state.json"}
    _check_hashes(folder, there, told.get("files", {}), "was embedded")
    if told["fingerprint"] != dataset_fingerprint(dataset.folder):
        raise Mismatch(f"{folder} holds embeddings of other frames: delete that folder and run lansar-embed")
    return [f"{folder.name}: as {told['model']} {told['pretrained'] or 'untrained'} left it, for these frames"]


def _check_pictures(dataset: Dataset) -> None:
    """meta/info.json says how the pictures lie: a label the wrong way round transposes them."""
    for key, feature in dataset.info["features"].items():
        if feature["dtype"] not in ("video", "image"):
            continue
        height, width = (RGB | DEPTH | TACTILE)[dataset.source_of(key)[0]][:2]
        wanted = [height, width, 1 if key.endswith("_depth") else 3], ["height", "width", "channels"]
        if (feature["shape"], feature["names"]) != wanted:
            told = f"{feature['shape']} {feature['names']}"
            raise Mismatch(f"{dataset.folder}/meta/info.json: {key} is {told}, expected {wanted[0]} {wanted[1]}")


def _check_episodes(dataset: Dataset) -> None:
    """meta/episodes says where each episode lies, and the counters of meta/info.json agree."""
    info = dataset.info
    videos = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    files = _files_of_episodes(dataset.folder)
    rows = list(_episode_rows(dataset.folder))
    if sorted(files) != list(range(len(dataset.spans))):
        raise Mismatch(f"{dataset.folder}/data holds other episodes than 0-{len(dataset.spans) - 1}")
    index, file, first = 0, None, 0
    for number, (row, span) in enumerate(zip(rows, dataset.spans, strict=False)):
        if files[number] != file:
            file, first = files[number], index  # a file, and the videos of the same number, begin here
        place = dict(zip(("chunk_index", "file_index"), files[number], strict=True))
        wanted = {
            "episode_index": number,
            "tasks": list(dict.fromkeys(_sentence(dataset, w) for w in dataset.windows[number].tolist())),
            "length": len(span),
            "dataset_from_index": index,
            "dataset_to_index": index + len(span),
            **{f"data/{name}": value for name, value in place.items()},
        }
        for key in videos:
            wanted |= {f"videos/{key}/{name}": value for name, value in place.items()}
            wanted[f"videos/{key}/from_timestamp"] = (index - first) / CONTROL_HZ
            wanted[f"videos/{key}/to_timestamp"] = (index - first + len(span)) / CONTROL_HZ
        index += len(span)
        for name, value in wanted.items():
            if row.get(name) != value:
                raise Mismatch(
                    f"{dataset.folder}/meta/episodes: episode {number}: {name} is {row.get(name)}, expected {value}"
                )
    counted = len(rows), index, len(dataset.tasks), CONTROL_HZ
    told = info["total_episodes"], info["total_frames"], info["total_tasks"], info["fps"]
    if counted != told or len(rows) != len(dataset.spans):
        raise Mismatch(f"{dataset.folder}/meta/info.json says {told} episodes, frames, tasks, fps; counted {counted}")


def _files_of_episodes(folder: Path) -> dict[int, tuple[int, int]]:
    """Episode -> chunk and file number of the frame table that holds it.

    Raises:
        Mismatch: An episode lies in two files.
    """
    found: dict[int, tuple[int, int]] = {}
    for path in sorted((folder / "data").rglob("*.parquet")):
        for episode in pq.read_table(path, columns=["episode_index"])["episode_index"].unique().to_pylist():
            if episode in found:
                raise Mismatch(f"{path}: episode {episode} is in another file too")
            found[episode] = _chunk_and_file(path)
    return found


def _episode_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """The rows of meta/episodes in order, without statistics.

    Raises:
        Mismatch: A row says that it is in another file than it is.
    """
    for path in sorted((folder / "meta/episodes").rglob("*.parquet")):
        names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
        for row in pq.read_table(path, columns=names).to_pylist():
            told = row.get("meta/episodes/chunk_index"), row.get("meta/episodes/file_index")
            if told != _chunk_and_file(path):
                raise Mismatch(f"{path}: meta/episodes/chunk_index, meta/episodes/file_index are {told}")
            yield row


def _sentence(dataset: Dataset, window: int) -> str:
    return dataset.split.windows[window].sentence if window >= 0 else NO_COMMAND


def verify_file(dataset: Dataset, path: Path, min_psnr: float) -> Found:
    """Compares one file of frames, and the videos that belong to it, with the source.

    Args:
        dataset: Whose file it is.
        path: The parquet file.
        min_psnr: Smallest signal-to-noise ratio (dB) of a picture.

    Raises:
        Mismatch: See `verify`.
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
                    found.psnr.setdefault(key, []).extend(_compare(stored, pictures, features[key], f"{place}: {key}"))
                    if min(found.psnr[key][-len(rows) :]) < min_psnr:
                        raise Mismatch(f"{place}: {key}: PSNR {min(found.psnr[key]):.1f} dB, --min_psnr={min_psnr}")
                else:
                    stored = np.stack([np.array(Image.open(io.BytesIO(c["bytes"]))) for c in rows[key].to_pylist()])
                    if not np.array_equal(stored, pictures.astype(stored.dtype)):
                        raise Mismatch(f"{place}: pictures of {key} are not the source's")
            found.frames += len(rows)
    for key, video in videos.items():
        if next(video, None) is not None:
            raise Mismatch(f"{_video_of(dataset, key, path)} holds more pictures than {path} frames")
    for episode, state in hashes.items():
        if state.hexdigest() != dataset.manifest["episodes"][episode]["sha256"]:
            raise Mismatch(f"{dataset.split.folder}: frames of episode {episode} changed since they were converted")
    return found


def _wanted(dataset: Dataset, episode: int, first: int, source: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Every column of some frames but the pictures, from the source alone."""
    span, manifest = dataset.spans[episode], dataset.manifest
    n = len(source["actions"])
    start = sum(len(before) for before in dataset.spans[:episode]) + first
    windows = dataset.windows[episode][first : first + n]
    listed = dataset.split.windows
    tasks = np.array([manifest["task_names"].index(listed[w].task) if w >= 0 else -1 for w in windows])
    action, other = source["rel_actions"], source["actions"]
    if manifest["request"]["action"] == "abs":
        action, other = source["actions"].copy(), source["rel_actions"]
        action[:, 3] %= 2 * np.pi
    order = dataset.orders[span.scene]
    blocks = [6 + 6 * order.index(colour) + i for colour in COLORS for i in range(6)]
    scene = source["scene_obs"][:, [*range(6), *blocks]]
    if manifest["request"].get("task_in_state"):
        scene = np.hstack([scene, np.eye(len(TASKS) + 1)[tasks, :-1]])  # the last row, of -1, is all zeros
    number = {sentence: index for index, sentence in dataset.sentence.items()}
    return {
        "observation.state": source["robot_obs"].astype(np.float32),
        "observation.environment_state": scene.astype(np.float32),
        "action": action.astype(np.float32),
        "calvin.actions" if other is source["actions"] else "calvin.rel_actions": other.astype(np.float32),
        "calvin.frame": np.arange(span.start + first, span.start + first + n),
        "calvin.window": windows,
        "calvin.task": tasks,
        "calvin.scene": np.full(n, manifest["scene_names"].index(span.scene)),
        "timestamp": (np.arange(first, first + n) / CONTROL_HZ).astype(np.float32),
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
    chunk, file = _chunk_and_file(data)
    return dataset.folder / dataset.info["video_path"].format(video_key=key, chunk_index=chunk, file_index=file)


def _chunk_and_file(path: Path) -> tuple[int, int]:
    """The numbers in `chunk-000/file-000.…`."""
    return int(path.parent.name.rpartition("-")[2]), int(path.stem.rpartition("-")[2])


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
        Mismatch: The pictures fit better when they are moved by one frame, or with red and blue exchanged.
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

    if stored.shape != wanted.shape:
        raise Mismatch(f"{place}: pictures are {stored.shape[1:]}, the source's {wanted.shape[1:]}")
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


@draccus.wrap()
def run(config: VerifyConfig) -> int:
    """Verifies; 1 if the dataset differs from its source."""
    try:
        print(verify(config))
    except Mismatch as error:
        print(f"mismatch: {error}", file=sys.stderr)
        return 1
    return 0


def main() -> int:
    """Entry point of `lansar-verify`."""
    return run_command("lansar-verify", run)


if __name__ == "__main__":
    sys.exit(main())
