"""How often the demonstrator succeeds: every task in every scene, from seeded random feasible starts.

    python benchmarks/demonstrations.py [--starts=200] [--scenes='[A,B,C,D]'] [--assets=DIR] [--workers=2] \
        [--output=FILE.json]

Prints a Markdown table of success rates (the oracle's verdict) and mean lengths. Results in FILE that come from the
same code and options are kept and not measured again.
"""

import hashlib
import json
import multiprocessing
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

import lerobot_lansar
from lerobot_lansar.calvin import SCENE_NAMES, TASKS
from lerobot_lansar.demos.demonstrator import demonstrate
from lerobot_lansar.desk import Desk, SimulationError

SEED = 1_000_000


@dataclass
class Options:
    """What to measure."""

    # Random starts per task and scene.
    starts: int = 200
    scenes: list[str] = field(default_factory=lambda: list(SCENE_NAMES))
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    workers: int = 2
    output: Path | None = None


def measure(job: tuple[str, str, str | None, int]) -> tuple[str, str, list[int]]:
    """Scene, task, and the length in frames of each demonstration, 0 where it failed."""
    scene, task, assets, starts = job
    lengths = []
    with Desk(scene, assets, cameras=()) as desk:
        for k in range(starts):
            try:
                found = demonstrate(desk, task, np.random.default_rng([SEED, k]))
            except SimulationError:
                found = None
            lengths.append(0 if found is None else len(found))
    return scene, task, lengths


def code_and_options(options: Options) -> str:
    """A hash of the code and the options that decide the results."""
    package = Path(lerobot_lansar.__file__).parent
    digest = hashlib.sha256(f"{options.starts} {options.assets}".encode())
    for file in sorted((*package.glob("desk/*.py"), *package.glob("demos/**/*.py"))):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Measures what FILE does not hold yet and prints the table."""
    options = draccus.parse(Options)
    state = code_and_options(options)
    known: dict[str, list[int]] = {}
    if options.output is not None and options.output.exists():
        stored = json.loads(options.output.read_text())
        known = stored["lengths"] if stored["state"] == state else {}
    jobs = [
        (scene, task, options.assets, options.starts)
        for task in TASKS
        for scene in options.scenes
        if f"{scene} {task}" not in known
    ]
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for scene, task, lengths in tqdm(pool.imap_unordered(measure, jobs), total=len(jobs), unit="task"):
            known[f"{scene} {task}"] = lengths
            if options.output is not None:
                options.output.parent.mkdir(parents=True, exist_ok=True)
                options.output.write_text(json.dumps({"state": state, "lengths": known}))
    print("| task | " + " | ".join(f"{scene} (%)" for scene in options.scenes) + " | mean frames |")
    print("| --- |" + " ---: |" * (len(options.scenes) + 1))
    for task in TASKS:
        rows = [np.array(known[f"{scene} {task}"]) for scene in options.scenes]
        rates = " | ".join(f"{100 * np.mean(row > 0):.1f}" for row in rows)
        every = np.concatenate(rows)
        print(f"| {task} | {rates} | {every[every > 0].mean():.0f} |")
    every = np.concatenate([np.array(known[f"{s} {t}"]) for s in options.scenes for t in TASKS])
    print(f"\n{np.count_nonzero(every)} of {len(every)} succeeded ({100 * np.mean(every > 0):.2f} %)")


if __name__ == "__main__":
    main()
