"""Runs work that is cut into shards, then one finishing step: in local processes, under Slurm or on Ray.

A shard's number decides what it does, so its result is the same wherever and however often it runs. Each shard checks
for its own output; datatrove's completion markers can outlive it.
"""

import importlib.util
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

from tqdm import tqdm

from .work import SlurmConfig, Work, WorkerDied

EXECUTORS = ("local", "slurm", "ray")


def check_executor(executor: str, slurm: SlurmConfig) -> None:
    """Raises ValueError if an executor is unknown or cannot run here."""
    if executor not in EXECUTORS:
        raise ValueError(f"--executor is one of {', '.join(EXECUTORS)}, got {executor!r}")
    if executor == "slurm" and (shutil.which("sbatch") is None or not slurm.partition):
        raise ValueError("--executor=slurm needs Slurm's sbatch on the PATH, and --slurm.partition=NAME")
    if executor == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError("--executor=ray needs Ray: pip install 'lerobot_policy_lansar[ray]'")


def run_shards(
    work: Work,
    shards: int,
    finish: Work,
    *,
    executor: str,
    workers: int,
    slurm: SlurmConfig,
    logging_dir: Path,
    progress: Callable[[], int],
    total: int,
    unit: str,
    desc: str = "recording",
    status: Callable[[], str] = str,
) -> bool:
    """Calls `work` for every shard and `finish` once after them.

    Args:
        work: Called for every shard, also for those that an earlier call finished.
        shards: How many there are.
        finish: Called once, with 0 as its last argument.
        executor: One of `EXECUTORS`.
        workers: Processes at a time; under Slurm, the array's limit of jobs at a time.
        slurm: Used by the executor of that name.
        logging_dir: Where Slurm's and Ray's logs are kept.
        progress: Returns how many of `total` units are done, for the progress bar.
        total, unit, desc: The progress bar's length, unit and title.
        status: Returns what the progress bar says at its end.

    Returns:
        True when all work is done, False when jobs were submitted that run without this process.

    Raises:
        WorkerDied: A worker was killed; the same call goes on where it stopped.
        subprocess.CalledProcessError: Slurm refused a job; those it had taken are cancelled.
        Exception: Whatever `work` or `finish` raised.
    """
    if executor != "local":
        from . import cluster  # datatrove takes a second to import

        if executor == "slurm":
            cluster.submit_to_slurm(work, shards, finish, workers, slurm, logging_dir)
            return False
    with _progress_bar(progress, status, total, unit, desc):
        if executor == "ray":
            cluster.run_on_ray(work, shards, workers, logging_dir)
        else:
            _run_here(work, shards, workers)
    function, arguments = finish
    function(*arguments, 0)
    return True


def _run_here(work: Work, shards: int, workers: int) -> None:
    """Runs all shards in processes of this machine; with one worker, in this process."""
    function, arguments = work
    if workers == 1:
        for shard in range(shards):
            function(*arguments, shard)
        return
    context = _Context()
    pool = ProcessPoolExecutor(workers, context, initializer=_follow_parent)
    try:
        with _blocked_interrupts():  # the workers start here
            futures = [pool.submit(function, *arguments, shard) for shard in range(shards)]
        wait(futures, return_when=FIRST_EXCEPTION)
        for future in futures:
            if future.done():
                future.result()
    except BaseException as error:  # end the other workers too, whatever they are doing
        for process in context.processes:
            if process.is_alive():
                process.terminate()
        if isinstance(error, BrokenProcessPool):
            raise WorkerDied(
                "a worker process was killed (out of memory?); run the same command again to go on"
            ) from None
        raise
    finally:
        pool.shutdown(cancel_futures=True)


class _Context(SpawnContext):
    """Starts processes by "spawn" and remembers them: a pool cannot end its own before Python 3.14.

    Attributes:
        processes: All that were made, in order.
    """

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[SpawnProcess] = []

    def Process(self, *args: Any, **options: Any) -> SpawnProcess:  # type: ignore[override]
        """Called by the pool."""
        process = SpawnProcess(*args, **options)
        self.processes.append(process)
        return process


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Holds Ctrl-C back. Processes that start in the block ignore it for good, so that their parent alone reacts."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _follow_parent() -> None:
    """Makes a worker exit when the main process was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def _progress_bar(
    progress: Callable[[], int], status: Callable[[], str], total: int, unit: str, desc: str
) -> Iterator[None]:
    ended = threading.Event()
    bar = tqdm(total=total, initial=progress(), desc=desc, unit=unit)  # here, where nobody has redirected stderr yet

    def watch() -> None:
        is_last = False
        while not is_last:
            is_last = ended.wait(0.5)
            bar.set_postfix_str(status(), refresh=False)
            bar.update(progress() - bar.n)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        bar.close()
