"""Runs work that is cut into shards, then one finishing step: in local processes, under Slurm or on Ray.

A shard's number decides what it does, so its result is the same wherever and however often it runs. Each shard checks
for its own output; datatrove's completion markers can outlive it.
"""

import importlib.util
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tqdm import tqdm

from .pool import in_processes
from .work import SlurmConfig, Work

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
            function, arguments = work
            for _ in in_processes(partial(function, *arguments), range(shards), workers):
                pass
    function, arguments = finish
    function(*arguments, 0)
    return True


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
