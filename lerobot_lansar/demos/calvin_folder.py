"""Writes demonstrations in CALVIN's on-disk format: one npz per frame, windows and sentences beside them."""

import io
import json
import os
import shutil
import socket
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from tqdm import tqdm

from ..calvin import block_columns
from ..desk.scenes import Scene
from ..pictures import resize

FRAME = "episode_{:07d}.npz"
STATES = ("robot_obs", "scene_obs")


def _process() -> str:
    """A name that no other process on any machine has."""
    return f"{socket.gethostname()}-{os.getpid()}"


@dataclass
class Unit:
    """Frames that were recorded in one go and are kept as `000000.npz` … in a folder of their own.

    Attributes:
        scene: The scene's letter.
        frames: Number of frames.
        recordings: [first, end) of each uninterrupted stretch.
        windows: (first, end, task): the task is fulfilled in frames [first, end).
        tried: Task to how often it was tried.
        accepted: Task to how often the oracle saw it fulfilled.
        sums: For `robot_obs` and `scene_obs` (as on disk) the sums over frames of each value and of its square.
        sentences: Of each window; empty: they are chosen when the split is published.
        alone: Task to how often a policy fulfilled it without the demonstrator (takeovers).
        demonstrated: Frames in which the demonstrator acted, not a policy (takeovers).
    """

    scene: str
    frames: int = 0
    recordings: list[tuple[int, int]] = field(default_factory=list)
    windows: list[tuple[int, int, str]] = field(default_factory=list)
    tried: dict[str, int] = field(default_factory=dict)
    accepted: dict[str, int] = field(default_factory=dict)
    sums: dict[str, list[list[float]]] = field(default_factory=dict)
    sentences: list[str] = field(default_factory=list)
    alone: dict[str, int] = field(default_factory=dict)
    demonstrated: int = 0

    def save(self, file: Path) -> None:
        """Writes the unit to `file`, which is complete whenever it exists."""
        partial = file.with_name(f"{file.name}-{_process()}.partial")
        partial.write_text(json.dumps(asdict(self)))
        partial.rename(file)

    @classmethod
    def load(cls, file: Path) -> "Unit":
        """Reads what `save` wrote."""
        return cls(**json.loads(file.read_text()))


class FrameWriter:
    """Writes one npz per frame into `folder`, which appears when the writer is closed without an error.

    Frames come with blocks in red, blue, pink order in `scene_obs`; files have them in CALVIN's order for the scene.

    Args:
        folder: The folder.
        scene: Where the frames are from.
        image_size: Width and height of all pictures and depth in the files; 0: as they come.
    """

    def __init__(self, folder: Path, scene: Scene, image_size: int = 0):
        self._folder, self._image_size = folder, image_size
        self._partial = folder.with_name(f"{folder.name}-{_process()}.partial")
        self._columns = block_columns(tuple(scene.blocks))
        self._sums: dict[str, np.ndarray] = {}
        self.frames = 0

    def add(self, frame: dict[str, np.ndarray]) -> None:
        """Writes the next frame: `robot_obs` (15,), `scene_obs` (24,), actions (7,), pictures and depth."""
        pictures = [key for key in frame if key.startswith(("rgb_", "depth_"))]
        data = {**frame, "scene_obs": frame["scene_obs"][self._columns]}
        if self._image_size:
            data |= {key: resize(frame[key], self._image_size) for key in pictures}
        for key in STATES:
            sums = np.stack([data[key], data[key] ** 2])
            self._sums[key] = self._sums.get(key, 0.0) + sums
        # the quickest compression shrinks pictures to a third, and others hardly further
        kind = zipfile.ZIP_DEFLATED if pictures else zipfile.ZIP_STORED
        with zipfile.ZipFile(self._partial / f"{self.frames:06d}.npz", "w", kind, compresslevel=1) as file:
            for key, value in data.items():
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, np.asanyarray(value), allow_pickle=False)
                file.writestr(f"{key}.npy", buffer.getbuffer())
        self.frames += 1

    def sums(self) -> dict[str, list[list[float]]]:
        """Sums over the frames written so far, as in `Unit`."""
        return {key: value.tolist() for key, value in self._sums.items()}

    def __enter__(self) -> "FrameWriter":
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._partial.rename(self._folder)
        else:
            shutil.rmtree(self._partial, ignore_errors=True)


def publish_split(
    target: Path,
    units: Sequence[tuple[Path, Unit, Sequence[str]]],
    first_frame: int,
    config: dict[str, Any],
    sentences: dict[str, str],
) -> int:
    """Builds one split (`training` or `validation`) from recorded units; `target` appears when it is complete.

    Args:
        target: The split's folder; must not exist.
        units: Folder, unit and the sentences of its windows, in the order of their frame numbers; units of one scene
            are next to each other.
        first_frame: Number of the first frame.
        config: Written to `.hydra/merged_config.yaml`.
        sentences: Task to the benchmark's sentence; written to the validation split only.

    Returns:
        The number after the last frame.
    """
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "lang_annotations").mkdir(parents=True)
    (partial / ".hydra").mkdir()
    number = first_frame
    recordings: list[tuple[int, int]] = []
    windows: list[tuple[int, int]] = []
    tasks: list[str] = []
    spoken: list[str] = []
    scenes: dict[str, list[int]] = {}
    for folder, unit, unit_sentences in tqdm(units, desc=f"writing {target.name}", unit="recording", leave=False):
        for index in range(unit.frames):
            _link(folder / f"{index:06d}.npz", partial / FRAME.format(number + index))
        recordings += [(number + start, number + end - 1) for start, end in unit.recordings]  # both inclusive
        windows += [(number + start, number + end) for start, end, _ in unit.windows]  # end exclusive
        tasks += [task for *_, task in unit.windows]
        spoken += unit_sentences
        scenes.setdefault(f"calvin_scene_{unit.scene}", [number, 0])[1] = number + unit.frames - 1
        number += unit.frames
    annotations = {
        "language": {"ann": spoken, "task": tasks, "emb": np.zeros((len(spoken), 0), dtype=np.float32)},
        "info": {"episodes": [], "indx": windows},
    }
    _save(partial / "lang_annotations" / "auto_lang_ann.npy", annotations)
    if target.name == "validation":
        benchmark = {task: {"ann": [sentence]} for task, sentence in sentences.items()}
        _save(partial / "lang_annotations" / "embeddings.npy", benchmark)
    bounds = np.array(recordings, dtype=np.int64).reshape(-1, 2)
    np.save(partial / "ep_start_end_ids.npy", bounds)
    np.save(partial / "ep_lens.npy", bounds[:, 1] - bounds[:, 0] + 1)
    _save(partial / "scene_info.npy", scenes)
    (partial / "statistics.yaml").write_text(yaml.safe_dump(_statistics([unit for _, unit, _ in units])))
    (partial / ".hydra" / "merged_config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    partial.rename(target)
    return number


def _statistics(units: Sequence[Unit]) -> dict[str, dict[str, list[float]]]:
    count = sum(unit.frames for unit in units)
    statistics = {}
    for key in STATES if count else ():
        total, squares = np.sum([unit.sums[key] for unit in units], axis=0)
        mean = total / count
        deviation = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
        statistics[key] = {"mean": mean.tolist(), "std": deviation.tolist()}
    return statistics


def _save(file: Path, content: dict[str, Any]) -> None:
    """Pickles a dictionary, as CALVIN's own files do."""
    np.save(file, np.array(content, dtype=object), allow_pickle=True)


def _link(source: Path, target: Path) -> None:
    """Makes a hard link, or a copy where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
