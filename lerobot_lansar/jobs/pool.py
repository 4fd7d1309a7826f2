"""A function called for many items in processes of this machine, which end with their parent and with each other."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from .work import WorkerDied


def usable_cores() -> int:
    """How many CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


def in_processes[Item, Result](
    work: Callable[[Item], Result], items: Sequence[Item], workers: int, ordered: bool = False
) -> Iterator[Result]:
    """Calls `work` for every item.

    Args:
        work: Pickled once for each process, so it may hold much.
        items: Pickled.
        workers: Processes; with one worker, the work is done in this process.
        ordered: Whether results come in the order of the items, or else as they are ready.

    Yields:
        The results.

    Raises:
        WorkerDied: A worker was killed.
        Exception: Whatever `work` raised. The other workers are ended.
    """
    if workers == 1:
        yield from map(work, items)
        return
    context = _Context()
    pool = ProcessPoolExecutor(workers, context, _begin, (work,))
    try:
        with _blocked_interrupts():  # the workers start here
            futures = [pool.submit(_call, item) for item in items]
            # Each submission may start a worker, but only the next one makes the pool watch it: without this one, the
            # death of the last worker would go unnoticed until another one is done.
            pool.submit(int)
        for future in futures if ordered else as_completed(futures):
            yield future.result()
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


_work: Callable[[Any], Any] | None = None
"""What a worker does with each item."""


def _begin(work: Callable[[Any], Any]) -> None:
    global _work
    _work = work
    _follow_parent()


def _call(item: Any) -> Any:
    assert _work is not None
    return _work(item)


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
