"""A folder appears complete or not at all."""

import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PATIENCE = 3.0  # s; long enough for the workers of a killed run to notice and go


@contextmanager
def publishing(output_dir: Path) -> Iterator[Path]:
    """Gives a fresh temporary folder beside ``output_dir`` and renames it to ``output_dir`` at the end.

    If the block raises, the temporary folder is removed; if the process is killed, the next run removes it. A
    lock that dies with its process keeps two runs from sharing it.

    Args:
        output_dir: the folder to create; it must not exist, or be empty.

    Yields:
        The temporary folder, on the same file system.

    Raises:
        ValueError: another process is writing the same folder.
    """
    temporary = output_dir.parent / f".{output_dir.name}.incomplete"
    temporary.mkdir(parents=True, exist_ok=True)
    lock = os.open(temporary, os.O_RDONLY)
    try:
        _lock(lock, temporary, output_dir)
        try:
            for stale in temporary.iterdir():
                shutil.rmtree(stale) if stale.is_dir() else stale.unlink()
            yield temporary
            temporary.rename(output_dir)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    finally:
        os.close(lock)


def _lock(lock: int, temporary: Path, output_dir: Path) -> None:
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise ValueError(f"another process is writing {output_dir}: wait for it or stop it") from None
            time.sleep(0.1)
        else:
            # The other process may have renamed the folder between our opening and locking it.
            if temporary.exists() and os.path.samestat(os.fstat(lock), temporary.stat()):
                return
            raise ValueError(f"another process has just written {output_dir}")
