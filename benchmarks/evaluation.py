"""How fast a policy is evaluated on the benchmark's chains: whole commands, side by side, and whether they agree.

    python benchmarks/evaluation.py --policy_path=DIR [--chains=100] [--batch_size=20] [--output=FILE.json]

`lerobot-eval` plays the same chains with the same batch size, its environments in processes of their own (its default)
or in one process. Times include each command's start. Nothing is drawn but LeRobot's ten videos, a picture a second.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus

from lerobot_lansar.benchmark import EPISODES_FILE

LANSAR = "lansar-eval"


@dataclass
class Options:
    """What to measure."""

    # The policy, --policy.path.
    policy_path: str
    # Chains to play, the first ones.
    chains: int = 100
    # --eval.batch_size of all commands.
    batch_size: int = 20
    control_mode: str = "abs"
    # Sentences of the tasks.
    annotations: str | None = None
    # Further options of all commands.
    more: list[str] | None = None
    output: Path | None = None


def commands(options: Options) -> dict[str, list[str]]:
    """Name to program and options."""
    common = [
        f"--policy.path={options.policy_path}",
        "--env.type=calvin",
        f"--env.control_mode={options.control_mode}",
        "--env.cameras=[]",
        "--env.render_fps=1",
        f"--eval.n_episodes={options.chains}",
        f"--eval.batch_size={options.batch_size}",
        "--seed=0",
        *([f"--env.annotations={options.annotations}"] if options.annotations else []),
        *(options.more or []),
    ]
    cores = len(os.sched_getaffinity(0))
    return {
        "lerobot-eval": ["lerobot-eval", *common],
        "lerobot-eval, one process": ["lerobot-eval", *common, "--eval.use_async_envs=false"],
        "lansar-eval, 1 worker": [LANSAR, *common, "--workers=1"],
        f"lansar-eval, {cores} workers": [LANSAR, *common, f"--workers={cores}"],
    }


def measure(words: list[str], chains: int) -> tuple[float, dict[int, Any]]:
    """Seconds of a whole command, and what happened in each chain by its seed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "eval"
        where = [f"--output_dir={folder}", *([] if words[0] == LANSAR else [f"--env.results_dir={folder}"])]
        started = time.perf_counter()
        subprocess.run([str(Path(sys.executable).with_name(words[0])), *words[1:], *where], check=True)
        seconds = time.perf_counter() - started
        lines = [json.loads(line) for line in (folder / EPISODES_FILE).read_text().splitlines()]
    return seconds, {
        line["seed"]: [(c["task"], c["success"], c["steps"]) for c in line["commands"]]
        for line in lines
        if line["seed"] < chains
    }


@draccus.wrap()
def main(options: Options) -> None:
    """Prints the table and writes the output file."""
    rows: dict[str, dict[str, Any]] = {}
    first: dict[int, Any] | None = None
    for name, words in commands(options).items():
        seconds, results = measure(words, options.chains)
        first = results if first is None else first
        rows[name] = {"seconds": seconds, "equal_chains": sum(results[seed] == first[seed] for seed in first)}
    base = next(iter(rows.values()))["seconds"]
    print("| command | seconds | times lerobot-eval | chains that went alike |\n| --- | ---: | ---: | ---: |")
    for name, row in rows.items():
        equal = f"{row['equal_chains']} of {options.chains}"
        print(f"| {name} | {row['seconds']:.0f} | {base / row['seconds']:.2f} | {equal} |")
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"chains": options.chains, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
