"""Milliseconds per control step: LanSAR with and without its key-value cache, its peers, and LeRobot's ACT, Diffusion,
VQ-BeT.

    python benchmarks/latency.py [--device=cpu] [--threads=1] [--environments=1] [--steps=64] [--output=FILE.json]

Weights are random, which costs the same as trained ones, and nothing is downloaded. All policies have their default
settings and see the desk's observations: state, static 200 x 200 and gripper 84 x 84 picture. Diffusion and VQ-BeT,
which take one picture or pictures of one size only, see the static one. Times are per executed action: the time of a
chunk is divided by the actions executed, that of several environments by their number.

LanSAR and GR-1 are measured with a full history, over 64 control steps; with --policy.window_slide=32 LanSAR decodes
its whole window twice in them, and MCIL and HULC draw two new plans. At 30 Hz there are 33 ms per step.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import draccus
import torch
import yaml
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from tqdm import tqdm

from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.peers import GR1Config, HULCConfig, MCILConfig
from lerobot_lansar.peers.processor import make_pipelines
from lerobot_lansar.policy import LanSARConfig, make_lansar_pre_post_processors
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

CONFIGS = Path(__file__).parents[1] / "configs"


@dataclass
class Options:
    """What to measure."""

    device: str = "cpu"
    threads: int = 1
    environments: int = 1
    steps: int = 64  # of LanSAR, once its history is full; the others execute two action chunks, at least 16 actions
    output: Path | None = None


def load_preset(name: str, device: str, **changes: Any) -> LanSARConfig:
    """The policy section of a shipped configuration file, with CLIP untrained so that nothing is downloaded."""
    options = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())["policy"]
    options.pop("type")
    options["device"] = device
    options["clip"]["pretrained"] = ""
    config = draccus.decode(LanSARConfig, options | changes)
    config.input_features, config.output_features = {}, {}
    return config


def observation(rows: int, device: str) -> dict[str, Any]:
    """Random numbers in the shapes of the desk's observation."""
    return {
        "observation.state": torch.randn(rows, 15, device=device),
        "observation.environment_state": torch.randn(rows, 24, device=device),
        "observation.images.static": torch.rand(rows, 3, 200, 200, device=device),
        "observation.images.gripper": torch.rand(rows, 3, 84, 84, device=device),
        "task": ["open the drawer"] * rows,
    }


def timed(options: Options, call: Callable[[], Any]) -> float:
    """Seconds that one call takes, including its work on a GPU."""
    if options.device.startswith("cuda"):
        torch.cuda.synchronize()
    started = time.perf_counter()
    call()
    if options.device.startswith("cuda"):
        torch.cuda.synchronize()
    return time.perf_counter() - started


def lansar(options: Options, preset: str, slide: int, name: str) -> dict[str, Any]:
    """One LanSAR with a full window."""
    config = load_preset(preset, options.device, window_slide=slide, history_clear_steps=10**9)
    policy = LanSARPolicy(config).to(options.device).eval()
    preprocess, _ = make_lansar_pre_post_processors(config)
    seconds: dict[str, list[float]] = {"preprocessor": [], "policy": []}
    seen = preprocess(observation(options.environments, options.device))
    for _ in range(config.window):  # fill the history
        policy.select_action(seen)
    for _ in tqdm(range(options.steps), desc=name, leave=False):
        batch = observation(options.environments, options.device)
        seconds["preprocessor"].append(timed(options, lambda: seen.update(preprocess(batch))))  # noqa: B023
        seconds["policy"].append(timed(options, lambda: policy.select_action(seen)))
    mean = {what: sum(times) / len(times) for what, times in seconds.items()}
    each = [value / options.environments for value in mean.values()]
    return row(name, policy, each[0], each[1], max(seconds["policy"]))


def whole_window(options: Options, preset: str, name: str) -> dict[str, Any]:
    """The network on a whole window: what a control step costs when nothing is cached."""
    config = load_preset(preset, options.device)
    policy = LanSARPolicy(config).to(options.device).eval()
    n, rows, size = config.window, options.environments, config.network.clip_dim
    state = torch.randn(rows, n, 15, device=options.device)
    environment_state = torch.randn(rows, n, 24, device=options.device)
    command, static, gripper = (torch.randn(rows, *k, size, device=options.device) for k in ((), (n,), (n,)))
    valid_steps = torch.arange(rows * n, device=options.device)

    def forward() -> None:
        with torch.no_grad():
            inputs = policy.scaler.encode(state, environment_state)
            policy.network(command, *inputs, valid_steps, static, gripper)

    forward()
    times = [timed(options, forward) for _ in tqdm(range(10), desc=name, leave=False)]
    return row(name, policy, None, sum(times) / len(times) / rows, max(times))


def other(options: Options, config: Any, cameras: tuple[str, ...], name: str) -> dict[str, Any]:
    """One of LeRobot's policies at its default settings."""
    sizes = {"static": 200, "gripper": 84}
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (15,))}
    for camera in cameras:
        shape = (3, sizes[camera], sizes[camera])
        features[f"observation.images.{camera}"] = PolicyFeature(FeatureType.VISUAL, shape)
    config.input_features, config.device = features, options.device
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    policy = get_policy_class(config.type)(config).to(options.device).eval()
    chunk = getattr(config, "n_action_steps", None) or config.action_chunk_size
    batch = {k: v for k, v in observation(options.environments, options.device).items() if k in features}
    for _ in range(chunk):  # warm up with one whole chunk
        policy.select_action(dict(batch))
    count = chunk * max(2, -(-16 // chunk))
    times = [
        timed(options, lambda: policy.select_action(dict(batch))) for _ in tqdm(range(count), desc=name, leave=False)
    ]
    seconds = sum(times) / count / options.environments
    return row(f"{name}, {chunk} actions a prediction", policy, None, seconds, max(times))


def peer(options: Options, config: Any, warm_up: int, name: str) -> dict[str, Any]:
    """One of the thesis' peers at its published size."""
    config.device, config.clip = options.device, ClipConfig("lansar-desk", "v1")
    policy = get_policy_class(config.type)(config).to(options.device).eval()
    preprocess, _ = make_pipelines(config, None)
    times = []
    for step in tqdm(range(warm_up + options.steps), desc=name, leave=False):
        batch = preprocess(observation(options.environments, options.device))
        seconds = timed(options, lambda: policy.select_action(batch))  # noqa: B023
        times += [seconds] if step >= warm_up else []
    return row(name, policy, None, sum(times) / len(times) / options.environments, max(times))


def row(
    name: str, policy: torch.nn.Module, preprocessor: float | None, seconds: float, slowest: float
) -> dict[str, Any]:
    """A row of the table; times in seconds."""
    parameters = sum(p.numel() for p in policy.parameters())
    milliseconds = None if preprocessor is None else 1e3 * preprocessor
    return {
        "name": name,
        "parameters": parameters,
        "preprocessor_ms": milliseconds,
        "policy_ms": 1e3 * seconds,
        "slowest_ms": 1e3 * slowest,
    }


@draccus.wrap()
def main(options: Options) -> None:
    """Measures everything and prints a Markdown table."""
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    thesis, recommended = "thesis/baseline", "lansar"
    ten = replace(options, environments=10)
    rows = [
        lansar(options, thesis, 32, "LanSAR thesis size, steps kept (window_slide=32)"),
        lansar(options, thesis, 1, "LanSAR thesis size, window decoded at every step (window_slide=1)"),
        whole_window(options, thesis, "LanSAR thesis size, nothing kept"),
        lansar(ten, thesis, 32, "LanSAR thesis size, steps kept, ten environments at once"),
        lansar(options, recommended, 8, "LanSAR recommended, steps kept"),
        lansar(ten, recommended, 8, "LanSAR recommended, steps kept, ten environments at once"),
        lansar(options, recommended, 1, "LanSAR recommended, window decoded at every step"),
        peer(options, MCILConfig(), 1, "MCIL"),
        peer(options, HULCConfig(), 1, "HULC"),
        peer(options, GR1Config(), 10, "GR-1"),
        other(options, ACTConfig(pretrained_backbone_weights=None), ("static", "gripper"), "ACT"),
        other(options, VQBeTConfig(pretrained_backbone_weights=None), ("static",), "VQ-BeT"),
        other(options, DiffusionConfig(pretrained_backbone_weights=None), ("static",), "Diffusion"),
    ]
    print(
        "| policy | parameters | preprocessor (CLIP) | policy, per executed action | slowest step |\n"
        "| --- | ---: | ---: | ---: | ---: |"
    )
    for r in rows:
        clip = "" if r["preprocessor_ms"] is None else f"{r['preprocessor_ms']:.1f} ms"
        times = f"{r['policy_ms']:.2f} ms | {r['slowest_ms']:.1f} ms"
        print(f"| {r['name']} | {r['parameters'] / 1e6:.1f} M | {clip} | {times} |")
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        settings = {k: v for k, v in asdict(options).items() if k != "output"}
        options.output.write_text(json.dumps({"settings": settings, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
