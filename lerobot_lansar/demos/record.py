"""`lansar-record`: scripted demonstrations on the desk, in CALVIN's own on-disk format."""

import shutil
import sys
from collections import Counter
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import draccus
import numpy as np

from ..calvin import CONTROL_HZ
from ..command import run_command
from ..desk import Desk, DeskError, SimulationError
from ..desk.sentences import load_commands
from ..jobs.executors import run_shards
from ..jobs.staging import staging
from .calvin_folder import FrameWriter, Unit, publish_split
from .demonstrator import Demonstration, demonstrate
from .play import record_play
from .record_config import SPLITS, RecordConfig, TakeoverPolicy
from .skills import SKILLS

ATTEMPTS = 20
"""How often a demonstration is tried, each time from another start, before the recording fails."""
STAGING = ".recording"
"""The folder in OUTPUT_DIR in which finished units wait."""
NOTES = "[0-9]*.json"
"""What the staging folder holds of each finished unit."""
PUBLISHING = "publishing"
"""A mark in the staging folder: splits are being moved into place."""
SLURM_LOGS = ".recording-slurm"
"""The folder in OUTPUT_DIR for the logs of Slurm's jobs, which outlive the staging folder."""


def record(config: RecordConfig) -> Path:
    """Records what `config` asks for; an interrupted recording goes on where it stopped.

    Unit k of a split (an episode, or a session of play) depends on the request, split and k alone, so the data are the
    same for any number of workers. Finished units wait in OUTPUT_DIR/.recording; the splits appear at the end, each in
    one rename.

    Returns:
        The absolute path of the output folder.

    Raises:
        ValueError: An option is wrong, or the folder holds a finished recording, one that was begun with other options,
            or one that another process is writing.
        WorkerDied: A worker was killed.
    """
    config.check()
    config = _with_absolute_paths(config)
    if config.mode == "takeovers":
        from .takeovers import prepare  # imports LeRobot, which takes seconds

        config = prepare(config)
    kinds = {_kind_of_assets(config, scene) for scene in config.scenes}
    for split, option in zip(SPLITS, ("annotations", "validation_annotations"), strict=True):
        try:
            load_commands(config.annotations_of(split), split)
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
            (publish_splits, (config, kinds.pop())),
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


def _kind_of_assets(config: RecordConfig, scene: str) -> str:
    """`"built-in"` or `"original"`; raises DeskError early if scene, assets or cameras are not available."""
    with Desk(scene, config.assets, config.cameras, config.renderer) as desk:
        return desk.assets


def _with_absolute_paths(config: RecordConfig) -> RecordConfig:
    """The same options for jobs, which may run in another working directory."""
    paths = {
        name: str(Path(value).resolve())
        for name in ("assets", "annotations", "validation_annotations")
        if (value := getattr(config, name)) is not None
    }
    return replace(config, output_dir=config.output_dir.resolve(), **paths)  # type: ignore[arg-type]


def _check_target(output: Path) -> None:
    """Raises DeskError if a finished recording would be replaced."""
    folder = output / STAGING
    found = [split for split in SPLITS if (output / split).exists()]
    if len(found) == len(SPLITS):
        shutil.rmtree(folder, ignore_errors=True)  # left by a run that was killed while cleaning up
    if found and not (folder / PUBLISHING).exists():
        raise DeskError(
            f"{output} already holds a recording ({', '.join(found)}); give another --output_dir or delete it first"
        )


def _has_units(folder: Path) -> bool:
    """Whether a staging folder holds finished units of an interrupted recording."""
    return any(folder.glob(NOTES))


def record_shard(config: RecordConfig, shard: int) -> None:
    """Records the units of one shard that do not exist yet."""
    size, total = config.shard_size(), sum(config.counts())
    units = range(shard * size, min((shard + 1) * size, total))
    missing = [index for index in units if not _note(config, index).exists()]
    if config.mode == "takeovers":
        _record_takeovers(config, missing)
        return
    for index in missing:
        record_unit(config, index)


def _record_takeovers(config: RecordConfig, indices: list[int]) -> None:
    """Records sessions in which a policy acts, all at once."""
    from .takeovers import record_sessions  # imports LeRobot, which takes seconds

    units = []
    for index in indices:
        slot = config.slot(index)
        _, frames = config.sessions(slot.split)[slot.number]
        seed = [config.seed, SPLITS.index(slot.split), slot.number]
        units.append((index, slot.split, slot.scene, frames, seed, config.output_dir / STAGING / f"{index:06d}"))
    sentences = {split: load_commands(config.annotations_of(split), split) for split in SPLITS}
    for index, unit in record_sessions(config, units, sentences) if units else ():
        unit.save(_note(config, index))


def record_unit(config: RecordConfig, index: int) -> None:
    """Records one episode (the first accepted one of its attempts) or one session of play."""
    slot = config.slot(index)
    seed = [config.seed, SPLITS.index(slot.split), slot.number]
    desk = _desk(slot.scene, config.assets, tuple(config.cameras), config.renderer, config.depth)
    with FrameWriter(config.output_dir / STAGING / f"{index:06d}", desk.scene, config.image_size) as writer:
        if config.mode != "windows":
            _, frames = config.sessions(slot.split)[slot.number]
            rng, whole = np.random.default_rng(seed), config.mode == "chains"
            unit = record_play(desk, frames, rng, writer, config.noise, config.variety, whole, config.weights)
        else:
            task = config.tasks[slot.number % len(config.tasks)]
            demonstration, tried = _attempt(config, desk, task, seed)
            n = len(demonstration)
            for t in range(n):
                writer.add({key: values[t] for key, values in demonstration.frames.items()})
            unit = Unit(slot.scene, n, [(0, n)], [(0, n, task)], {task: tried}, {task: 1}, writer.sums())
    unit.save(_note(config, index))


def _attempt(config: RecordConfig, desk: Desk, task: str, seed: list[int]) -> tuple[Demonstration, int]:
    """The first accepted demonstration, and how many attempts it took."""
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
def _desk(scene: str, assets: str | None, cameras: tuple[str, ...], renderer: str, depth: bool) -> Desk:
    """One desk per scene and process: loading it takes as long as several episodes."""
    return Desk(scene, assets, cameras, renderer, depth)


def _note(config: RecordConfig, index: int) -> Path:
    return config.output_dir / STAGING / f"{index:06d}.json"


def publish_splits(config: RecordConfig, kind: str, _: int) -> None:
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
        commands = load_commands(config.annotations_of(split), split)
        rows = [
            (folder / f"{index:06d}", units[index], choose_sentences(commands, units[index], [config.seed, number, k]))
            for k, index in enumerate(indices)
        ]
        shutil.rmtree(output / split, ignore_errors=True)  # of a run that was killed between the two splits
        frame = publish_split(output / split, rows, frame, details, benchmark)
    shutil.rmtree(folder)
    print(summary(config, units))


def choose_sentences(commands: dict[str, list[str]], unit: Unit, seed: list[int]) -> list[str]:
    """A random sentence for each of a unit's windows, unless it has its own; `seed` identifies the unit."""
    if unit.sentences:
        return unit.sentences
    rng = np.random.default_rng([*seed, ATTEMPTS])
    return [commands[task][int(rng.integers(len(commands[task])))] for *_, task in unit.windows]


def summary(config: RecordConfig, units: list[Unit]) -> str:
    """A table: how often each task was tried and accepted, its windows and their mean length in frames."""
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
    if config.mode == "takeovers":
        alone = sum(sum(unit.alone.values()) for unit in units)
        demonstrated = sum(unit.demonstrated for unit in units)
        lines.append(
            f"{config.policy.path} fulfilled {alone} of {sum(tried.values())} commands by itself, the demonstrator "
            f"{sum(accepted.values()) - alone} more; it acted in {demonstrated} frames"
        )
    lines.append(
        f"{frames} frames ({frames / CONTROL_HZ / 3600:.2f} hours), {sum(map(len, lengths.values()))} windows in "
        f"{config.output_dir}"
    )
    return "\n".join(lines)


def run() -> None:
    """Records; what the policy is to be changed in is written as in LeRobot's commands: `--policy.NAME=VALUE`."""
    own, changed = divide_options(sys.argv[1:])
    config = draccus.parse(RecordConfig, args=own)
    config.policy.options += changed
    record(config)


def divide_options(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The command's own options, and those of the policy as name=value.

    >>> divide_options(["--policy.path=a", "--policy.n_action_steps=5"])
    (['--policy.path=a'], ['n_action_steps=5'])
    """
    known = tuple(f"--policy.{entry.name}" for entry in fields(TakeoverPolicy))
    own, changed, arguments = [], [], list(arguments)
    while arguments:
        option = arguments.pop(0)
        if not option.startswith("--policy.") or option.partition("=")[0] in known:
            own.append(option)
        elif "=" in option or not arguments:
            changed.append(option.removeprefix("--policy."))
        else:
            changed.append(f"{option.removeprefix('--policy.')}={arguments.pop(0)}")
    return own, changed


def main() -> int:
    """Entry point of `lansar-record`."""
    return run_command("lansar-record", run, resumable=True)


if __name__ == "__main__":
    # jobs on other machines import these functions by their module's real name, which is not __main__
    from lerobot_lansar.demos.record import main as run_main

    sys.exit(run_main())
