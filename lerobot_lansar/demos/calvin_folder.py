"""Writes demonstrations the way CALVIN keeps them on disk: one npz per frame, windows and sentences beside them."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..desk.scenes import COLORS, Scene

FRAME = "episode_{:07d}.npz"


@dataclass(frozen=True)
class Recording:
    """One demonstration that lies in ``folder`` as frames ``000000.npz`` …, with what was asked for."""

    folder: Path
    frames: int
    task: str
    sentence: str


def write_frames(folder: Path, frames: dict[str, np.ndarray], scene: Scene) -> None:
    """Writes one npz per frame into ``folder``, which appears only when it is complete.

    ``scene_obs`` comes with blocks in red, blue, pink order and goes to disk in the scene's original order, which is
    what CALVIN's own files have.
    """
    partial = folder.with_name(f"{folder.name}-{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    data = dict(frames)
    data["scene_obs"] = _original_order(frames["scene_obs"], scene)
    save = np.savez_compressed if any(key.startswith("rgb_") for key in data) else np.savez
    for index in range(len(data["actions"])):
        save(partial / f"{index:06d}.npz", **{key: values[index] for key, values in data.items()})  # type: ignore[arg-type]
    partial.rename(folder)


def _original_order(scene_obs: np.ndarray, scene: Scene) -> np.ndarray:
    columns = list(range(6))
    for color in scene.blocks:
        first = 6 + 6 * COLORS.index(color)
        columns += range(first, first + 6)
    return scene_obs[:, columns]


def publish_split(
    target: Path,
    recordings: Sequence[Recording],
    scene: Scene,
    first_frame: int,
    config: dict[str, Any],
    commands: dict[str, list[str]],
) -> int:
    """Builds one split (``training`` or ``validation``) from recorded episodes; ``target`` appears when complete.

    Args:
        target: The split's folder; must not exist.
        recordings: In the order in which they get their frame numbers.
        first_frame: Number of the first frame.
        config: Kept in ``.hydra/merged_config.yaml``.
        commands: The sentences by task; the validation split lists the first one of each.

    Returns:
        The number after the last frame.
    """
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "lang_annotations").mkdir(parents=True)
    (partial / ".hydra").mkdir()
    bounds, number = [], first_frame
    states: dict[str, list[np.ndarray]] = {"robot_obs": [], "scene_obs": []}
    for recording in recordings:
        for index in range(recording.frames):
            source = recording.folder / f"{index:06d}.npz"
            _link(source, partial / FRAME.format(number + index))
        with np.load(recording.folder / "000000.npz") as frame:
            for key, values in states.items():
                values.append(frame[key])
        bounds.append((number, number + recording.frames))
        number += recording.frames
    windows = np.array(bounds, dtype=np.int64).reshape(-1, 2)
    annotations = {
        "language": {
            "ann": [r.sentence for r in recordings],
            "task": [r.task for r in recordings],
            "emb": np.zeros((len(recordings), 0), dtype=np.float32),
        },
        "info": {"episodes": [], "indx": [tuple(int(v) for v in row) for row in windows]},
    }
    _save(partial / "lang_annotations" / "auto_lang_ann.npy", annotations)
    if target.name == "validation":
        sentences = {task: {"ann": [listed[0]]} for task, listed in commands.items()}
        _save(partial / "lang_annotations" / "embeddings.npy", sentences)
    np.save(partial / "ep_start_end_ids.npy", windows - [0, 1])  # first and last frame, both inclusive
    np.save(partial / "ep_lens.npy", windows[:, 1] - windows[:, 0])
    scenes = {f"calvin_scene_{scene.name}": [first_frame, number - 1]}
    _save(partial / "scene_info.npy", scenes)
    statistics = {
        key: {"mean": np.mean(values, 0).tolist(), "std": np.std(values, 0).tolist()}
        for key, values in states.items()
        if values
    }
    (partial / "statistics.yaml").write_text(yaml.safe_dump(statistics))
    (partial / ".hydra" / "merged_config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    partial.rename(target)
    return number


def _save(file: Path, content: dict[str, Any]) -> None:
    """A pickled dictionary, CALVIN's way of keeping them."""
    np.save(file, np.array(content, dtype=object), allow_pickle=True)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
