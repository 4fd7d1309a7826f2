"""`lansar-record`: scripted demonstrations on the desk, in CALVIN's own on-disk format."""

import shutil
import sys
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import draccus
import numpy as np

from ..calvin import CONTROL_HZ
from ..command import run_command
from ..desk import SCENES, Desk, DeskError, SimulationError
from ..desk.sentences import load_commands
from ..jobs.executors import check_executor, run_shards
from ..jobs.staging import staging
from ..jobs.work import SlurmConfig
from .calvin_folder import FrameWriter, Unit, group_by_scene, publish_split
from .demonstrator import Demonstration, demonstrate
from .play import record_play
from .skills import SKILLS

ATTEMPTS = 20
SPLITS = ("training", "validation")
MODES = ("windows", "play", "chains")
STAGING = ".recording"
NOTES = "[0-9]*.json"
"""What the staging folder holds of each finished unit."""
PUBLISHING = "publishing"
"""A mark in the staging folder: splits are being put into their place."""
SLURM_LOGS = ".recording-slurm"
"""Where Slurm's jobs keep their logs; they outlive the staging folder."""


@dataclass
class RecordConfig:
    """Records demonstrations into OUTPUT_DIR/training and OUTPUT_DIR/validation, as CALVIN keeps its own."""

    output_dir: Path
    # One scene, or a list of them that share the recording evenly: --scene='[A,B,C]'.
    scene: list[str] | str = "D"
    # windows: one command from a random start per episode; play: tasks follow each other without a reset, CALVIN's
    # windows of at most 64 frames are cut from it; chains: play whose windows are whole subtasks.
    mode: str = "windows"
    # Tasks to demonstrate, in turn (naming one twice doubles its share); all by default. Windows only.
    tasks: list[str] = field(default_factory=lambda: list(SKILLS))
    # Accepted demonstrations in the training split, and in the validation split (a tenth by default, and at least one
    # of each task in each scene). Windows only.
    episodes: int = 100
    validation_episodes: int | None = None
    # Hours of play or chains in the training split, and in the validation split (a tenth by default).
    hours: float = 1.0
    validation_hours: float | None = None
    # Play and chains are recorded in sessions of so many minutes; sessions are what workers share.
    session_minutes: float = 2.0
    seed: int = 0
    # Pictures to record: static, gripper; '[]' records states only, about twice as fast.
    cameras: list[str] = field(default_factory=lambda: ["static", "gripper"])
    # Disturbance of executed actions, in relative action units (recorded are the intended ones).
    noise: float = 0.2
    # How much speed, approach, contact points and pauses differ between episodes: 0 (not at all) to 1.
    variety: float = 1.0
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # Who draws the pictures: fast, fast_gl (the look of CALVIN's public data), tiny or egl.
    renderer: str = "fast"
    # YAML of sentences by task for each split; our own by default.
    annotations: str | None = None
    validation_annotations: str | None = None
    # Who does the work: local processes, slurm or ray (pip install 'lerobot_policy_lansar[ray]').
    executor: str = "local"
    workers: int = 1
    slurm: SlurmConfig = field(default_factory=SlurmConfig)

    def __post_init__(self) -> None:
        if self.validation_episodes is None:
            least = len(set(self.tasks)) * len(self.scenes)
            self.validation_episodes = max(least, round(self.episodes / 10))
        if self.validation_hours is None:
            self.validation_hours = self.hours / 10

    def check(self) -> None:
        """Raises ValueError for options that cannot be carried out."""
        for task in self.tasks:
            if task not in SKILLS:
                raise DeskError(f"--tasks: there is no task {task!r}; choose among: {', '.join(SKILLS)}")
        if not self.tasks:
            raise DeskError("--tasks must name at least one task")
        for scene in self.scenes:
            if scene not in SCENES:
                raise DeskError(f"--scene: {scene!r} is none of {', '.join(SCENES)}")
        if not self.scenes or len(set(self.scenes)) != len(self.scenes):
            raise DeskError(f"--scene must name one scene, or different ones as '[A,B]', got {self.scene}")
        if self.mode not in MODES:
            raise DeskError(f"--mode is one of {', '.join(MODES)}, got {self.mode!r}")
        check_executor(self.executor, self.slurm)
        if not 0 <= self.variety <= 1:
            raise DeskError(f"--variety lies between 0 and 1, got {self.variety}")
        if not 0 <= self.noise <= 0.5:
            raise DeskError(f"--noise lies between 0 and 0.5, got {self.noise}")
        if self.seed < 0:
            raise DeskError(f"--seed must be 0 or more, got {self.seed}")
        for name in ("episodes", "validation_episodes", "workers"):
            if getattr(self, name) < 1:
                raise DeskError(f"--{name} must be at least 1, got {getattr(self, name)}")
        for name, minutes in (("hours", 60), ("validation_hours", 60), ("session_minutes", 1)):
            if not 0.1 <= getattr(self, name) * minutes <= 1e6:
                raise DeskError(f"--{name} must be at least 6 seconds, got {getattr(self, name)}")
        if self.mode != "windows" and self.tasks != list(SKILLS):
            raise DeskError(f"--tasks goes with --mode=windows; --mode={self.mode} carries out whatever is feasible")

    @property
    def scenes(self) -> list[str]:
        """The scenes by letter."""
        return [self.scene] if isinstance(self.scene, str) else self.scene

    def request(self) -> dict[str, object]:
        """What decides the recorded data: everything but where it goes and who makes it."""
        without = {"output_dir", "workers", "executor", "slurm"}
        without |= (
            {"hours", "validation_hours", "session_minutes"}
            if self.mode == "windows"
            else {"tasks", "episodes", "validation_episodes"}
        )
        return {k: v for k, v in asdict(self).items() if k not in without}

    def counts(self) -> tuple[int, int]:
        """How many units the training and the validation split have: episodes, or sessions of play."""
        if self.mode == "windows":
            assert self.validation_episodes is not None
            return self.episodes, self.validation_episodes
        training, validation = (len(self.session_frames(split)) for split in SPLITS)
        return training, validation

    def session_frames(self, split: str) -> list[int]:
        """The length of each session of play: the last one is what remains."""
        hours = self.hours if split == "training" else self.validation_hours
        assert hours is not None
        left, each = (round(minutes * 60 * CONTROL_HZ) for minutes in (hours * 60, self.session_minutes))
        return [min(each, left - start) for start in range(0, left, each)]

    def shard_size(self) -> int:
        """Units that one shard of work records; it depends on the request alone."""
        return max(4, sum(self.counts()) // 500) if self.mode == "windows" else 1


def record(config: RecordConfig) -> Path:
    """Records what `config` asks for; an interrupted recording goes on where it stopped.

    Unit k of a split (an episode, or a session of play) depends on the request, split and k alone, so the data are the
    same for any number of workers. Finished units wait in OUTPUT_DIR/.recording; the splits appear at the end, each in
    one rename.

    Raises:
        ValueError: An option is wrong; the folder holds a finished recording, or one that was begun with other options
            or is being made.
        WorkerDied: A worker was killed.
    """
    config.check()
    config = _with_absolute_paths(config)
    kinds = {_look(config, scene) for scene in config.scenes}
    for split, option in zip(SPLITS, ("annotations", "validation_annotations"), strict=True):
        try:
            load_commands(_annotations(config, split), split)
        except DeskError as error:
            raise DeskError(f"--{option}: {error}") from error
    output, folder = config.output_dir, config.output_dir / STAGING
    _check_target(output)
    slurm = config.executor == "slurm"
    with staging(folder, output, config.request(), _has_units, submitting=slurm):
        _check_target(output)  # another process may have finished meanwhile
        total = sum(config.counts())
        done = run_shards(
            (record_shard, (config,)),
            -(-total // config.shard_size()),
            (publish, (config, kinds.pop())),
            executor=config.executor,
            workers=config.workers,
            slurm=config.slurm,
            logging_dir=output / SLURM_LOGS if slurm else folder / "jobs",
            progress=lambda: len(list(folder.glob(NOTES))),
            total=total,
            unit="episode" if config.mode == "windows" else "session",
        )
    if not done:
        print(f"submitted; {output / SPLITS[0]} and {output / SPLITS[1]} appear when the jobs are done")
    return output


def _with_absolute_paths(config: RecordConfig) -> RecordConfig:
    """Jobs may run in another working directory."""
    paths = {
        name: str(Path(value).resolve())
        for name in ("assets", "annotations", "validation_annotations")
        if (value := getattr(config, name)) is not None
    }
    return replace(config, output_dir=config.output_dir.resolve(), **paths)  # type: ignore[arg-type]


def _check_target(output: Path) -> None:
    """Raises DeskError when there is something that must not be replaced, or jobs are still on their way."""
    folder = output / STAGING
    found = [split for split in SPLITS if (output / split).exists()]
    if len(found) == len(SPLITS):
        shutil.rmtree(folder, ignore_errors=True)  # a run may have ended while it tidied up
    if found and not (folder / PUBLISHING).exists():
        raise DeskError(
            f"{output} already holds a recording ({', '.join(found)}); give another --output_dir or delete it first"
        )


def _has_units(folder: Path) -> bool:
    """Whether a staging folder holds units of an interrupted recording."""
    return any(folder.glob(NOTES))


def record_shard(config: RecordConfig, shard: int) -> None:
    """Records those units of one shard that are not there yet."""
    size, total = config.shard_size(), sum(config.counts())
    for index in range(shard * size, min((shard + 1) * size, total)):
        if not _note(config, index).exists():
            record_unit(config, index)


def record_unit(config: RecordConfig, index: int) -> None:
    """Records one episode (the first accepted one of its attempts) or one session of play."""
    place = place_of_unit(config, index)
    seed = [config.seed, SPLITS.index(place.split), place.number]
    desk = _desk(place.scene, config.assets, tuple(config.cameras), config.renderer)
    with FrameWriter(config.output_dir / STAGING / f"{index:06d}", desk.scene) as writer:
        if config.mode != "windows":
            frames = config.session_frames(place.split)[place.number]
            rng, whole = np.random.default_rng(seed), config.mode == "chains"
            unit = record_play(desk, frames, rng, writer, config.noise, config.variety, whole)
        else:
            task = config.tasks[place.in_scene % len(config.tasks)]
            demonstration, tried = _attempt(config, desk, task, seed)
            n = len(demonstration)
            for t in range(n):
                writer.add({key: values[t] for key, values in demonstration.frames.items()})
            unit = Unit(place.scene, n, [(0, n)], [(0, n, task)], {task: tried}, {task: 1}, writer.sums())
    unit.save(_note(config, index))


class Place(NamedTuple):
    """Where a unit belongs: its number within the split, and within the units of its scene there."""

    split: str
    number: int
    scene: str
    in_scene: int


def place_of_unit(config: RecordConfig, index: int) -> Place:
    """Of any unit of both splits; in each split the units of a scene follow each other, and so do the tasks in each
    scene, so that every scene gets every task."""
    training, validation = config.counts()
    split, count = ("training", training) if index < training else ("validation", validation)
    number = index if index < training else index - training
    scenes = group_by_scene(config.scenes, count)
    return Place(split, number, scenes[number], number - scenes.index(scenes[number]))


def _attempt(config: RecordConfig, desk: Desk, task: str, seed: list[int]) -> tuple[Demonstration, int]:
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*seed, attempt])
        try:
            demonstration = demonstrate(desk, task, rng, config.noise, config.variety)
        except SimulationError:
            continue
        if demonstration is not None:
            return demonstration, attempt + 1
    raise DeskError(
        f"{task} failed {ATTEMPTS} times in a row in scene {desk.scene.name} (seed {seed}); try less "
        "--noise or another --seed"
    )


@cache
def _desk(scene: str, assets: str | None, cameras: tuple[str, ...], renderer: str) -> Desk:
    """This process's desks: loading one takes as long as some episodes."""
    return Desk(scene, assets, cameras, renderer)


def _note(config: RecordConfig, index: int) -> Path:
    return config.output_dir / STAGING / f"{index:06d}.json"


def publish(config: RecordConfig, kind: str, _: int) -> None:
    """Builds both splits from the recorded units, prints the summary and removes the staging folder."""
    output, folder = config.output_dir, config.output_dir / STAGING
    details = {**config.request(), "assets_used": kind, "control_hz": CONTROL_HZ}
    benchmark = {task: listed[0] for task, listed in load_commands(config.validation_annotations, "validation").items()}
    training, validation = config.counts()
    units = [Unit.load(_note(config, index)) for index in range(training + validation)]
    (folder / PUBLISHING).touch()
    frame = 0
    parts = range(training), range(training, training + validation)
    for number, (split, indices) in enumerate(zip(SPLITS, parts, strict=True)):
        commands = load_commands(_annotations(config, split), split)
        rows = [
            (folder / f"{index:06d}", units[index], _say(commands, units[index], [config.seed, number, k]))
            for k, index in enumerate(indices)
        ]
        shutil.rmtree(output / split, ignore_errors=True)  # of a try that ended between the two
        frame = publish_split(output / split, rows, frame, details, benchmark)
    shutil.rmtree(folder)
    print(summary(config, units))


def _say(commands: dict[str, list[str]], unit: Unit, seed: list[int]) -> list[str]:
    """A random sentence for each of a unit's windows; `seed` says which unit of which split."""
    rng = np.random.default_rng([*seed, ATTEMPTS])
    return [commands[task][int(rng.integers(len(commands[task])))] for *_, task in unit.windows]


def _annotations(config: RecordConfig, split: str) -> str | None:
    return config.annotations if split == "training" else config.validation_annotations


def summary(config: RecordConfig, units: list[Unit]) -> str:
    """Per task: how often it was tried and accepted, its windows and their mean length in frames."""
    tried, accepted = Counter[str](), Counter[str]()
    lengths: dict[str, list[int]] = {}
    for unit in units:
        tried.update(unit.tried)
        accepted.update(unit.accepted)
        for first, end, task in unit.windows:
            lengths.setdefault(task, []).append(end - first)
    lines = [f"{'task':28s}   tried  accepted  windows  mean length"]
    for task in (task for task in SKILLS if tried[task]):
        windows = lengths.get(task, [])
        mean = f"{np.mean(windows):11.1f}" if windows else "          -"
        lines.append(f"{task:28s} {tried[task]:7d}  {accepted[task]:8d}  {len(windows):7d}  {mean}")
    frames = sum(unit.frames for unit in units)
    lines.append(
        f"{frames} frames ({frames / CONTROL_HZ / 3600:.2f} hours), {sum(map(len, lengths.values()))} windows in "
        f"{config.output_dir}"
    )
    return "\n".join(lines)


def _look(config: RecordConfig, scene: str) -> str:
    """The kind of assets; fails early when scene, assets or cameras are not to be had."""
    with Desk(scene, config.assets, config.cameras, config.renderer) as desk:
        return desk.assets


@draccus.wrap()
def run(config: RecordConfig) -> None:
    """Records."""
    record(config)


def main() -> int:
    """Entry point of `lansar-record`."""
    return run_command("lansar-record", run, resumable=True)


if __name__ == "__main__":
    # workers on other machines know these functions by their module's real name
    from lerobot_lansar.demos.record import main as run_main

    sys.exit(run_main())
