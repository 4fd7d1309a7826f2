r"""Which of LanSAR's options help: same demonstrations and updates, several seeds, official chains.

    lansar-record --cameras='[]' --mode=chains --hours=8 --validation_hours=0.25 --variety=0.3 --seed=0 --workers=2 \
        --output_dir=data/chains \
        --weights='{lift_slider: 3, push_into_drawer: 2, stack_block: 2, lift_table: 1.5, place_in_slider: 1.5}'
    lansar-convert --root=data/chains --split=training --repo_id=lansar/chains --images=none --workers=2 \
        --output_dir=data/chains_lerobot
    python benchmarks/ablations.py --root=data/chains_lerobot [--variants='[recommended,euler angles]']
        [--seeds='[0,1,2]'] [--updates=3000] [--chains=100] [--workers=2] [--output_dir=outputs/ablations]

The thesis' rows with pictures (`PICTURES` below) need recordings with cameras, converted with
`--images=none --embed=true --clip.model=lansar-desk --clip.pretrained=v1`.

Every run is `lerobot-train` on --config with one change, then `lansar-eval` on the benchmark's first chains, built-in
desk, with sentences that no demonstration was labelled with. Runs that are in --output_dir already are not repeated.
Prints a Markdown table and writes its numbers to --output_dir/results.json. The difference to the first variant is of
the same seeds on the same chains; its 95 % interval is over the chains of these trainings, so the scatter between
trainings comes on top.
"""

import hashlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import yaml
from filelock import FileLock
from tqdm import tqdm

from lerobot_lansar.clip.store import dataset_fingerprint
from lerobot_lansar.report.episodes import read_lines
from lerobot_lansar.report.figures import bootstrap

RUN = ("steps", "save_freq", "log_freq", "seed")
"""Options whose values in the configuration file change no result: runs set them, or only log with them."""
ACHIEVED = ["--policy.target=achieved"]
THESIS_RULES = [
    "--policy.position_scale_start=3",
    "--policy.position_scale_slope=1",
    "--policy.yaw_scale=1.5",
]
SLIDE = ["--policy.window_slide=1"]
THESIS = [
    *ACHIEVED,
    "--policy.orientation=euler",
    "--policy.egocentric_blocks=false",
    "--policy.command_in_context=false",
    "--policy.mlp_norm=batch",
    "--policy.dropout=0.1",
    "--policy.window=64",
    "--policy.window_start=episode",
    "--batch_size=24",
]
"""The options of configs/thesis/baseline.yaml except sizes and optimizer, with as many steps per update; without
pictures."""
SEEING = ["--policy.use_images=true"]
ALONE = ["--policy.use_spatial_context=false"]
PREPENDED = ["--policy.command_prepended=true"]
PICTURES: dict[str, tuple[list[str], list[str]]] = {
    "pictures and state (Baseline)": (SEEING, []),
    "pictures and state, command prepended (Prepend)": ([*SEEING, *PREPENDED], []),
    "pictures alone (No Space)": ([*SEEING, *ALONE], []),
    "thesis (Baseline) at this size": ([*THESIS, *SEEING], [*THESIS_RULES, *SLIDE]),
    "thesis (Prepend) at this size": ([*THESIS, *SEEING, *PREPENDED], [*THESIS_RULES, *SLIDE]),
    "thesis (No Space) at this size": ([*THESIS, *SEEING, *ALONE], [*THESIS_RULES, *SLIDE]),
}
"""Table 5.3's variants that see, by the recommended and by the thesis' choices; the fourth, No Image, are "recommended"
and "thesis (No Image) at this size"."""
VARIANTS: dict[str, tuple[list[str], list[str]]] = {
    "recommended": ([], []),
    "thesis (No Image) at this size": (THESIS, [*THESIS_RULES, *SLIDE]),
    "thesis (No Image) at this size, Prepend": ([*THESIS, *PREPENDED], [*THESIS_RULES, *SLIDE]),
    "achieved targets, thesis constants": (ACHIEVED, THESIS_RULES),
    "achieved targets, as predicted": (ACHIEVED, []),
    "euler angles": (["--policy.orientation=euler"], []),
    "BatchNorm in the MLPs": (["--policy.mlp_norm=batch"], []),
    "blocks not seen from the hand": (["--policy.egocentric_blocks=false"], []),
    "command not in the context": (["--policy.command_in_context=false"], []),
    "command prepended": (PREPENDED, []),
    "windows from the episode's start": (["--policy.window_start=episode"], []),
    "windows from anywhere": (["--policy.window_start=anywhere"], []),
    "contrastive loss, weight 0.1": (["--policy.contrastive_weight=0.1"], []),
    "noise on the state, 3 mm and 3 mrad": (["--policy.state_noise=0.003"], []),
    "paraphrases": (["--policy.paraphrases=true"], []),
    "window slides by 1": ([], SLIDE),
    "windows of 64 steps, 24 a batch": (["--policy.window=64", "--batch_size=24"], []),
    "windows of 8 steps, 192 a batch": (["--policy.window=8", "--batch_size=192"], []),
    "hidden 128, feedforward 512": (["--policy.hidden=128", "--policy.feedforward=512"], []),
    "AdamW, learning rate 0.0015": (
        ["--policy.optimizer=adamw", "--policy.learning_rate=0.0015", "--policy.weight_decay=0.01"],
        [],
    ),
    "weight decay 0.01": (["--policy.weight_decay=0.01"], []),
    "weight decay 0.3": (["--policy.weight_decay=0.3"], []),
    "dropout 0.1": (["--policy.dropout=0.1"], []),
    "changes since the command": (["--policy.since_command=true"], []),
}
"""Variant to its options of training and of evaluation, which override the configuration file. Variants with the same
training options share a checkpoint."""


@dataclass
class Options:
    """What to run."""

    root: Path
    config: Path = Path("configs/lansar.yaml")
    variants: list[str] = field(default_factory=lambda: list(VARIANTS))
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    updates: int = 3000
    chains: int = 100
    workers: int = 2
    output_dir: Path = Path("outputs/ablations")


def command(name: str, *arguments: str, log: Path) -> float:
    """Runs one of the installed commands on one thread; returns the seconds it took.

    Raises:
        RuntimeError: It failed.
    """
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "WANDB_MODE": "disabled"}
    started = time.time()
    with open(log, "a") as output:
        code = subprocess.call(
            [str(Path(sys.executable).parent / name), *arguments],
            env=environment,
            stdout=output,
            stderr=output,
        )
    if code:
        raise RuntimeError(f"{name} ended with exit code {code}; its output is in {log}")
    return time.time() - started


def key(*parts: Any) -> str:
    """A short name for everything that determines a result."""
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:12]


def train(options: Options, changes: list[str], seed: int) -> tuple[Path, float]:
    """The checkpoint of one training and the minutes that it took; the first caller trains, the others wait."""
    config = {k: v for k, v in yaml.safe_load(options.config.read_text()).items() if k not in RUN}
    frames = dataset_fingerprint(options.root)
    folder = options.output_dir / key(config, frames, options.updates, changes, seed)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, minutes = folder / "train/checkpoints/last/pretrained_model", folder / "minutes.json"
    with FileLock(folder / ".lock"):
        if not minutes.exists():
            shutil.rmtree(folder / "train", ignore_errors=True)
            seconds = command(
                "lerobot-train",
                f"--config_path={options.config}",
                "--dataset.repo_id=lansar/ablations",
                f"--dataset.root={options.root}",
                f"--output_dir={folder / 'train'}",
                f"--seed={seed}",
                f"--steps={options.updates}",
                f"--save_freq={options.updates}",
                *changes,
                log=folder / "train.log",
            )
            minutes.write_text(json.dumps(seconds / 60))
        return checkpoint, json.loads(minutes.read_text())


def measure(options: Options, variant: str, seed: int) -> dict[str, Any]:
    """One training and its evaluation; parts that exist already are not repeated."""
    training, evaluation = (VARIANTS | PICTURES)[variant]
    checkpoint, minutes = train(options, training, seed)
    folder = checkpoint.parents[3] / key(evaluation, options.chains)
    if not (folder / "report.json").exists():
        log = folder.with_suffix(".log")
        command(
            "lansar-eval",
            f"--policy.path={checkpoint}",
            "--env.type=calvin",
            "--env.control_mode=abs",
            *(["--env.cameras=[]"] if variant in VARIANTS else []),
            *evaluation,
            f"--chains={options.chains}",
            "--workers=1",
            "--videos=0",
            "--seed=0",
            f"--output_dir={folder}",
            log=log,
        )
        command("lansar-report", f"--eval_dir={folder}", log=log)
    (report,) = json.loads((folder / "report.json").read_text())["tables"][0]["evaluations"]
    figures = {name: report[name] for name in ("average_length", "in_a_row", "local_success_rate", "tasks")}
    lengths = {episode.chain: episode.successes for episode in read_lines(folder)}
    return {"variant": variant, "seed": seed, "train_minutes": minutes, **figures, "lengths": lengths}


def attempt(options: Options, variant: str, seed: int) -> dict[str, Any] | None:
    """What `measure` returns; None if that failed, which is said and stops no other run."""
    try:
        return measure(options, variant, seed)
    except Exception as error:
        tqdm.write(f"{variant}, seed {seed}: {error}")
        return None


def to_first(runs: list[dict[str, Any]], first: list[dict[str, Any]]) -> str:
    """How much longer the chains of one variant are than those of the first with the same seeds."""
    references = {run["seed"]: run for run in first}
    pairs = [(run, references[run["seed"]]) for run in runs if run["seed"] in references]
    if not pairs:
        return ""
    chains = sorted(set.intersection(*(set(run["lengths"]) for pair in pairs for run in pair)))
    mean = np.mean([[one["lengths"][c] - other["lengths"][c] for c in chains] for one, other in pairs], axis=0)
    (interval,) = bootstrap([mean])
    return f"{mean.mean():+.2f}" + (f" [{interval[0]:+.2f}, {interval[1]:+.2f}]" if interval else "")


def main() -> None:
    """Runs what is missing and prints the table."""
    options = draccus.parse(Options)
    known = VARIANTS | PICTURES
    if unknown := set(options.variants) - known.keys():
        sys.exit(f"--variants: unknown {sorted(unknown)}; choose among {list(known)}")
    runs = [(variant, seed) for seed in options.seeds for variant in options.variants]
    with ThreadPoolExecutor(options.workers) as pool:
        found = list(tqdm(pool.map(lambda run: attempt(options, *run), runs), total=len(runs), unit="run"))
    done = [run for run in found if run is not None]
    settings = {"config": str(options.config), "updates": options.updates, "chains": options.chains}
    (options.output_dir / "results.json").write_text(json.dumps(settings | {"runs": done}, indent=1) + "\n")
    print("| variant | average length | difference to the first | 1 | 2 | 3 | 4 | 5 | per command |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    by_variant = {name: [run for run in done if run["variant"] == name] for name in options.variants}
    for variant, mine in by_variant.items():
        if not mine:
            continue
        lengths = [run["average_length"] for run in mine]
        spread = f" ± {statistics.stdev(lengths):.2f}" if len(lengths) > 1 else ""
        row = [100 * statistics.mean(run["in_a_row"][k] for run in mine) for k in range(5)]
        local = 100 * statistics.mean(run["local_success_rate"] for run in mine)
        shares = " | ".join(f"{share:.0f} %" for share in row)
        first = by_variant[options.variants[0]]
        change = "" if mine is first else to_first(mine, first)
        print(f"| {variant} | {statistics.mean(lengths):.2f}{spread} | {change} | {shares} | {local:.1f} % |")
    if len(done) < len(runs):
        sys.exit(f"{len(runs) - len(done)} of {len(runs)} runs failed; the same command tries them again")


if __name__ == "__main__":
    main()
