"""Runs work that is cut into shards, then one finishing step: in local processes, under Slurm or on Ray (datatrove).

A shard's number decides what it does, so the result is the same wherever and however often it runs. Work that is done
must notice that itself: datatrove's own memory of it, in the logging folder, would outlive what was made.
"""

import contextlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import multiprocess
from datatrove.executor import LocalPipelineExecutor, RayPipelineExecutor, SlurmPipelineExecutor
from datatrove.pipeline.base import PipelineStep
from datatrove.utils.logging import logger
from tqdm import tqdm

EXECUTORS = ("local", "slurm", "ray")


class WorkerDied(Exception):
    """Workers ended without a word, killed by the system or a user, or failed on another machine."""


@dataclass
class SlurmConfig:
    """How jobs are submitted to Slurm (``sbatch``); one array element runs ``shards_per_job`` shards."""

    partition: str = ""
    time: str = "24:00:00"
    qos: str = "normal"
    mem_per_cpu_gb: int = 4
    shards_per_job: int = 1
    # Further options of sbatch, for example account.
    sbatch_args: dict[str, str] = field(default_factory=dict)


def check_executor(executor: str, slurm: SlurmConfig) -> None:
    """Raises ValueError if an executor is unknown or cannot run here."""
    if executor not in EXECUTORS:
        raise ValueError(f"--executor is one of {', '.join(EXECUTORS)}, got {executor!r}")
    if executor == "slurm" and (shutil.which("sbatch") is None or not slurm.partition):
        raise ValueError("--executor=slurm needs Slurm's sbatch on the PATH, and --slurm.partition=NAME")
    if executor == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError("--executor=ray needs Ray: pip install 'lerobot_policy_lansar[ray]'")


class Step(PipelineStep):
    """One step of datatrove's, made of a function of the shard's number. It is pickled, so the function must be a
    module's own, with its arguments in ``arguments``.
    """

    name = "lansar"
    type = "work"

    def __init__(self, function: Callable[..., None], arguments: tuple[Any, ...], quiet: bool):
        super().__init__()
        self.function, self.arguments, self.quiet = function, arguments, quiet

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.quiet:
            logger.disable("datatrove")
        if multiprocess.parent_process() is not None:
            _end_with_parent()

    def run(self, data: Any, rank: int = 0, world_size: int = 1) -> None:
        with self.track_time():
            self.function(*self.arguments, rank)


def run_shards(
    work: tuple[Callable[..., None], tuple[Any, ...]],
    shards: int,
    finish: tuple[Callable[..., None], tuple[Any, ...]],
    *,
    executor: str,
    workers: int,
    slurm: SlurmConfig,
    logging_dir: Path,
    progress: Callable[[], int],
    total: int,
    unit: str,
    desc: str = "recording",
) -> bool:
    """Calls ``work`` for every shard and ``finish`` once after them.

    Args:
        work: A function and its first arguments; the shard's number comes last. It is called for every shard, also
            for those that an earlier call finished.
        shards: How many there are.
        finish: A function and its first arguments; it too is called with a number, 0.
        executor: One of :data:`EXECUTORS`.
        workers: Processes at a time; with Slurm the array's limit of tasks at a time.
        slurm: Used by the executor of that name.
        logging_dir: Where logs are kept.
        progress: How many of ``total`` units are done, for the bar of the local executor.
        total, unit, desc: Of the bar.

    Returns:
        Whether all is done; False when jobs were submitted that go on without this process.

    Raises:
        WorkerDied: A local worker was killed; the same call goes on where it stopped.
        ValueError: The local executor was not called from the main thread, which alone can be woken.
        subprocess.CalledProcessError: Slurm refused a job; those it had taken are cancelled.
        Exception: Whatever ``work`` or ``finish`` raised.
    """
    quiet = executor == "local"
    steps = [Step(*work, quiet), Step(*finish, quiet)]
    folders = [str(logging_dir / name) for name in ("work", "finish")]
    for folder in folders:
        shutil.rmtree(Path(folder) / "completions", ignore_errors=True)
    if executor == "slurm":
        jobs = _Jobs()
        options = {**_slurm_options(slurm), "job_id_retriever": jobs}
        first = SlurmPipelineExecutor(
            [steps[0]], shards, workers=workers, tasks_per_job=slurm.shards_per_job, logging_dir=folders[0],
            job_name="lansar", **options,
        )  # fmt: skip
        last = SlurmPipelineExecutor(
            [steps[1]],
            1,
            logging_dir=folders[1],
            job_name="lansar-finish",
            depends=first,
            **options,
        )
        try:
            last.run()
        except BaseException:
            if jobs:  # or those of the next try would write the same files
                subprocess.run(["scancel", *jobs], check=False)
            raise
        return False
    if executor == "ray":
        import ray

        if not ray.is_initialized():
            ray.init()
        remote = RayPipelineExecutor([steps[0]], shards, workers=workers, logging_dir=folders[0])
        with _watched(progress, total, unit, desc):
            remote.run()
        if missing := remote.get_incomplete_ranks(skip_completed=True):
            raise WorkerDied(
                f"{len(missing)} of {shards} shards failed on Ray; their logs are in {folders[0]}/logs"
            )
    else:
        logger.disable("datatrove")
        local = LocalPipelineExecutor([steps[0]], shards, workers=workers, logging_dir=folders[0])
        with _watched(progress, total, unit, desc), _forks_end_with_us():
            local.run()
    finish[0](*finish[1], 0)
    return True


class _Jobs(list[str]):
    """The numbers of submitted jobs: datatrove calls it with what sbatch printed."""

    def __call__(self, printed: str) -> str:
        self.append(printed.split()[-1])
        return self[-1]


def _slurm_options(slurm: SlurmConfig) -> dict[str, Any]:
    return {
        "time": slurm.time,
        "partition": slurm.partition,
        "qos": slurm.qos,
        "mem_per_cpu_gb": slurm.mem_per_cpu_gb,
        "sbatch_args": dict(slurm.sbatch_args),
        # datatrove's own commands must be found where the jobs run
        "venv_path": str(Path(sys.prefix) / "bin" / "activate") if sys.prefix != sys.base_prefix else None,
        "mail_type": "NONE",
    }


_following = 0  # the process that does


def _end_with_parent() -> None:
    """A killed parent must not leave anyone behind: its children notice within a moment and end."""
    global _following
    if _following == os.getpid():
        return
    _following = os.getpid()
    parent = os.getppid()

    def follow() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


_watching = False
_GRACE = 5.0  # s in which a pool that lost a worker may end by itself


@contextlib.contextmanager
def _forks_end_with_us() -> Iterator[None]:
    """The process in which datatrove keeps its queue is forked, and would outlive a killed parent."""
    global _watching
    _watching = True
    try:
        yield
    finally:
        _watching = False


os.register_at_fork(after_in_child=lambda: _end_with_parent() if _watching else None)


@contextlib.contextmanager
def _watched(progress: Callable[[], int], total: int, unit: str, desc: str) -> Iterator[None]:
    """A bar. A pool waits forever for a local worker that was killed: here that ends in WorkerDied.

    The waiting thread is woken by a signal of our own: a job that a script left in the background ignores SIGINT.
    """
    ended, died = threading.Event(), threading.Event()
    before = signal.signal(signal.SIGUSR1, signal.default_int_handler)

    def watch() -> None:
        known: set[int] = set()
        with tqdm(total=total, initial=progress(), desc=desc, unit=unit) as bar:
            while not ended.wait(0.5):
                if new := progress() - bar.n:
                    bar.update(new)
                pool = {p.pid for p in multiprocess.active_children() if "PoolWorker" in p.name}
                if known - pool and progress() < total and not ended.wait(_GRACE):
                    died.set()
                    os.kill(os.getpid(), signal.SIGUSR1)
                    while not ended.wait(2 * _GRACE):  # the pool's end hangs too if the dead one held a lock
                        os.kill(os.getpid(), signal.SIGUSR1)
                    return
                known = pool
            bar.update(progress() - bar.n)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    except KeyboardInterrupt:
        if died.is_set():
            raise WorkerDied(
                "a worker process was killed (out of memory?); run the same command again to go on"
            ) from None
        raise
    finally:
        ended.set()
        thread.join()
        signal.signal(signal.SIGUSR1, before)
