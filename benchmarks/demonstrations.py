"""How often the demonstrator succeeds: every task in every scene, from seeded random feasible starts.

    python benchmarks/demonstrations.py [--starts=200] [--scenes='[A,B,C,D]'] [--assets=DIR] [--workers=2] \
        [--interrupt=true] [--output=FILE.json]
    python benchmarks/demonstrations.py --chains=1000 [--assets=DIR] [--workers=2]

Prints a Markdown table of success rates (the oracle's verdict) and mean lengths. With `--interrupt`, each start is a
takeover in the middle of the task, see `lerobot_lansar/demos/interrupted.py`. Results in FILE that come from the same
code and options are kept and not measured again.

With `--chains`, the demonstrator plays the long-horizon benchmark instead, as a policy does: each command begins in the
step in which the one before was fulfilled. That bounds what can be learned from its demonstrations.
"""

import hashlib
import json
import multiprocessing
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

import lerobot_lansar
from lerobot_lansar.benchmark import load_chains
from lerobot_lansar.calvin import CHAIN_LENGTH, SCENE_NAMES, TASKS
from lerobot_lansar.demos.demonstrator import demonstrate, fulfil
from lerobot_lansar.demos.interrupted import finishes, interrupt
from lerobot_lansar.desk import Desk, SimulationError
from lerobot_lansar.jobs.staging import write_atomically

SEED = 1_000_000


@dataclass
class Options:
    """What to measure."""

    # Random starts per task and scene.
    starts: int = 200
    scenes: list[str] = field(default_factory=lambda: list(SCENE_NAMES))
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # Interrupt the demonstrator, disturb the desk, and count whether another demonstrator finishes.
    interrupt: bool = False
    # The first so many chains of the benchmark instead, on desk D.
    chains: int = 0
    workers: int = 2
    output: Path | None = None


def measure(job: tuple[str, str, str | None, int, bool]) -> tuple[str, str, list[int]]:
    """Scene, task, and each demonstration's length in frames: 0 where it failed, -1 where it had become impossible."""
    scene, task, assets, starts, interrupted = job
    lengths = []
    with Desk(scene, assets, cameras=()) as desk:
        for k in range(starts):
            rng = np.random.default_rng([SEED, k])
            try:
                lengths.append((_finish if interrupted else _demonstrate)(desk, task, rng))
            except SimulationError:
                lengths.append(0)
    return scene, task, lengths


def _demonstrate(desk: Desk, task: str, rng: np.random.Generator) -> int:
    found = demonstrate(desk, task, rng)
    return 0 if found is None else len(found)


def _finish(desk: Desk, task: str, rng: np.random.Generator) -> int:
    takeover = interrupt(desk, task, rng)
    return finishes(desk, task, takeover, rng) if takeover.feasible else -1


def play_chains(job: tuple[range, str | None]) -> list[tuple[str, ...]]:
    """The commands that the demonstrator came to in each chain; one that it did not fulfil is followed by `""`."""
    numbers, assets = job
    played = []
    with Desk("D", assets, cameras=()) as desk:
        for number in numbers:
            chain, rng = load_chains()[number], np.random.default_rng([SEED, number])
            commands: list[str] = []
            before, obs = None, desk.reset(chain.robot_obs, chain.scene_obs)
            for task in chain.tasks:
                commands.append(task)
                try:
                    fulfilled, obs, before = fulfil(desk, obs, task, rng, before=before, variety=0.3)
                except SimulationError:
                    fulfilled = False
                if not fulfilled:
                    commands.append("")
                    break
            played.append(tuple(commands))
    return played


def report_chains(options: Options) -> None:
    """Plays the chains and prints the average length and what failed after what."""
    jobs = [(range(first, min(first + 5, options.chains)), options.assets) for first in range(0, options.chains, 5)]
    played: list[tuple[str, ...]] = []
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for some in tqdm(pool.imap_unordered(play_chains, jobs), total=len(jobs), unit="5 chains"):
            played += some
    lengths = np.array([len(commands) - 2 if commands[-1] == "" else CHAIN_LENGTH for commands in played])
    rates = " | ".join(f"{100 * np.mean(lengths >= n):.1f}" for n in range(1, CHAIN_LENGTH + 1))
    print("| 1 (%) | 2 (%) | 3 (%) | 4 (%) | 5 (%) | average length |\n|" + " ---: |" * (CHAIN_LENGTH + 1))
    print(f"| {rates} | {lengths.mean():.3f} |\n")
    failed = Counter(commands[-3:-1] for commands in played if commands[-1] == "")
    for commands, count in failed.most_common():
        print(f"{count} x {' then '.join(commands)}")


def code_and_options(options: Options) -> str:
    """A hash of the code and the options that decide the results."""
    package = Path(lerobot_lansar.__file__).parent
    digest = hashlib.sha256(f"{options.starts} {options.assets} {options.interrupt}".encode())
    for file in sorted((package / "calvin.py", *package.glob("desk/*.py"), *package.glob("demos/**/*.py"))):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Measures what FILE does not hold yet and prints the table."""
    options = draccus.parse(Options)
    if options.chains:
        if options.output is not None:
            raise SystemExit("--output is for starts; with --chains the results are printed only: leave it out")
        report_chains(options)
        return
    state = code_and_options(options)
    known: dict[str, list[int]] = {}
    if options.output is not None and options.output.exists():
        stored = json.loads(options.output.read_text())
        known = stored["lengths"] if stored["state"] == state else {}
    jobs = [
        (scene, task, options.assets, options.starts, options.interrupt)
        for task in TASKS
        for scene in options.scenes
        if f"{scene} {task}" not in known
    ]
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        for scene, task, lengths in tqdm(pool.imap_unordered(measure, jobs), total=len(jobs), unit="task"):
            known[f"{scene} {task}"] = lengths
            if options.output is not None:
                options.output.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(options.output, json.dumps({"state": state, "lengths": known}))
    print("| task | " + " | ".join(f"{scene} (%)" for scene in options.scenes) + " | mean frames |")
    print("| --- |" + " ---: |" * (len(options.scenes) + 1))
    for task in TASKS:
        rows = [np.array(known[f"{scene} {task}"]) for scene in options.scenes]
        rates = " | ".join(f"{100 * np.mean(row[row >= 0] > 0):.1f}" for row in rows)
        every = np.concatenate(rows)
        print(f"| {task} | {rates} | {every[every > 0].mean():.0f} |")
    every = np.concatenate([np.array(known[f"{s} {t}"]) for s in options.scenes for t in TASKS])
    possible = every[every >= 0]
    print(f"\n{np.count_nonzero(possible)} of {len(possible)} succeeded ({100 * np.mean(possible > 0):.2f} %)")
    if options.interrupt:
        print(f"{len(every) - len(possible)} takeovers left out: the task had become impossible")


if __name__ == "__main__":
    main()
