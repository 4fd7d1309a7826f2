"""A hand-made LeRobotDataset v3 in CALVIN's conventions, and small LanSARs, for the policy's tests."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_lansar.calvin import ACTION_NAMES, continuous_euler

os.environ.setdefault("HF_HUB_OFFLINE", "1")
torch.set_num_threads(1)

CONFIGS = Path(__file__).parents[2] / "configs"
LENGTHS = (20, 90, 9, 64)
COMMANDS = ("open the drawer", "lift the red block", "close the drawer", "turn on the lamp")
VIDEO = "observation.images.static"
SMALL = {
    "device": "cpu",
    "push_to_hub": False,
    "hidden": 32,
    "context_layers": 2,
    "context_heads": 2,
    "decoder_layers": 2,
    "decoder_heads": 2,
    "feedforward": 64,
    "use_images": False,
}


def small_config(**options):
    """A LanSARConfig small enough for tests, with lansar-desk untrained."""
    from lerobot_lansar.clip.config import ClipConfig
    from lerobot_lansar.policy.configuration_lansar import LanSARConfig

    return LanSARConfig(**{**SMALL, "clip": ClipConfig("lansar-desk", ""), **options})


def thesis_network(**options):
    """The NetworkConfig of the thesis' baseline, with changed options of LanSARConfig."""
    from lerobot_lansar.policy.configuration_lansar import LanSARConfig

    thesis = {"orientation": "euler", "egocentric_blocks": False, "command_in_context": False}
    return LanSARConfig(**{"device": "cpu", **thesis, **options}).network


def smooth_episode(rng: np.random.Generator, length: int) -> dict[str, np.ndarray]:
    """State (15), environment state (24), absolute and relative action (7) of one episode."""
    steps = np.arange(length)
    state = np.zeros((length, 15))
    state[:, :3] = rng.normal(0, 0.1, 3) + np.cumsum(rng.normal(0, 0.004, (length, 3)), axis=0)
    state[:, 3:6] = [np.pi, 0, 1] + 0.05 * np.sin(steps[:, None] / 5 + rng.normal(0, 1, 3))
    state[:, 3:6] = continuous_euler(state[:, 3:6])
    state[:, 6] = 0.04 + 0.04 * np.sin(steps / 9)
    state[:, 7:14] = rng.normal(0, 1, 7) + 0.1 * np.sin(steps[:, None] / 7)
    gripper = np.where(np.sin(steps / 6 + rng.normal()) > 0, 1.0, -1.0)
    state[1:, 14], state[0, 14] = gripper[:-1], 1.0
    environment = rng.normal(0, 0.2, 24) + 0.01 * np.sin(steps[:, None] / 8)
    environment[:, 4:6] = rng.integers(0, 2, 2)
    delta = rng.uniform(-1, 1, (length, 6)) * ([0.015] * 3 + [0.04] * 3)
    absolute = np.concatenate([state[:, :6] + delta, gripper[:, None]], axis=1)
    absolute[:, 3:6] = continuous_euler(absolute[:, 3:6])
    relative = np.concatenate([delta / ([0.02] * 3 + [0.05] * 3), gripper[:, None]], axis=1)
    arrays = {"state": state, "environment": environment, "abs": absolute, "rel": relative}
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def make_dataset(
    root: Path,
    form: str = "rel",
    lengths: tuple[int, ...] = LENGTHS,
    seed: int = 0,
    shown: tuple[tuple[int, str], ...] = (),
    video: bool = False,
):
    """Write a LeRobotDataset; returns the episodes' arrays.

    With `shown`, the number of each episode's CALVIN task and its sentence, the dataset has the column calvin.task.
    With `video`, it has a camera whose videos cannot be decoded; without, no pictures.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    def feature(size, names=None):
        return {"dtype": "float32", "shape": (size,), "names": names}

    features = {
        "observation.state": feature(15),
        "observation.environment_state": feature(24),
        "action": feature(7, ACTION_NAMES[form]),
    }
    if shown:
        features["calvin.task"] = {"dtype": "int64", "shape": (1,), "names": None}
    if video:
        features[VIDEO] = {"dtype": "video", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create("test/desk", fps=30, features=features, root=root, use_videos=video)
    rng = np.random.default_rng(seed)
    episodes = [smooth_episode(rng, length) for length in lengths]
    for i, episode in enumerate(episodes):
        for t in range(lengths[i]):
            frame = {
                "observation.state": episode["state"][t],
                "observation.environment_state": episode["environment"][t],
                "action": episode[form][t],
                "task": shown[i][1] if shown else COMMANDS[i % len(COMMANDS)],
            }
            if shown:
                frame["calvin.task"] = np.array([shown[i][0]])
            if video:
                frame[VIDEO] = np.full((64, 64, 3), t, np.uint8)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    for file in root.rglob("*.mp4"):
        file.write_bytes(b"")
    return episodes


def add_embeddings(root: Path, clip) -> np.ndarray:
    """Put made-up picture embeddings beside a dataset, as lansar-convert does; returns static's."""
    from lerobot_lansar.clip.store import IMAGE_FEATURES, clip_dir, dataset_fingerprint

    frames = json.loads((root / "meta" / "info.json").read_text())["total_frames"]
    clip_dir(root).mkdir()
    rng = np.random.default_rng(1)
    arrays = {name: rng.normal(size=(frames, clip.embed_dim)).astype(np.float16) for name in IMAGE_FEATURES}
    for name, key in IMAGE_FEATURES.items():
        np.save(clip_dir(root) / f"{key}.npy", arrays[name])
    info = {
        "model": clip.config.model,
        "pretrained": clip.config.pretrained,
        "weights_sha256": clip.weights_sha256,
        "embed_dim": clip.embed_dim,
        "frames": frames,
        "fingerprint": dataset_fingerprint(root),
    }
    (clip_dir(root) / "clip.json").write_text(json.dumps(info))
    return arrays["static"]


def dataset_meta(root: Path) -> SimpleNamespace:
    """As much of LeRobot's dataset metadata as the policy asks for."""
    info = json.loads((root / "meta" / "info.json").read_text())
    return SimpleNamespace(root=root, features=info["features"], total_frames=info["total_frames"])


def observation(rng: np.random.Generator, rows: int, pictures: bool = False) -> dict[str, torch.Tensor]:
    """An env observation as LeRobot hands it to the preprocessor."""
    seen = {
        "observation.state": torch.tensor(rng.normal(size=(rows, 15)), dtype=torch.float32),
        "observation.environment_state": torch.tensor(rng.normal(size=(rows, 24)), dtype=torch.float32),
    }
    for camera, size in {"static": 200, "gripper": 84}.items() if pictures else ():
        picture = rng.uniform(size=(rows, 3, size, size))
        seen[f"observation.images.{camera}"] = torch.tensor(picture, dtype=torch.float32)
    return seen


@pytest.fixture(scope="session")
def relative(tmp_path_factory):
    """(root, episodes) of a dataset with relative actions; read-only."""
    root = tmp_path_factory.mktemp("datasets") / "rel"
    return root, make_dataset(root, "rel")


@pytest.fixture(scope="session")
def absolute(tmp_path_factory):
    """The same episodes with absolute actions."""
    root = tmp_path_factory.mktemp("datasets") / "abs"
    return root, make_dataset(root, "abs")
