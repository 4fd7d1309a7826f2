"""How fast LanSAR trains: windows per second, and the share of the time spent waiting for data.

    python benchmarks/training.py [--preset=lansar_small] [--root=DATASET] [--batch_size=24] [--updates=10]
        [--device=cpu] [--threads=1] [--output=FILE.json]

The loop is lerobot-train's: LeRobotDataset, DataLoader (no workers), preprocessor, forward, backward, AdamW.
Without --root it runs on random demonstrations made in a temporary folder.
"""

import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus
import numpy as np
import torch
from latency import load_preset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from lerobot_lansar.policy import make_lansar_pre_post_processors
from lerobot_lansar.policy.frames import CAMERAS, clip_dir, dataset_fingerprint
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
from lerobot_lansar.policy.windows import ACTION_NAMES


@dataclass
class Options:
    """Command-line options."""

    preset: str = "lansar_small"  # configs/<preset>.yaml
    root: Path | None = None  # a LeRobotDataset's folder
    batch_size: int = 24
    updates: int = 10  # measured, after two to warm up
    device: str = "cpu"
    threads: int = 1
    output: Path | None = None


def random_dataset(root: Path, episodes: int = 20, length: int = 64) -> None:
    """A LeRobotDataset of random numbers with the features LanSAR needs."""

    def feature(size: int, names: list[str] | None = None) -> dict:
        return {"dtype": "float32", "shape": (size,), "names": names}

    sizes = {"observation.state": 15, "observation.environment_state": 24, "action": 7}
    features = {name: feature(size) for name, size in sizes.items()}
    features["action"] = feature(7, ACTION_NAMES["rel"])
    dataset = LeRobotDataset.create(
        "benchmark/random", fps=30, features=features, root=root, use_videos=False
    )
    rng = np.random.default_rng(0)
    for _ in tqdm(range(episodes), desc="Making demonstrations", leave=False):
        for _ in range(length):
            frame = {name: rng.normal(size=size).astype(np.float32) for name, size in sizes.items()}
            dataset.add_frame({**frame, "task": "open the drawer"})
        dataset.save_episode()
    dataset.finalize()


def random_embeddings(root: Path, frames: int, model: str, size: int) -> None:
    """Picture embeddings of random numbers beside a dataset that has none."""
    clip_dir(root).mkdir()
    for key in CAMERAS.values():
        values = np.random.default_rng(0).normal(size=(frames, size)).astype(np.float16)
        np.save(clip_dir(root) / f"{key}.npy", values)
    info = {"model": model, "pretrained": "", "weights_sha256": "", "embed_dim": size, "frames": frames}
    info["fingerprint"] = dataset_fingerprint(root)
    (clip_dir(root) / "clip.json").write_text(json.dumps(info))


def measure(options: Options, root: Path) -> dict:
    config = load_preset(options.preset, options.device)
    dataset = LeRobotDataset("benchmark/random", root=root)
    if options.root is None and config.use_images:
        random_embeddings(root, len(dataset), config.clip.model, config.network.clip_dim)
    policy = LanSARPolicy(config, dataset_meta=dataset.meta).to(options.device).train()
    preprocess, _ = make_lansar_pre_post_processors(config)
    optimizer = config.get_optimizer_preset().build(policy.parameters())
    loader = torch.utils.data.DataLoader(dataset, options.batch_size, shuffle=True, drop_last=True)
    if len(loader) == 0:
        raise ValueError(
            f"--batch_size={options.batch_size} is more than the dataset's {len(dataset)} frames."
        )

    def batches():
        while True:
            yield from loader

    source = batches()
    waiting, computing, steps = [], [], []
    for _ in tqdm(range(options.updates + 2), desc="Updates", leave=False):
        start = time.perf_counter()
        batch = preprocess(next(source))
        ready = time.perf_counter()
        loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        loss.item()  # waits for a GPU
        end = time.perf_counter()
        waiting.append(ready - start)
        computing.append(end - ready)
        steps.append(len(batch["valid_steps"]))
    data, update = (sum(values[2:]) / options.updates for values in (waiting, computing))
    return {
        "preset": options.preset,
        "parameters": sum(p.numel() for p in policy.parameters()),
        "batch_size": options.batch_size,
        "valid_steps_per_window": sum(steps[2:]) / options.updates / options.batch_size,
        "update_ms": 1000 * update,
        "data_ms": 1000 * data,
        "windows_per_s": options.batch_size / (data + update),
        "waiting_share": data / (data + update),
    }


@draccus.wrap()
def main(options: Options) -> None:
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as scratch:
        root = options.root
        if root is None:
            root = Path(scratch) / "random"
            random_dataset(root)
        row = measure(options, root)
    for name, value in row.items():
        print(f"{name:>24}  {value if isinstance(value, str | int) else round(value, 4)}")
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        settings = {
            k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items() if k != "output"
        }
        options.output.write_text(json.dumps({"settings": settings, "rows": [row]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
