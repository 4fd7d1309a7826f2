"""Recorded demonstrations: an episode of a LeRobotDataset made by `lansar-convert`, or a window of a CALVIN folder."""

import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_convert.blocks import block_order, gather_evidence, reorder_blocks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.frames import VECTORS
from dataset_convert.scenes import SCENE_FILE
from lerobot_lansar.datasets import MANIFEST, find_dataset

from ..calvin import ACTION_NAMES, CAMERAS, SCENE_NAMES, SCENE_OBS_NAMES, TASKS
from ..command import CommandError

_STATE, _SCENE_STATE = "observation.state", "observation.environment_state"
_COLUMNS = {"abs": "calvin.actions", "rel": "calvin.rel_actions"}
"""Control mode to the column that keeps the form of action that `action` does not have."""


@dataclass
class Recording:
    """One demonstration of n frames.

    Attributes:
        name: Such as `episode 3`.
        scene: Letter of the scene; "" if the data do not say.
        task: Name of the task; "" if the data do not say.
        sentence: The command in words.
        robot_obs: (n, 15).
        scene_obs: (n, 24) with blocks in red, blue, pink order.
        actions: Control mode to (n, 7); frame t's action is taken in frame t's state.
        pictures: Camera to (n, size, size, 3) uint8; none if they were not asked for or not recorded.
    """

    name: str
    scene: str
    task: str
    sentence: str
    robot_obs: np.ndarray
    scene_obs: np.ndarray
    actions: dict[str, np.ndarray]
    pictures: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.robot_obs)


class Source(Protocol):
    """Where recordings are.

    Attributes:
        unit: What one of its recordings is called.
        control_mode: The form of action to replay unless the user wants another.
    """

    unit: str
    control_mode: str

    def __len__(self) -> int:
        """How many recordings it has."""

    def whole(self) -> list[int]:
        """Numbers of the recordings that can be replayed."""

    def read(self, number: int, pictures: bool) -> Recording:
        """Reads a recording, with or without its pictures."""


class DatasetSource:
    """The episodes of a LeRobotDataset made by `lansar-convert`.

    Args:
        repo_id: The dataset's name.
        folder: Its folder; None: where LeRobot has it.

    Raises:
        FileNotFoundError: It is not there.
        CommandError: It lacks the states or actions that `lansar-convert` writes.
    """

    unit = "episode"

    def __init__(self, repo_id: str, folder: Path | None):
        from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # seconds; a CALVIN folder needs none

        self._repo_id, self._root = repo_id, find_dataset(repo_id, folder)
        if not (self._root / "meta/info.json").is_file():
            raise FileNotFoundError(f"{self._root} holds no LeRobotDataset: give its folder as --dataset_dir")
        self._meta = LeRobotDatasetMetadata(repo_id, root=self._root)
        features = self._meta.features
        names = {key: tuple(features.get(key, {}).get("names") or ()) for key in (_STATE, _SCENE_STATE, "action")}
        modes = [mode for mode, wanted in ACTION_NAMES.items() if names["action"] == wanted]
        scene = names[_SCENE_STATE][: len(SCENE_OBS_NAMES)]
        if len(names[_STATE]) != 15 or scene != SCENE_OBS_NAMES or not modes:
            raise CommandError(
                f"{self._root}: a replay needs {_STATE}, {_SCENE_STATE} and action as lansar-convert writes them "
                "(not with --scene_state=false)"
            )
        (self.control_mode,) = modes
        self._vectors = [_STATE, _SCENE_STATE, "action"]
        self._vectors += [column for column in _COLUMNS.values() if column in features]
        self._numbers = ["task_index", *(column for column in ("calvin.task", "calvin.scene") if column in features)]
        manifest = self._root / MANIFEST
        told = json.loads(manifest.read_text()) if manifest.is_file() else {}  # merged and edited datasets have none
        self._task_names = told.get("task_names", list(TASKS))
        self._scene_names = told.get("scene_names", list(SCENE_NAMES))

    def __len__(self) -> int:
        return self._meta.total_episodes

    def whole(self) -> list[int]:
        """All episodes: faulty windows were left out."""
        return list(range(len(self)))

    def read(self, number: int, pictures: bool) -> Recording:
        """Reads an episode.

        Raises:
            CommandError: It holds several commands.
        """
        file = self._root / self._meta.get_data_file_path(number)
        columns = [*self._vectors, *self._numbers]
        rows = pq.read_table(file, columns=columns, filters=[("episode_index", "=", number)])
        vectors = {name: np.stack(rows[name].to_numpy()).astype(np.float64) for name in self._vectors}
        actions = {mode: vectors[column] for mode, column in _COLUMNS.items() if column in vectors}
        task = self._only(rows, "calvin.task", number)
        scene = self._only(rows, "calvin.scene", number)
        return Recording(
            name=f"episode {number}",
            scene=self._scene_names[scene] if 0 <= scene < len(self._scene_names) else "",
            task=self._task_names[task] if 0 <= task < len(self._task_names) else "",
            sentence=str(self._meta.tasks.index[self._only(rows, "task_index", number)]),
            robot_obs=vectors[_STATE],
            scene_obs=vectors[_SCENE_STATE][:, :24],
            actions={**actions, self.control_mode: vectors["action"]},
            pictures=self._pictures(number) if pictures else {},
        )

    def _only(self, rows: pa.Table, column: str, number: int) -> int:
        """The one number that a column has in an episode; -1 if there is no such column."""
        if column not in rows.column_names:
            return -1
        values = np.unique(rows[column].to_numpy())
        if len(values) != 1:
            raise CommandError(
                f"episode {number} of {self._root} holds several commands: convert with --mode=windows, or replay a "
                "window of the CALVIN folder with --root=… --window=…"
            )
        return int(values[0])

    def _pictures(self, number: int) -> dict[str, np.ndarray]:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        keys = {camera: f"observation.images.{camera}" for camera in CAMERAS}
        keys = {camera: key for camera, key in keys.items() if key in self._meta.features}
        if not keys:
            return {}
        dataset = LeRobotDataset(self._repo_id, root=self._root, episodes=[number], video_backend="pyav")
        items = [dataset[index] for index in range(len(dataset))]
        return {camera: np.stack([_as_uint8(item[key]) for item in items]) for camera, key in keys.items()}


def _as_uint8(picture: Any) -> np.ndarray:
    """A picture as LeRobot gives it, a tensor (3, H, W) in [0, 1], as (H, W, 3) uint8."""
    return (picture.permute(1, 2, 0) * 255).round().byte().numpy()


class FolderSource:
    """The annotated windows of one split of a CALVIN folder.

    Args:
        root: The folder.
        split: The split's name.
        scene: Its scene's letter if no file says it.

    Raises:
        FileNotFoundError: Files are missing.
        ValueError: An index file is malformed.
    """

    unit = "window"
    control_mode = "abs"

    def __init__(self, root: Path, split: str, scene: str = ""):
        scene = "" if (root / split / SCENE_FILE).is_file() else scene
        self._split = CalvinSplit(root, split, scene=scene, skip_bad=True)
        if not self._split.windows:
            raise CommandError(f"{self._split.language} holds no annotated window to replay")
        self._order = cache(self._block_order)

    def __len__(self) -> int:
        return len(self._split.windows)

    def whole(self) -> list[int]:
        """Windows without faults."""
        return [number for number in range(len(self)) if number not in self._split.faults]

    def read(self, number: int, pictures: bool) -> Recording:
        """Reads a window; its blocks are put into red, blue, pink order as `lansar-convert` does it.

        Raises:
            FileNotFoundError: A frame is missing.
            ValueError: The window is faulty, a frame is damaged, or the blocks' order cannot be told.
        """
        if number in self._split.faults:
            raise ValueError(f"window {number} cannot be replayed: {self._split.faults[number]}")
        window = self._split.windows[number]
        frames = range(window.start, window.end)
        arrays = self._split.read(frames, VECTORS)
        with np.load(self._split.frame_file(window.start)) as file:
            stored = {camera: f"rgb_{camera}" for camera in CAMERAS if f"rgb_{camera}" in file.files and pictures}
        seen = self._split.read(frames, stored.values())
        return Recording(
            name=f"window {number}",
            scene=window.scene,
            task=window.task,
            sentence=window.sentence,
            robot_obs=arrays["robot_obs"],
            scene_obs=reorder_blocks(arrays["scene_obs"], self._order(window.scene)),
            actions={"abs": arrays["actions"], "rel": arrays["rel_actions"]},
            pictures={camera: seen[key] for camera, key in stored.items()},
        )

    def _block_order(self, scene: str) -> tuple[str, ...]:
        return block_order(scene, gather_evidence(self._split, scene), "known")  # others show as failures
