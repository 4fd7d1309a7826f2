"""`lansar-replay`: a recorded demonstration on the desk again, beside what was recorded.

    lansar-replay --repo_id=you/desk_D --episode=3
    lansar-replay --root=task_D_D --split=training --window=12
    lansar-replay --repo_id=you/desk_D --episodes=100

Once the recorded states are set one after the other, once the recorded actions are carried out from the first state.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

from ..calvin import CAMERAS, CONTROL_MODES, TASKS
from ..command import CommandError, run_command
from ..demos.video import Video
from ..desk import Desk
from . import film
from .outcome import MEASURES, Outcome, carry_out_actions, set_states
from .recordings import DatasetSource, FolderSource, Recording, Source


@dataclass
class ReplayConfig:
    """Replays recorded demonstrations on the desk: sets their states, and carries out their actions."""

    # Name of a LeRobotDataset made by lansar-convert, you/name.
    repo_id: str | None = None
    # The dataset's folder; by default where LeRobot looks for a dataset of that name, or its download from the hub.
    dataset_dir: Path | None = None
    # Episode of the dataset to replay, counted from 0.
    episode: int | None = None
    # Instead of a dataset: folder of a CALVIN dataset, the one that holds training/ and validation/.
    root: Path | None = None
    # Split of the CALVIN dataset.
    split: str = "training"
    # Annotated window of the split to replay, counted from 0; the dataset's calvin.window.
    window: int | None = None
    # Instead of one: how many episodes or windows to draw at random and replay; prints a table.
    episodes: int | None = None
    # Decides which ones are drawn.
    seed: int = 0
    # Which form of the actions to carry out, rel or abs; by default that of the dataset's `action`, and abs for a
    # CALVIN folder.
    control_mode: str | None = None
    # The scene; by default the one that the data name.
    scene: str | None = None
    # The `data` folder of a calvin_env checkout; the built-in desk by default. Data replay exactly on the assets that
    # they were recorded with.
    assets: str | None = None
    # What draws the pictures: gl, tiny, pybullet_gl or pybullet_tiny.
    renderer: str = "gl"
    # Write a video of each replay; by default with --episode and --window only.
    video: bool | None = None
    # Where videos go.
    output_dir: Path = Path("outputs/replay")

    def check(self) -> None:
        """Raises CommandError for options that cannot be carried out."""
        if (self.repo_id is None) == (self.root is None):
            raise CommandError(
                "give either --repo_id=… (a dataset made by lansar-convert) or --root=… (a CALVIN folder)"
            )
        source, one, other = ("repo_id", "episode", "window") if self.root is None else ("root", "window", "episode")
        if getattr(self, other) is not None:
            raise CommandError(f"--{other} does not go with --{source}; give --{one}=…")
        if (getattr(self, one) is None) == (self.episodes is None):
            raise CommandError(f"give either --{one}=… (which one to replay) or --episodes=… (how many to draw)")
        if self.episodes is not None and self.episodes < 1:
            raise CommandError(f"--episodes={self.episodes}: expected 1 or more")
        if self.control_mode not in (None, *CONTROL_MODES):
            raise CommandError(f"--control_mode={self.control_mode}: expected {' or '.join(CONTROL_MODES)}")
        if self.seed < 0:
            raise CommandError(f"--seed={self.seed}: expected 0 or more")

    def source(self) -> Source:
        """The recordings to choose from."""
        if self.root is not None:
            return FolderSource(self.root, self.split, self.scene or "")
        assert self.repo_id is not None
        return DatasetSource(self.repo_id, self.dataset_dir)

    def numbers(self, source: Source) -> list[int]:
        """Which of the source's recordings to replay."""
        if not source.whole():
            raise CommandError(
                f"there are no {source.unit}s to replay in {self.dataset_dir or self.root or self.repo_id}"
            )
        if self.episodes is not None:
            whole = source.whole()
            count = min(self.episodes, len(whole))
            return sorted(np.random.default_rng(self.seed).choice(whole, count, replace=False).tolist())
        number = getattr(self, source.unit)
        if not 0 <= number < len(source):
            raise CommandError(f"--{source.unit}={number}: there are {source.unit}s 0 to {len(source) - 1}")
        return [number]


@dataclass
class Replay:
    """A recording and how its two replays went.

    Attributes:
        recording: Without its pictures.
        outcomes: Kind of replay to its outcome, states first.
    """

    recording: Recording
    outcomes: dict[str, Outcome]


def replay(config: ReplayConfig) -> list[Replay]:
    """Replays what `config` asks for, and writes the videos.

    Raises:
        CommandError: An option or the data cannot be carried out.
        FileNotFoundError: Data or assets are missing.
        ValueError: Data are damaged, or an option of the desk is wrong.
    """
    config.check()
    source = config.source()
    mode = config.control_mode or source.control_mode
    video = config.video if config.video is not None else config.episodes is None
    numbers = config.numbers(source)
    desks: dict[str, Desk] = {}
    replays = []
    try:
        for number in tqdm(numbers, desc="replaying", unit=source.unit, disable=len(numbers) == 1):
            recording = source.read(number, pictures=video)
            recording.scene = config.scene or recording.scene
            if not recording.scene:
                raise CommandError(f"{recording.name} does not say its scene: give --scene")
            if recording.scene not in desks:
                cameras = tuple(CAMERAS) if video else ()
                desks[recording.scene] = Desk(recording.scene, config.assets, cameras, config.renderer)
            desk = desks[recording.scene]
            outcomes = {
                "states set": set_states(desk, recording),
                f"actions carried out ({mode})": carry_out_actions(desk, recording, mode),
            }
            if video:
                _write_video(config.output_dir / f"{source.unit}_{number:06d}.mp4", recording, outcomes)
            recording.pictures = {}  # of many recordings they fill the memory
            for outcome in outcomes.values():
                outcome.observations = []
            replays.append(Replay(recording, outcomes))
    finally:
        for desk in desks.values():
            desk.close()
    return replays


def _write_video(path: Path, recording: Recording, outcomes: dict[str, Outcome]) -> None:
    with Video(path) as video:
        total = film.length(recording, outcomes)
        for picture in tqdm(film.pictures(recording, outcomes), total=total, desc=path.name, leave=False):
            video.add(picture)


# ---- what is printed


def describe(one: Replay) -> str:
    """A few lines: the verdict of each kind of replay, and its largest deviations."""
    recording = one.recording
    task = recording.task or "no task"
    heading = f"{recording.name}: {task}, “{recording.sentence}”, scene {recording.scene}, {len(recording)} frames"
    lines = [heading, f"{'largest deviation':26s}" + "".join(f"{name:>15s}" for name in MEASURES) + f"   {task}"]
    for kind, outcome in one.outcomes.items():
        numbers = "".join(f"{value:15.2f}" for value in outcome.largest)
        lines.append(f"{kind:26s}{numbers}   {_verdict(recording, outcome)}")
    return "\n".join(lines)


def _verdict(recording: Recording, outcome: Outcome) -> str:
    """Whether the recording's task was fulfilled, and what was fulfilled instead."""
    if recording.task in outcome.fulfilled:
        return f"fulfilled at frame {outcome.fulfilled[recording.task]}"
    others = f" (instead: {', '.join(outcome.fulfilled)})" if outcome.fulfilled else ""
    if outcome.diverged:
        return f"the simulation diverged at frame {len(outcome.deviations)}"
    return ("not fulfilled" if recording.task in TASKS else "not judged") + others


def table(replays: list[Replay]) -> str:
    """For each kind of replay a table: a row per task and one for all of them.

    A replay counts with its largest deviations, of which the median and the largest over replays are given.
    """
    lines = []
    for kind in replays[0].outcomes:
        lines.append(f"{kind}; largest deviation of each {replays[0].recording.name.split()[0]}: median, largest")
        columns = "".join(f"{name:>19s}" for name in MEASURES)
        lines.append(f"{'task':26s} replays  fulfilled{columns}")
        tasks = sorted({one.recording.task for one in replays})
        for task in [*tasks, None]:
            rows = [one for one in replays if task in (None, one.recording.task)]
            lines.append(_row(task or "all", kind, rows))
        lines.append("")
    return "\n".join(lines[:-1])


def _row(name: str, kind: str, replays: list[Replay]) -> str:
    judged = [one for one in replays if one.recording.task in TASKS]
    done = sum(one.recording.task in one.outcomes[kind].fulfilled for one in judged)
    share = f"{100 * done / len(judged):.1f} %" if judged else "-"
    largest = np.array([one.outcomes[kind].largest for one in replays])
    numbers = zip(np.median(largest, axis=0), largest.max(axis=0), strict=True)
    columns = "".join(f"{f'{middle:.2f}, {worst:.2f}':>19s}" for middle, worst in numbers)
    return f"{name:26s} {len(replays):7d}  {share:>9s}{columns}"


@draccus.wrap()
def run(config: ReplayConfig) -> None:
    """Replays, and prints what came of it."""
    replays = replay(config)
    print(describe(replays[0]) if config.episodes is None else table(replays))


def main() -> int:
    """Entry point of `lansar-replay`."""
    return run_command("lansar-replay", run)


if __name__ == "__main__":
    sys.exit(main())
