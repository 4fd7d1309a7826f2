"""What a converted dataset says of itself, compared with its source: manifest, metadata, names and hashes of files."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from tqdm import tqdm

from dataset_convert import blocks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.episodes import Span, as_ranges, play_spans, window_of_frames, window_spans
from dataset_convert.frames import DEPTH, INTERVENTION, RGB, TACTILE, recorded_arrays, shape_of
from dataset_convert.language import EMBEDDINGS, LANG_FOLDER, embeddings_name, read_embeddings
from dataset_convert.layout import check_format
from dataset_convert.verify_shared import ValidationFrames
from lerobot_lansar.calvin import CAMERAS, CONTROL_HZ, SCENE_NAMES, TASKS
from lerobot_lansar.clip.store import dataset_fingerprint, sha256
from lerobot_lansar.datasets import INTERVENTION_FEATURE, MANIFEST, NO_COMMAND


class Mismatch(Exception):
    """The dataset is not what its source says it should be."""


class Dataset:
    """A converted dataset and its source.

    Attributes:
        folder: Its folder.
        manifest, info, tasks: The contents of `MANIFEST`, meta/info.json and meta/tasks.parquet.
        split: The source.
        spans: Its episodes in the source, as the manifest lists them.
        starts: Absolute index of each episode's first frame.
        windows: The window of each frame, for every episode.
        orders: Scene to the colours of its block columns, found from the source again.
        contradictions: Scene to what the source says against it.
        validation: The frames of validation; none if this is not training, or if the source has no validation/ here.

    Raises:
        FileNotFoundError: It was not made by `lansar-convert`.
        ValueError: It was made by an earlier version, of another format.
        Mismatch: It was made from another source, or its files were changed since.
    """

    def __init__(self, folder: Path, root: Path):
        if not (folder / MANIFEST).is_file():
            raise FileNotFoundError(
                f"{folder / MANIFEST} is missing: --dataset_dir must hold a result of lansar-convert"
            )
        self.folder = folder
        self.manifest = json.loads((folder / MANIFEST).read_text())
        request = self.manifest["request"]
        check_format(folder, self.manifest)
        options = {name: request[name] for name in ("lang_folder", "scene", "skip_bad") if name in request}
        self.split = CalvinSplit(root, request["split"], **options)
        if self.split.source_sha256 != request["source_sha256"]:
            raise Mismatch(f"{self.split.folder}: its index files are not those that {folder} was made from")
        _check_files(folder, self.manifest["files"])
        self.info = json.loads((folder / "meta/info.json").read_text())
        self.tasks = pq.read_table(folder / "meta/tasks.parquet").to_pylist()
        self.spans = [_span(episode) for episode in self.manifest["episodes"]]
        self.starts = np.cumsum([0, *(len(span) for span in self.spans)])
        self.windows = [window_of_frames(span, self.split.windows) for span in self.spans]
        self.orders: dict[str, tuple[str, ...]] = {}
        self.contradictions: dict[str, list[str]] = {}
        for scene in sorted({span.scene for span in self.spans}):
            evidence = blocks.gather_evidence(self.split, scene)
            if found := blocks.contradictions(scene, evidence):
                self.contradictions[scene] = found
            self.orders[scene] = blocks.block_order(scene, evidence, request.get("block_order", "checked"))
        recorded = recorded_arrays(self.split.frame_file(span.start) for span in self.spans)
        self.says_who_acted = INTERVENTION.keys() <= recorded
        found_in = ValidationFrames(root) if request["split"] == "training" else None
        self.validation = found_in if found_in else None

    @property
    def features(self) -> dict[str, Any]:
        """LeRobot's description of the columns."""
        return self.info["features"]

    def sentence_of(self, window: int) -> str:
        """The command of a window, -1 for none."""
        return self.split.windows[window].sentence if window >= 0 else NO_COMMAND

    def camera_sizes(self) -> dict[str, int]:
        """Camera to the width and height of its pictures."""
        keys = {camera: f"observation.images.{camera}" for camera in CAMERAS}
        return {camera: self.features[key]["shape"][0] for camera, key in keys.items() if key in self.features}

    def source_of(self, feature: str) -> tuple[str, Any]:
        """CALVIN's array that a camera feature shows, and the part of its last axis."""
        name = feature.removeprefix("observation.images.")
        if name.startswith("tactile_"):
            finger = int(name[8])
            if name.endswith("_depth"):
                return "depth_tactile", finger
            return "rgb_tactile", slice(3 * finger, 3 * finger + 3)
        array = f"depth_{name.removesuffix('_depth')}" if name.endswith("_depth") else f"rgb_{name}"
        assert array in RGB | DEPTH | TACTILE, feature
        return array, slice(None)


def _span(described: dict[str, Any]) -> Span:
    return Span(described["start"], described["end"], described["scene"], tuple(described["windows"]))


def chunk_and_file(path: Path) -> tuple[int, int]:
    """The numbers in `chunk-000/file-000.…`."""
    return int(path.parent.name.rpartition("-")[2]), int(path.stem.rpartition("-")[2])


def check_claims(dataset: Dataset) -> list[str]:
    """Compares everything but the frames.

    Returns:
        Lines for the report.

    Raises:
        Mismatch: Something is not what the source says it should be.
    """
    _check_manifest(dataset)
    _check_shared(dataset)
    _check_spans(dataset)
    _check_pictures(dataset)
    _check_interventions(dataset)
    _check_environment_state(dataset)
    _check_episodes(dataset)
    _check_lang(dataset)
    return _check_clip(dataset)


def _check_manifest(dataset: Dataset) -> None:
    """What the manifest says of the source is true: windows, names, block columns."""
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
        ("look", manifest["look"], _look(dataset)),
        ("contradictions", manifest["contradictions"], dataset.contradictions),
    ):
        if told != found:
            what = "something else" if "_names" in name or name == "windows" else f"{told}, {found}"
            raise Mismatch(f"{dataset.folder}/{MANIFEST}: {name} are not what {split.folder} says: {what}")


def _look(dataset: Dataset) -> dict[str, Any]:
    """What drew the source's pictures, and the size that the dataset must have them in."""
    look = dataset.split.look
    size = dataset.manifest["request"].get("image_size", 0) or look.image_size
    return {"renderer": look.renderer, "assets": look.assets, "image_size": size}


def _check_shared(dataset: Dataset) -> None:
    """Frames that are listed as in both splits are; that none is missing in the list shows when they are compared."""
    if dataset.validation is None:
        return
    listed = dataset.manifest["shared_frames"]
    wrong = [frame for frame in listed if not dataset.validation.hold(dataset.split.frame_file(frame))]
    if wrong:
        raise Mismatch(f"{dataset.folder}/{MANIFEST}: frames {as_ranges(wrong)} are not in validation, as it says")


def _check_spans(dataset: Dataset) -> None:
    """Every episode that was asked for is here or listed as left out, and no other is."""
    manifest, split = dataset.manifest, dataset.split
    request = manifest["request"]
    excluded = manifest["shared_frames"] if request["exclude_shared"] else []
    if request["mode"] == "play":
        wanted = play_spans(split, excluded)
    else:
        wanted = window_spans(split.windows, request["dedup"], excluded, split.faults)
    windows = split.windows
    faulty = [Span(windows[n].start, windows[n].end, windows[n].scene, (n,)) for n in split.faults]
    left_out = [_span(e) for e in manifest["left_out"]]
    place = f"{dataset.folder}/{MANIFEST}"
    if left_out and not request["skip_bad"]:
        raise Mismatch(f"{place}: {len(left_out)} episodes were left out without --skip_bad=true")
    listed, known = {*dataset.spans, *left_out}, {*wanted, *faulty}
    for what, spans in (
        ("missing and not listed as left out", [span for span in (*wanted, *faulty) if span not in listed]),
        ("not asked for", [span for span in (*dataset.spans, *left_out) if span not in known]),
    ):
        if spans:
            first = f"frames {spans[0].start}-{spans[0].end - 1}, windows {list(spans[0].windows)}"
            raise Mismatch(f"{place}: {len(spans)} episodes are {what}; the first: {first}")
    if dataset.spans != [span for span in wanted if span not in set(left_out)]:
        raise Mismatch(f"{place}: episodes are in another order than the source's, or occur twice")


def _check_files(folder: Path, listed: dict[str, str]) -> None:
    """The files of data, videos, meta and lang are those that were published: none more, none fewer, none changed."""
    there = {
        path.relative_to(folder).as_posix()
        for part in ("data", "videos", "meta", EMBEDDINGS)
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


def _check_lang(dataset: Dataset) -> None:
    """Embeddings of sentences, if they were asked for, are the source's, and belong to these frames."""
    request = dataset.manifest["request"]
    if not request.get("lang_embeddings"):
        return
    file = dataset.folder / EMBEDDINGS / f"{embeddings_name(request.get('lang_folder', LANG_FOLDER))}.npy"
    if not np.array_equal(np.load(file), read_embeddings(dataset.split.language, len(dataset.split.windows))):
        raise Mismatch(f"{file} is not what {dataset.split.language} holds")
    if json.loads(file.with_suffix(".json").read_text())["fingerprint"] != dataset_fingerprint(dataset.folder):
        raise Mismatch(f"{file} belongs to other frames")


def _check_clip(dataset: Dataset) -> list[str]:
    """Embeddings, if there are any, belong to these frames and are unchanged.

    Returns:
        A line that says so, or none.
    """
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
    """meta/info.json labels height and width correctly: exchanged labels would transpose the pictures."""
    for key, feature in dataset.features.items():
        if feature["dtype"] not in ("video", "image"):
            continue
        size = dataset.manifest["request"].get("image_size", 0) or dataset.split.look.image_size
        height, width = shape_of(dataset.source_of(key)[0], size)[:2]
        wanted = [height, width, 1 if key.endswith("_depth") else 3], ["height", "width", "channels"]
        if (feature["shape"], feature["names"]) != wanted:
            told = f"{feature['shape']} {feature['names']}"
            raise Mismatch(f"{dataset.folder}/meta/info.json: {key} is {told}, expected {wanted[0]} {wanted[1]}")


def _check_interventions(dataset: Dataset) -> None:
    """There is a column that says who acted if the source says it or it was asked for, and only then."""
    wanted = dataset.says_who_acted or dataset.manifest["request"].get("is_intervention", False)
    if (INTERVENTION_FEATURE in dataset.features) != wanted:
        raise Mismatch(f"{dataset.folder}/meta/info.json: {INTERVENTION_FEATURE} is {'missing' if wanted else 'there'}")


def _check_environment_state(dataset: Dataset) -> None:
    """The dataset holds the scene's state, or the commanded task, if it says so, and only then."""
    request, key = dataset.manifest["request"], "observation.environment_state"
    wanted = request.get("scene_state", True) or request.get("task_in_state", False)
    if (key in dataset.features) != wanted:
        raise Mismatch(f"{dataset.folder}/meta/info.json: {key} is {'missing' if wanted else 'there'}")


def _check_episodes(dataset: Dataset) -> None:
    """meta/episodes says where each episode lies, and the counters of meta/info.json agree."""
    info = dataset.info
    videos = [key for key, feature in dataset.features.items() if feature["dtype"] == "video"]
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
            "tasks": list(dict.fromkeys(dataset.sentence_of(w) for w in dataset.windows[number].tolist())),
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
    """Episode to chunk and file number of the frame table that holds it.

    Raises:
        Mismatch: An episode lies in two files.
    """
    found: dict[int, tuple[int, int]] = {}
    for path in sorted((folder / "data").rglob("*.parquet")):
        for episode in pq.read_table(path, columns=["episode_index"])["episode_index"].unique().to_pylist():
            if episode in found:
                raise Mismatch(f"{path}: episode {episode} is in another file too")
            found[episode] = chunk_and_file(path)
    return found


def _episode_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """The rows of meta/episodes in order, without statistics.

    Raises:
        Mismatch: A row names another file than the one it is in.
    """
    for path in sorted((folder / "meta/episodes").rglob("*.parquet")):
        names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
        for row in pq.read_table(path, columns=names).to_pylist():
            told = row.get("meta/episodes/chunk_index"), row.get("meta/episodes/file_index")
            if told != chunk_and_file(path):
                raise Mismatch(f"{path}: meta/episodes/chunk_index, meta/episodes/file_index are {told}")
            yield row
