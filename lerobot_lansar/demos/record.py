"""``lansar-record``: scripted demonstrations on the desk, in CALVIN's own on-disk format."""

import fcntl
import json
import multiprocessing
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

from ..desk import CONTROL_HZ, Desk, DeskError, SimulationError
from ..desk.commands import load_commands
from ..desk.scenes import Scene
from .calvin_folder import Recording, publish_split, write_frames
from .demonstrator import demonstrate
from .skills import SKILLS

ATTEMPTS = 20


@dataclass
class RecordConfig:
    """Records demonstrations of one scene into OUTPUT_DIR/training and OUTPUT_DIR/validation."""

    output_dir: Path
    scene: str = "D"
    # Tasks to demonstrate, in turn (naming one twice doubles its share); all that can be demonstrated by default.
    tasks: list[str] = field(default_factory=lambda: list(SKILLS))
    # Accepted demonstrations in the training split, and in the validation split (a tenth by default).
    episodes: int = 100
    validation_episodes: int | None = None
    seed: int = 0
    # Pictures to record: static, gripper; '[]' records states only, many times faster.
    cameras: list[str] = field(default_factory=lambda: ["static", "gripper"])
    # Disturbance of executed actions, in relative action units (recorded are the intended ones).
    noise: float = 0.2
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # Who draws the pictures: fast, fast_gl (the look of CALVIN's public data), tiny or egl.
    renderer: str = "fast"
    # YAML of sentences by task; our own by default.
    annotations: str | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        if self.validation_episodes is None:
            self.validation_episodes = max(1, round(self.episodes / 10))

    def check(self) -> None:
        """Raises DeskError for options that cannot be carried out."""
        for task in self.tasks:
            if task not in SKILLS:
                raise DeskError(
                    f"--tasks: {task!r} cannot be demonstrated; choose among: {', '.join(SKILLS)}"
                )
        if not self.tasks:
            raise DeskError("--tasks must name at least one task")
        for name in ("episodes", "validation_episodes", "workers"):
            if getattr(self, name) < 1:
                raise DeskError(f"--{name} must be at least 1, got {getattr(self, name)}")

    def request(self) -> dict[str, object]:
        """What decides the recorded data: everything but where it goes and how many processes make it."""
        return {k: v for k, v in asdict(self).items() if k not in ("output_dir", "workers")}


def record(config: RecordConfig) -> Path:
    """Records what ``config`` asks for; an interrupted recording goes on where it stopped.

    Episode k depends on (seed, k) alone, so the data are the same for any number of workers. Finished episodes wait
    in OUTPUT_DIR/.recording; the splits appear at the end, each in one rename.

    Raises:
        DeskError: The folder holds a finished recording, or one that was begun with other options.
    """
    config.check()
    scene, kind = _look(config)
    output, staging = config.output_dir, config.output_dir / ".recording"
    commands = load_commands(config.annotations)
    if (output / "training").exists() and (output / "validation").exists():
        shutil.rmtree(staging, ignore_errors=True)  # a run may have ended while it tidied up
        raise DeskError(f"{output} already holds a recording; give another --output_dir or delete it first")
    staging.mkdir(parents=True, exist_ok=True)
    with _locked(staging):
        _claim(staging, config)
        recordings = _record_all(config, commands)
        _publish(config, recordings, scene, kind, commands)
        shutil.rmtree(staging)
    _summarise(config, recordings)
    return output


def _record_all(config: RecordConfig, commands: dict[str, list[str]]) -> list[Recording]:
    """Records the episodes that are not there yet; returns all of them in order."""
    staging = config.output_dir / ".recording"
    assert config.validation_episodes is not None
    total = config.episodes + config.validation_episodes
    missing = [k for k in range(total) if not (staging / f"{k:06d}.json").exists()]
    _run(config, missing, total)
    return [_recording(staging, k, commands, config) for k in range(total)]


def _publish(
    config: RecordConfig, recordings: list[Recording], scene: Scene, kind: str, commands: dict[str, list[str]]
) -> None:
    details = {**config.request(), "assets_used": kind, "control_hz": CONTROL_HZ}
    frame = 0
    for split, part in (
        ("training", recordings[: config.episodes]),
        ("validation", recordings[config.episodes :]),
    ):
        shutil.rmtree(config.output_dir / split, ignore_errors=True)  # of a try that ended between the two
        frame = publish_split(config.output_dir / split, part, scene, frame, details, commands)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps a second process out of ``folder``; the lock ends with its process, however it ends."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise DeskError(f"another process is recording into {folder.parent}") from None
    finally:
        os.close(lock)


def _look(config: RecordConfig) -> tuple[Scene, str]:
    """The scene and the kind of assets; fails early when scene, assets or cameras are not to be had."""
    with Desk(config.scene, config.assets, config.cameras, config.renderer) as desk:
        return desk.scene, desk.assets


def _claim(staging: Path, config: RecordConfig) -> None:
    """Makes the staging folder ours, or goes on with one that was begun with the same options."""
    file = staging / "request.json"
    request = json.loads(json.dumps(config.request()))
    if file.exists():
        if json.loads(file.read_text()) != request:
            raise DeskError(
                f"{staging} holds a recording that was begun with other options; delete it, or repeat the options of "
                f"{file}"
            )
        return
    for leftover in staging.iterdir():  # without its request nothing tells what these episodes are
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(request, indent=1))
    partial.rename(file)


def _run(config: RecordConfig, missing: list[int], total: int) -> None:
    progress = {"total": total, "initial": total - len(missing), "desc": "recording", "unit": "episode"}
    with tqdm(**progress) as bar:  # type: ignore[call-overload]
        for _ in _done(config, missing):
            bar.update()


def _done(config: RecordConfig, missing: list[int]) -> Iterator[None]:
    if config.workers == 1:
        _open_desk(config)
        yield from map(_record_one, missing)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(config.workers, context, _start_worker, (config, os.getpid())) as pool:
        futures = [pool.submit(_record_one, index) for index in missing]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)  # nobody writes after the lock is gone
            raise


_worker: tuple[RecordConfig, Desk]


def _start_worker(config: RecordConfig, parent: int) -> None:
    def follow_parent() -> None:  # a killed parent must not leave writers behind
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()
    _open_desk(config)


def _open_desk(config: RecordConfig) -> None:
    global _worker
    _worker = (config, Desk(config.scene, config.assets, config.cameras, config.renderer))


def _record_one(index: int) -> None:
    """Records episode ``index``: the first accepted one of its attempts."""
    config, desk = _worker
    task = config.tasks[index % len(config.tasks)]
    staging = config.output_dir / ".recording"
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([config.seed, index, attempt])
        try:
            demonstration = demonstrate(desk, task, rng, config.noise)
        except SimulationError:
            continue
        if demonstration is not None:
            break
    else:
        raise DeskError(f"{task} failed {ATTEMPTS} times in a row (seed {config.seed}, episode {index})")
    folder = staging / f"{index:06d}"
    shutil.rmtree(folder, ignore_errors=True)
    write_frames(folder, demonstration.frames, desk.scene)
    note = {"task": task, "frames": len(demonstration), "attempts": attempt + 1}
    partial = staging / f".{index:06d}-{os.getpid()}.partial"
    partial.write_text(json.dumps(note))
    partial.rename(staging / f"{index:06d}.json")


def _recording(staging: Path, index: int, commands: dict[str, list[str]], config: RecordConfig) -> Recording:
    note = json.loads((staging / f"{index:06d}.json").read_text())
    sentences = commands[note["task"]]
    choice = np.random.default_rng([config.seed, index, ATTEMPTS]).integers(len(sentences))
    return Recording(staging / f"{index:06d}", note["frames"], note["task"], sentences[choice])


def _summarise(config: RecordConfig, recordings: list[Recording]) -> None:
    print(f"{'task':28s} episodes  mean length")
    for task in dict.fromkeys(config.tasks):
        lengths = [r.frames for r in recordings if r.task == task]
        if lengths:
            print(f"{task:28s} {len(lengths):8d}  {np.mean(lengths):11.1f}")
    print(f"{sum(r.frames for r in recordings)} frames in {config.output_dir}")


def main() -> None:
    """Entry point of ``lansar-record``."""
    try:
        record(draccus.parse(RecordConfig))
    except (DeskError, OSError, draccus.utils.ParsingError) as error:
        print(f"lansar-record: error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
