"""A folder appears complete or not at all, and work on it goes on where it stopped."""

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_PATIENCE = 3.0  # s; long enough for the workers of a killed run to notice and go

DATASET, SHARDS = "dataset", "shards"
"""Folders in a staging folder: what will be published, and one note per finished shard."""

_SUBMITTED = "submitted"


def staging_of(output_dir: Path) -> Path:
    """Where a dataset is prepared: a hidden folder beside its place, on the same file system."""
    return output_dir.parent / f".{output_dir.name}.incomplete"


@contextmanager
def staging(output_dir: Path, request: dict[str, Any]) -> Iterator[Path]:
    """Gives the staging folder of ``output_dir``, new or with what an interrupted run of the same request left.

    A lock that dies with its process keeps two runs from sharing it. If the block raises, nothing counts as submitted;
    if that is before any shard is finished, the folder is removed.

    Args:
        output_dir: the folder to create.
        request: everything that decides the result; JSON.

    Raises:
        ValueError: another process is writing, or another request was begun.
    """
    folder = staging_of(output_dir)
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder, os.O_RDONLY)
    try:
        _lock(lock, folder, output_dir)
        _claim(folder, output_dir, request)
        try:
            yield folder
        except BaseException:
            (folder / _SUBMITTED).unlink(missing_ok=True)
            if not finished_shards(folder):
                shutil.rmtree(folder, ignore_errors=True)
            raise
    finally:
        os.close(lock)


def finished_shards(folder: Path) -> list[Path]:
    """The notes of finished shards in a staging folder, in order."""
    return sorted((folder / SHARDS).glob("*.json"))


def mark_submitted(folder: Path) -> None:
    """From now on jobs elsewhere write here."""
    (folder / _SUBMITTED).touch()


def publish(folder: Path, output_dir: Path) -> None:
    """Renames the finished dataset to its place and removes the rest."""
    (folder / DATASET).rename(output_dir)
    tidy(output_dir)


def tidy(output_dir: Path) -> None:
    """Removes what making a dataset left beside it, once it is in its place."""
    shutil.rmtree(staging_of(output_dir), ignore_errors=True)


def _claim(folder: Path, output_dir: Path, request: dict[str, Any]) -> None:
    file = folder / "request.json"
    if not (folder / DATASET).exists():  # new, or left by a run that was killed just after it published
        _empty(folder)
    if (folder / _SUBMITTED).exists():
        raise ValueError(
            f"Slurm jobs for {output_dir} were submitted already: wait for them, or cancel them and delete "
            f"{folder / _SUBMITTED} to submit what is missing"
        )
    if not (file.exists() and json.loads(file.read_text()) == json.loads(json.dumps(request))):
        if finished_shards(folder):
            raise ValueError(
                f"{folder} holds a conversion that was begun with other options: repeat those of {file}, or delete "
                "that folder"
            )
        _empty(folder)
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(request, indent=1) + "\n")
        partial.rename(file)
    for name in (DATASET, SHARDS):
        (folder / name).mkdir(exist_ok=True)


def _empty(folder: Path) -> None:
    for stale in folder.iterdir():
        shutil.rmtree(stale) if stale.is_dir() else stale.unlink()


def _lock(lock: int, folder: Path, output_dir: Path) -> None:
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise ValueError(f"another process is writing {output_dir}: wait for it or stop it") from None
            time.sleep(0.1)
        else:
            # The other process may have removed the folder between our opening and locking it.
            if folder.exists() and os.path.samestat(os.fstat(lock), folder.stat()):
                return
            raise ValueError(f"another process has just written {output_dir}")
