"""How long LanSAR takes per control step: CLIP and the other preprocessing, and the policy itself.

    python benchmarks/policy_latency.py [--presets='[small,thesis]'] [--batch_sizes='[1,4]'] [--device=cpu]
        [--threads=1] [--steps=20] [--output=FILE.json]

Weights are random, which costs the same as trained ones. Measured with a full history (a window of 64
steps), the slowest case. 30 Hz leaves 33 ms per step and environment.
"""

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import draccus
import torch
import yaml
from tqdm import tqdm

from lerobot_lansar.policy import LanSARConfig, make_lansar_pre_post_processors
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

CONFIGS = Path(__file__).parents[1] / "configs"


@dataclass
class Options:
    """Command-line options."""

    presets: list[str] = field(default_factory=lambda: ["small", "thesis"])  # configs/lansar_<preset>.yaml
    batch_sizes: list[int] = field(default_factory=lambda: [1, 4])
    device: str = "cpu"
    threads: int = 1
    steps: int = 20  # measured control steps, after the history is full
    output: Path | None = None


def load_preset(name: str, device: str) -> LanSARConfig:
    """The policy section of a shipped configuration file, CLIP untrained so that nothing is downloaded."""
    options = yaml.safe_load((CONFIGS / f"lansar_{name}.yaml").read_text())["policy"]
    options.pop("type")
    options["device"] = device
    options["clip"]["pretrained"] = ""
    config = draccus.decode(LanSARConfig, options)
    config.input_features, config.output_features = {}, {}
    return config


def measure(preset: str, batch_size: int, options: Options) -> dict:
    config = load_preset(preset, options.device)
    policy = LanSARPolicy(config).to(options.device).eval()
    preprocess, _ = make_lansar_pre_post_processors(config)
    seconds = {"preprocess": 0.0, "policy": 0.0}

    def synchronized() -> float:
        if options.device.startswith("cuda"):
            torch.cuda.synchronize()
        return time.perf_counter()

    for step in tqdm(range(config.window + options.steps), desc=f"{preset}, batch {batch_size}", leave=False):
        batch = {
            "observation.state": torch.randn(batch_size, 15),
            "observation.environment_state": torch.randn(batch_size, 24),
            "observation.images.static": torch.rand(batch_size, 3, 200, 200),
            "observation.images.gripper": torch.rand(batch_size, 3, 84, 84),
            "task": ["open the drawer"] * batch_size,
        }
        start = synchronized()
        batch = preprocess(batch)
        middle = synchronized()
        policy.select_action(batch)
        end = synchronized()
        if step >= config.window:
            seconds["preprocess"] += middle - start
            seconds["policy"] += end - middle
    milliseconds = {f"{name}_ms": 1000 * value / options.steps for name, value in seconds.items()}
    total = sum(milliseconds.values())
    parameters = sum(p.numel() for p in policy.parameters())
    row = {"preset": preset, "parameters": parameters, "batch": batch_size, **milliseconds}
    return {**row, "total_ms": total, "ms_per_environment": total / batch_size}


@draccus.wrap()
def main(options: Options) -> None:
    torch.set_num_threads(options.threads)
    rows = [measure(preset, size, options) for preset in options.presets for size in options.batch_sizes]
    columns = f"{'preprocess':>11} {'policy':>9} {'total':>9} {'per env':>9}"
    print(f"{'preset':>8} {'parameters':>11} {'batch':>6} {columns}")
    for row in rows:
        print(
            f"{row['preset']:>8} {row['parameters']:>11,} {row['batch']:>6} {row['preprocess_ms']:>8.1f} ms "
            f"{row['policy_ms']:>6.1f} ms {row['total_ms']:>6.1f} ms {row['ms_per_environment']:>6.1f} ms"
        )
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        settings = {k: v for k, v in asdict(options).items() if k != "output"}
        options.output.write_text(json.dumps({"settings": settings, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
