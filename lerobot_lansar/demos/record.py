"""``lansar-record``: scripted demonstrations on the desk, in CALVIN's own on-disk format."""

import contextlib
import json
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import draccus
import numpy as np
from filelock import FileLock, Timeout

from ..desk import CONTROL_HZ, SCENES, Desk, DeskError, SimulationError
from ..desk.commands import load_commands
from ..executors import SlurmConfig, WorkerDied, check_executor, run_shards
from .calvin_folder import FrameWriter, Unit, group_by_scene, publish_split
from .demonstrator import Demonstration, demonstrate
from .play_data import record_play
from .skills import SKILLS

ATTEMPTS = 20
SPLITS = ("training", "validation")
MODES = ("windows", "play", "chains")
STAGING = ".recording"
SUBMITTED, PUBLISHING = "submitted", "publishing"  # marks in the staging folder
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
            raise DeskError(
                f"--tasks goes with --mode=windows; --mode={self.mode} carries out whatever is feasible"
            )

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
    """Records what ``config`` asks for; an interrupted recording goes on where it stopped.

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
    output, staging = config.output_dir, config.output_dir / STAGING
    _check_target(output)
    output.mkdir(parents=True, exist_ok=True)
    with _locked(output):
        _check_target(output)  # another process may have finished meanwhile
        _claim(staging, config)
        if config.executor == "slurm":
            (staging / SUBMITTED).touch()
        total = sum(config.counts())
        try:
            done = run_shards(
                (record_shard, (config,)),
                -(-total // config.shard_size()),
                (publish, (config, kinds.pop())),
                executor=config.executor,
                workers=config.workers,
                slurm=config.slurm,
                logging_dir=output / SLURM_LOGS if config.executor == "slurm" else staging / "jobs",
                progress=lambda: len(list(staging.glob("[0-9]*.json"))),
                total=total,
                unit="episode" if config.mode == "windows" else "session",
            )
        except BaseException:
            (staging / SUBMITTED).unlink(missing_ok=True)  # nothing is on its way
            raise
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
    staging = output / STAGING
    found = [split for split in SPLITS if (output / split).exists()]
    if len(found) == len(SPLITS):
        shutil.rmtree(staging, ignore_errors=True)  # a run may have ended while it tidied up
    if found and not (staging / PUBLISHING).exists():
        raise DeskError(
            f"{output} already holds a recording ({', '.join(found)}); give another --output_dir or delete it first"
        )
    if (staging / SUBMITTED).exists():
        raise DeskError(
            f"Slurm jobs for {output} were submitted already; wait for them, or cancel them and delete "
            f"{staging / SUBMITTED} to submit what is missing"
        )


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
    output, staging = config.output_dir, config.output_dir / STAGING
    details = {**config.request(), "assets_used": kind, "control_hz": CONTROL_HZ}
    benchmark = {
        task: listed[0] for task, listed in load_commands(config.validation_annotations, "validation").items()
    }
    training, validation = config.counts()
    units = [Unit.load(_note(config, index)) for index in range(training + validation)]
    (staging / PUBLISHING).touch()
    frame = 0
    parts = range(training), range(training, training + validation)
    for number, (split, indices) in enumerate(zip(SPLITS, parts, strict=True)):
        commands = load_commands(_annotations(config, split), split)
        rows = [
            (staging / f"{index:06d}", units[index], _say(commands, units[index], [config.seed, number, k]))
            for k, index in enumerate(indices)
        ]
        shutil.rmtree(output / split, ignore_errors=True)  # of a try that ended between the two
        frame = publish_split(output / split, rows, frame, details, benchmark)
    shutil.rmtree(staging)
    print(summary(config, units))


def _say(commands: dict[str, list[str]], unit: Unit, seed: list[int]) -> list[str]:
    """A random sentence for each of a unit's windows; ``seed`` says which unit of which split."""
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


@contextlib.contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Keeps a second process out of ``output``; the lock ends with its process, however it ends."""
    file = output / ".recording.lock"
    try:
        with FileLock(file, timeout=0):
            yield
            file.unlink(missing_ok=True)
    except Timeout:
        raise DeskError(f"another process is recording into {output}") from None


def _look(config: RecordConfig, scene: str) -> str:
    """The kind of assets; fails early when scene, assets or cameras are not to be had."""
    with Desk(scene, config.assets, config.cameras, config.renderer) as desk:
        return desk.assets


def _claim(staging: Path, config: RecordConfig) -> None:
    """Makes the staging folder ours, or goes on with one that was begun with the same options."""
    staging.mkdir(exist_ok=True)
    file = staging / "request.json"
    request = json.loads(json.dumps(config.request()))
    if file.exists() and json.loads(file.read_text()) == request:
        for leftover in staging.glob("*.partial"):  # of processes that were killed
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        return
    if file.exists() and any(staging.glob("[0-9]*.json")):
        raise DeskError(
            f"{staging} holds a recording that was begun with other options; delete it, or repeat the options of {file}"
        )
    shutil.rmtree(staging.parent / SLURM_LOGS, ignore_errors=True)  # it remembers shards of another recording
    for leftover in staging.iterdir():  # without its request nothing tells what these units are
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(request, indent=1))
    partial.rename(file)


def main() -> None:
    """Entry point of ``lansar-record``."""
    try:
        record(draccus.parse(RecordConfig))
    except (ValueError, WorkerDied, OSError, draccus.utils.ParsingError) as error:
        print(f"lansar-record: error: {error}", file=sys.stderr)
        sys.exit(2)
    except subprocess.CalledProcessError as error:
        print(
            f"lansar-record: error: {shlex.join(error.cmd)} failed: {error.stderr or error}", file=sys.stderr
        )
        sys.exit(2)
    except KeyboardInterrupt:
        print("lansar-record: interrupted; the same command goes on where it stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    # workers on other machines know these functions by their module's real name
    from lerobot_lansar.demos.record import main as run

    run()
