"""A small synthetic CALVIN split, valid in every respect, that tests then damage."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_lansar.calvin import BLOCK_ORDER, relative_action

COMMANDS = {
    "lift_red_block_table": "pick up the red block",
    "lift_blue_block_table": "pick up the blue block",
    "lift_pink_block_table": "pick up the pink block",
    "open_drawer": "pull the handle of the drawer",
}


@dataclass
class FakeCalvin:
    """Where the split is and what was written.

    Attributes:
        root: The dataset's folder.
        windows: (start, end, task, sentence) of each window.
        frames: Frame number -> what its file holds.
        split: The split's name.
    """

    root: Path
    windows: list[tuple[int, int, str, str]]
    frames: dict[int, dict[str, np.ndarray]]
    split: str = "training"

    @property
    def folder(self) -> Path:
        return self.root / self.split

    def file(self, frame: int) -> Path:
        return self.folder / f"episode_{frame:07d}.npz"

    def rewrite(self, frame: int, **changes: np.ndarray | None) -> None:
        """Writes one frame again with some arrays changed, or dropped if None."""
        content = {**self.frames[frame], **changes}
        np.savez(self.file(frame), **{key: value for key, value in content.items() if value is not None})


def without_jumps(pose: np.ndarray) -> np.ndarray:
    """A state or an absolute action as a dataset holds it: roll in [0, 2 pi), yaw in [-pi/2, 3 pi/2), float32."""
    pose = pose.copy()
    pose[3] += 2 * np.pi * (pose[3] < 0)
    pose[5] += 2 * np.pi * (pose[5] < -np.pi / 2)
    return pose.astype(np.float32)


def write_calvin(
    root: Path,
    *,
    rgb: bool = False,
    depth: bool = False,
    tactile: bool = False,
    scene: str = "D",
    block_order: tuple[str, ...] | None = None,
    tasks: tuple[str, ...] = tuple(COMMANDS),
    length: int = 12,
    overlap: int = 0,
    seed: int = 0,
    split: str = "training",
    first: int = 100,
) -> FakeCalvin:
    """Writes one recording whose windows carry out `tasks` one after the other.

    Args:
        root: The dataset's folder.
        rgb: Write pictures too.
        depth, tactile: Write distances, and the fingertip sensors' pictures.
        scene: Letter of the scene.
        block_order: Colours of the block columns; the scene's own order by default.
        tasks: One per window.
        length: Frames of a window.
        overlap: Frames that successive windows share.
        seed: Of all random numbers.
        split: Name of the folder to create in `root`.
        first: Number of the first frame.
    """
    rng = np.random.default_rng(seed)
    order = block_order or BLOCK_ORDER[scene]
    folder = root / split
    (folder / "lang_annotations").mkdir(parents=True)
    step = length - overlap
    total = step * len(tasks) + overlap
    time = np.arange(total)
    robot_obs = rng.normal(size=15) * 0.3 + 0.01 * np.cumsum(rng.normal(size=(total, 15)), axis=0)
    robot_obs[:, 3] = np.where(time % 2, 3.139, -3.139)  # roll flips its sign at pi, as on the real desk
    scene_obs = np.tile(rng.normal(size=24) * 0.1, (total, 1))
    actions = robot_obs[:, [0, 1, 2, 3, 4, 5, 14]] + rng.normal(size=(total, 7)) * 0.02
    actions[:, 3] = np.where(rng.random(total) < 0.5, 3.12, -3.12)
    actions[:, 6] = np.where(rng.random(total) < 0.5, -1, 1)
    windows = []
    for number, task in enumerate(tasks):
        start = number * step
        if task.startswith("lift_"):
            column = order.index(task.split("_")[1])
            scene_obs[start : start + length, 6 + 6 * column + 2] += np.linspace(0, 0.2, length)
        windows.append((first + start, first + start + length, task, COMMANDS[task]))
    rel_actions = relative_action(actions, robot_obs)
    frames = {}
    background = rng.integers(0, 80, size=3)
    for i in range(total):
        content = {
            "actions": actions[i],
            "rel_actions": rel_actions[i],
            "robot_obs": robot_obs[i],
            "scene_obs": scene_obs[i],
        }
        if rgb:  # smooth pictures that a lossy codec keeps: a brightness that says which frame it is
            for name, size in (("rgb_static", 200), ("rgb_gripper", 84)):
                picture = np.broadcast_to(background + 9 * (i % 20), (size, size, 3)).astype(np.uint8)
                content[name] = np.ascontiguousarray(picture)
        shade = np.linspace(0, 1, 200)[:, None]
        if depth:
            for name, size, near in (("depth_static", 200, 3.5), ("depth_gripper", 84, 0.05)):
                content[name] = (near + 0.2 * shade[:size] + 0.01 * i + np.zeros((size, size))).astype(np.float32)
        if tactile:
            content["rgb_tactile"] = np.full((160, 120, 6), 40 + i % 50, np.uint8)
            content["rgb_tactile"][..., 3:] += 60
            content["depth_tactile"] = (1e-4 * shade[:160, :, None] * [i, 2.0 * i] + np.zeros((160, 120, 2))).astype(
                np.float32
            )
        frames[first + i] = content
        np.savez(folder / f"episode_{first + i:07d}.npz", **content)
    np.save(folder / "ep_start_end_ids.npy", np.array([[first, first + total - 1]]))
    np.save(folder / "ep_lens.npy", np.array([total]))
    np.save(folder / "scene_info.npy", {f"calvin_scene_{scene}": [first, first + total - 1]}, allow_pickle=True)
    annotations = {
        "language": {
            "ann": [sentence for *_, sentence in windows],
            "task": [task for _, _, task, _ in windows],
            "emb": rng.normal(size=(len(windows), 1, 384)),
        },
        "info": {"indx": [(start, end) for start, end, *_ in windows], "episodes": []},
    }
    np.save(folder / "lang_annotations" / "auto_lang_ann.npy", annotations, allow_pickle=True)
    return FakeCalvin(root, windows, frames, split)
