"""How fast demonstrations are recorded, what the time is spent on, and how much a second worker adds.

    python benchmarks/recording.py [--assets=DIR] [--episodes=68] [--output=FILE.json]

Shares of the time come from timers around the desk's physics, pictures and oracle, the sampling of start states and the
writing of files, in one process; the remaining time counts as planning. Rates of one and two workers are those of whole
`lansar-record` commands, including their start-up.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
from tqdm import tqdm

from lerobot_lansar.demos import demonstrator, record
from lerobot_lansar.demos.calvin_folder import FrameWriter, Unit
from lerobot_lansar.demos.record_config import RecordConfig
from lerobot_lansar.desk import Desk


@dataclass
class Options:
    """What to measure."""

    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # Episodes recorded with timers, two of each task by default; whole commands record six times as many.
    episodes: int = 68
    output: Path | None = None


def shares(options: Options, cameras: list[str]) -> dict[str, float]:
    """Frames per second of one process, and the share of each part in the time."""
    spent: dict[str, float] = {}
    inside: list[str] = []

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            if inside:  # called by another part, which counts the time
                return function(*arguments, **keywords)
            inside.append(name)
            started = time.perf_counter()
            try:
                return function(*arguments, **keywords)
            finally:
                spent[name] = spent.get(name, 0.0) + time.perf_counter() - started
                inside.pop()

        return call

    parts = (
        ("start states", demonstrator, "sample_start"),
        ("physics", Desk, "_advance"),
        ("pictures", Desk, "_draw"),
        ("oracle", Desk, "snapshot"),
        ("writing", FrameWriter, "add"),
    )
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        for name, owner, attribute in parts:
            stack.enter_context(patch.object(owner, attribute, timed(name, getattr(owner, attribute))))
        config = RecordConfig(Path(folder) / "desk", episodes=options.episodes, cameras=cameras, assets=options.assets)
        (config.output_dir / record.STAGING).mkdir(parents=True)
        record.record_unit(config, 0)  # loads the desk
        spent.clear()
        started = time.perf_counter()
        for index in tqdm(range(options.episodes), desc=f"cameras {cameras}", unit="episode", leave=False):
            record.record_unit(config, index)
        whole = time.perf_counter() - started
        notes = (config.output_dir / record.STAGING).glob(record.NOTES)
        frames = sum(Unit.load(note).frames for note in notes)
    result = {"frames_per_second": frames / whole, "milliseconds_per_frame": 1e3 * whole / frames}
    result |= {f"share_{name.replace(' ', '_')}": spent.get(name, 0.0) / whole for name, *_ in parts}
    return result | {"share_planning": 1 - sum(spent.values()) / whole}


def command(options: Options, cameras: list[str], workers: int) -> float:
    """Frames per second of a whole `lansar-record` command."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "desk"
        words = [
            sys.executable,
            "-m",
            "lerobot_lansar.demos.record",
            f"--output_dir={target}",
            f"--workers={workers}",
            f"--episodes={6 * options.episodes}",
            "--validation_episodes=2",
            f"--cameras=[{','.join(cameras)}]",
        ]
        if options.assets is not None:
            words.append(f"--assets={options.assets}")
        started = time.perf_counter()
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        whole = time.perf_counter() - started
        return len(list(target.glob("*/episode_*.npz"))) / whole


def main() -> None:
    """Measures and prints a table."""
    options = draccus.parse(Options)
    result: dict[str, dict[str, float]] = {}
    for name, cameras in (("no cameras", []), ("both cameras", ["static", "gripper"])):
        measured = shares(options, cameras)
        for workers in tqdm((1, 2), desc=f"commands, {name}", leave=False):
            measured[f"command_{workers}_workers_frames_per_second"] = command(options, cameras, workers)
        one, two = (measured[f"command_{n}_workers_frames_per_second"] for n in (1, 2))
        measured["two_workers_times_one"] = two / one
        result[name] = measured
        print(f"\n{name}")
        for key, value in measured.items():
            print(f"  {key.replace('_', ' '):44s} {value:8.3f}")
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
