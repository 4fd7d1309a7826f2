"""Control steps per second of the desk, side by side with the physics floor.

    python benchmarks/desk.py [--steps=300] [--assets=DIR] [--output=FILE.json]

The physics floor is eight bare simulation steps of the same desk: what Bullet itself costs. All cases in one run,
interleaved, medians of three rounds. Run it with nothing else on the machine.
"""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pybullet as p

from lerobot_lansar.desk import Desk


@dataclass
class Options:
    """What to measure."""

    steps: int = 300
    scene: str = "D"
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    output: Path | None = None


def seconds_per_step(step: Callable[[], object], steps: int) -> float:
    """Mean wall time of ``step`` over ``steps`` calls."""
    started = time.perf_counter()
    for _ in range(steps):
        step()
    return (time.perf_counter() - started) / steps


def main() -> None:
    """Measures, prints the table, writes the figures."""
    options = draccus.parse(Options)
    rng = np.random.default_rng(0)
    desks = {
        "both cameras": Desk(options.scene, options.assets),
        "static camera": Desk(options.scene, options.assets, ("static",)),
        "no cameras": Desk(options.scene, options.assets, ()),
    }
    bare = Desk(options.scene, options.assets, ())

    def floor() -> None:
        for _ in range(8):
            p.stepSimulation(physicsClientId=bare._client)

    def stepping(desk: Desk) -> Callable[[], object]:
        return lambda: desk.step([*rng.uniform(-0.3, 0.3, 6), 1])

    def with_oracle() -> None:
        stepping(desks["no cameras"])()
        desks["no cameras"].completed_tasks(start)

    start = desks["no cameras"].snapshot()
    cases = {"physics floor": floor} | {name: stepping(desk) for name, desk in desks.items()}
    cases["no cameras + oracle"] = with_oracle
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(3):
        for name, step in cases.items():
            drawn = "camera" in name and not name.startswith("no")
            times[name].append(seconds_per_step(step, max(10, options.steps // (10 if drawn else 1))))
    medians = {name: statistics.median(values) for name, values in times.items()}
    assets = desks["no cameras"].assets
    print(f"scene {options.scene}, {assets} assets, TinyRenderer, one process, {os.cpu_count()} cores")
    print(f"{'':22s} steps/s   ms/step   times the floor")
    for name, seconds in medians.items():
        print(
            f"{name:22s} {1 / seconds:7.1f} {1e3 * seconds:9.3f} {seconds / medians['physics floor']:12.2f}"
        )
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        figures = {
            "scene": options.scene,
            "assets": assets,
            "machine": platform.platform(),
            "cores": os.cpu_count(),
            "seconds_per_step": medians,
        }
        options.output.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
