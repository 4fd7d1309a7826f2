"""How fast LanSAR trains: the cost of reading, the share of time spent waiting for data, and the speed of updates.

    python benchmarks/training.py [--preset=lansar] [--root=DATASET] [--batch_size=96] [--updates=10]
        [--device=cpu] [--threads=1] [--output=FILE.json]
    python benchmarks/training.py --preset=thesis/no_images --device=cuda --updates=50 \
        --variants='[float32,tf32,bfloat16,bfloat16+compile]'

Reading: milliseconds of CPU per sample, a window of the preset's length (with picture embeddings if it uses them), as
LanSAR reads it, with LeRobot's own delta timestamps, and as a bare lookup in memory-mapped arrays, the floor.

Updates: the loop is lerobot-train's (LeRobotDataset, DataLoader, preprocessor, forward, backward, the preset's
optimizer). PyTorch counts the FLOP; the ceiling is its product of 2048 x 2048 matrices (8192 x 8192 on a GPU) on the
same device and dtype. On a GPU, one more update tells where the CPU waits for it (torch.cuda.set_sync_debug_mode).
Without --root the data are random demonstrations of 64 steps in a temporary folder.
"""

import json
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from latency import load_preset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from lerobot_lansar.calvin import ACTION_NAMES
from lerobot_lansar.clip.store import IMAGE_FEATURES, clip_dir, dataset_fingerprint
from lerobot_lansar.policy import make_lansar_pre_post_processors
from lerobot_lansar.policy.configuration_lansar import LanSARConfig
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

WARM_UP = 5
"""Updates that are not measured: they allocate, choose kernels and compile."""


@dataclass
class Options:
    """What to measure."""

    preset: str = "lansar"  # configs/<preset>.yaml
    root: Path | None = None  # a LeRobotDataset's folder
    batch_size: int = 96
    num_workers: int = 0  # processes that read samples, as --num_workers of lerobot-train
    updates: int = 10  # measured, after those for warm-up
    device: str = "cpu"
    # Of float32, tf32 (matrix products of float32 in TF32, as lerobot-train sets it), bfloat16 (mixed precision, as
    # --policy.dtype) and each of them with +compile (as --policy.compile_model). A row for each.
    variants: list[str] = field(default_factory=lambda: ["float32"])
    threads: int = 1
    output: Path | None = None


def random_dataset(root: Path, embedding: int, episodes: int = 20, length: int = 64) -> None:
    """Makes a LeRobotDataset of random numbers; it has picture embeddings of size `embedding` as columns, none if 0."""
    sizes = {"observation.state": 15, "observation.environment_state": 24, "action": 7}
    if embedding:
        sizes |= {f"observation.clip.{name}": embedding for name in IMAGE_FEATURES}
    names = {"action": ACTION_NAMES["rel"]}
    features = {k: {"dtype": "float32", "shape": (size,), "names": names.get(k)} for k, size in sizes.items()}
    dataset = LeRobotDataset.create("benchmark/random", fps=30, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for _ in tqdm(range(episodes), desc="Making demonstrations", leave=False):
        for _ in range(length):
            frame = {name: rng.normal(size=size).astype(np.float32) for name, size in sizes.items()}
            dataset.add_frame({**frame, "task": "open the drawer"})
        dataset.save_episode()
    dataset.finalize()


def random_embeddings(root: Path, frames: int, model: str, size: int) -> None:
    """Puts random picture embeddings beside a dataset."""
    clip_dir(root).mkdir()
    for key in IMAGE_FEATURES.values():
        values = np.random.default_rng(0).normal(size=(frames, size)).astype(np.float16)
        np.save(clip_dir(root) / f"{key}.npy", values)
    info = {"model": model, "pretrained": "", "weights_sha256": "", "embed_dim": size, "frames": frames}
    info["fingerprint"] = dataset_fingerprint(root)
    (clip_dir(root) / "clip.json").write_text(json.dumps(info))


def cpu_ms(call: Callable[[], Any], samples: int) -> float:
    """Milliseconds of this process' CPU per sample, after one call to warm up."""
    call()
    started = time.process_time()
    call()
    return 1e3 * (time.process_time() - started) / samples


def reading(config: LanSARConfig, scratch: Path) -> dict[str, float]:
    """Milliseconds of CPU per sample, three ways, on the same random demonstrations."""
    embedding = config.network.clip_dim if config.use_images else 0
    random_dataset(scratch / "own", 0)
    ours = LeRobotDataset("benchmark/random", root=scratch / "own")
    if embedding:
        random_embeddings(scratch / "own", len(ours), config.clip.model, embedding)
    policy = LanSARPolicy(config, dataset_meta=ours.meta)
    preprocess, _ = make_lansar_pre_post_processors(config)
    lookup = next(step for step in preprocess.steps if hasattr(step, "windows"))
    loader = torch.utils.data.DataLoader(ours, 96, sampler=range(0, 960, 2))
    found = {"LanSAR's windows": cpu_ms(lambda: [preprocess(batch) for batch in loader], 480)}

    random_dataset(scratch / "lerobot", embedding)
    meta = LeRobotDataset("benchmark/random", root=scratch / "lerobot").meta
    keys = [key for key in meta.features if key.startswith("observation.") or key == "action"]
    deltas = {key: [step / meta.fps for step in range(config.window)] for key in keys}
    theirs = LeRobotDataset("benchmark/random", root=scratch / "lerobot", delta_timestamps=deltas)
    found["LeRobot's delta timestamps"] = cpu_ms(lambda: [theirs[i] for i in range(0, 960, 120)], 8)

    rows = np.random.default_rng(0).integers(0, 640, 96)
    arrays = [*lookup.windows.arrays.values(), *lookup.windows.embeddings.values()]
    steps = rows[:, None] + np.arange(config.window)
    found["bare lookup"] = cpu_ms(lambda: [torch.from_numpy(np.asarray(a[steps])).float() for a in arrays], 96)
    del policy
    return found


def ceiling(device: str, dtype: torch.dtype) -> float:
    """TFLOP/s of a large matrix product."""
    size, count = (8192, 40) if device.startswith("cuda") else (2048, 4)
    a, b = (torch.randn(size, size, device=device, dtype=dtype) for _ in range(2))
    for _ in range(2):
        a @ b
    finished(device)
    started = time.perf_counter()
    for _ in range(count):
        a @ b
    finished(device)
    return count * 2 * size**3 / (time.perf_counter() - started) / 1e12


def finished(device: str) -> None:
    """Waits for a GPU to finish its work."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def waits(update: Callable[[], None]) -> list[str]:
    """Places in the code where one update makes the CPU wait for the GPU; there should be none."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            update()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return [f"{w.filename}:{w.lineno}" for w in found if "called a synchronizing" in str(w.message)]


def updates(options: Options, variant: str, config: LanSARConfig, root: Path) -> dict[str, Any]:
    """Times and arithmetic of whole updates."""
    precision, _, compiled = variant.partition("+")
    if precision not in ("float32", "tf32", "bfloat16") or compiled not in ("", "compile"):
        raise ValueError(f"--variants: {variant!r} is not float32, tf32 or bfloat16, each with or without +compile.")
    torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
    dataset = LeRobotDataset("benchmark/random", root=root)
    plain = LanSARPolicy(config, dataset_meta=dataset.meta).to(options.device).train()
    config = replace(config, compile_model=bool(compiled))
    policy = LanSARPolicy(config, dataset_meta=dataset.meta).to(options.device).train()
    preprocess, _ = make_lansar_pre_post_processors(config)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    workers = options.num_workers
    loader = torch.utils.data.DataLoader(
        dataset,
        options.batch_size,
        shuffle=True,
        drop_last=True,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        persistent_workers=workers > 0,
    )
    if len(loader) == 0:
        raise ValueError(f"--batch_size={options.batch_size} is more than the dataset's {len(dataset)} frames.")
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    device_type = torch.device(options.device).type

    def batches() -> Iterator[Any]:
        while True:
            yield from loader

    def loss_of(policy: LanSARPolicy, batch: dict[str, Any]) -> torch.Tensor:
        with torch.autocast(device_type, dtype=torch.bfloat16, enabled=precision == "bfloat16"):
            return policy.forward(batch)[0]

    def update(batch: dict[str, Any]) -> None:
        loss = loss_of(policy, batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10)
        optimizer.step()
        optimizer.zero_grad()

    source = batches()
    waiting, computing, steps = [], [], []
    operations = 0
    for number in tqdm(range(options.updates + WARM_UP), desc="Updates", leave=False):
        start = time.perf_counter()
        batch = preprocess(next(source))
        finished(options.device)
        ready = time.perf_counter()
        if number == 0:
            # The counter sees neither inside compiled code nor, on a CPU, fused attention.
            with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
                loss_of(plain, batch).backward()
            operations = counter.get_total_flops() // len(batch["valid_steps"])
            del plain
        update(batch)
        finished(options.device)
        waiting.append(ready - start)
        computing.append(time.perf_counter() - ready)
        steps.append(len(batch["valid_steps"]))
    waiting_for_gpu = None
    if device_type == "cuda":
        batch = preprocess(next(source))
        waiting_for_gpu = waits(lambda: update(batch))
    data, compute = (sum(values[WARM_UP:]) / options.updates for values in (waiting, computing))
    rate = operations * sum(steps[WARM_UP:]) / sum(computing[WARM_UP:]) / 1e12
    largest = ceiling(options.device, dtype)
    return {
        "variant": variant,
        "parameters": sum(p.numel() for p in policy.parameters()),
        "batch_size": options.batch_size,
        "valid_steps_per_window": sum(steps[WARM_UP:]) / options.updates / options.batch_size,
        "update_ms": 1000 * compute,
        "data_ms": 1000 * data,
        "windows_per_s": options.batch_size / (data + compute),
        "waiting_share": data / (data + compute),
        "tflop_per_update": operations * sum(steps[WARM_UP:]) / options.updates / 1e12,
        "tflop_per_s": rate,
        "ceiling_tflop_per_s": largest,
        "share_of_ceiling": rate / largest,
        "warm_up_s": sum(waiting[:WARM_UP]) + sum(computing[:WARM_UP]),
        "waits_for_gpu": waiting_for_gpu,
        "hours_for_30000_updates": 30_000 * (data + compute) / 3600,
    }


def write(options: Options, read: dict[str, float], rows: list[dict[str, Any]]) -> None:
    """Writes --output."""
    assert options.output is not None
    options.output.parent.mkdir(parents=True, exist_ok=True)
    settings = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items() if k != "output"}
    result = {"settings": settings, "reading_ms": read, "updates": rows}
    options.output.write_text(json.dumps(result, indent=2) + "\n")


@draccus.wrap()
def main(options: Options) -> None:
    """Measures everything and prints both tables."""
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as scratch:
        read = reading(load_preset(options.preset, "cpu"), Path(scratch))
        rows = []
        for variant in options.variants:
            config = load_preset(options.preset, options.device)
            rows.append(updates(options, variant, config, options.root or Path(scratch) / "own"))
            print({name: round(value, 4) if isinstance(value, float) else value for name, value in rows[-1].items()})
            if options.output:  # whatever becomes of the next variant
                write(options, read, rows)
    floor = read["bare lookup"]
    print("| reading a sample | ms of CPU | times the floor |\n| --- | ---: | ---: |")
    for name, value in read.items():
        print(f"| {name} | {value:.3f} | {value / floor:.1f} |")


if __name__ == "__main__":
    main()
