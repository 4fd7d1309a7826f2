"""Atomic, resumable creation of an output folder: prepared in a staging folder, then renamed."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

_LOCK, _REQUEST, _SUBMITTED = "lock", "request.json", "submitted"
_PATIENCE = 3.0  # s to wait for another process, in case it is just ending


def write_atomically(file: Path, text: str) -> None:
    """Writes a file that nobody ever sees incomplete."""
    partial = file.with_name(file.name + ".partial")
    partial.write_text(text)
    partial.rename(file)


@contextmanager
def staging(
    folder: Path,
    target: Path,
    request: dict[str, Any],
    has_results: Callable[[Path], bool],
    submitting: bool = False,
) -> Iterator[None]:
    """Makes `folder` the place where `target` is prepared: new, or as an interrupted run of the request left it.

    Only one process can be in the block; its lock ends with it, even if it is killed. If the block raises, nothing
    counts as submitted, and a folder without any result is removed.

    Args:
        folder: Where to prepare.
        target: The output that will appear, for messages.
        request: Everything that decides the result; JSON.
        has_results: Whether the folder holds anything worth keeping.
        submitting: Whether the block submits jobs that will write into the folder after it.

    Raises:
        ValueError: Another process is writing, submitted jobs may be, or the folder holds results of another request.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / _LOCK, timeout=_PATIENCE):
            _claim(folder, target, json.loads(json.dumps(request)), has_results)
            try:
                with submitted_jobs(folder, submitting):
                    yield
            except BaseException:
                if not has_results(folder):
                    shutil.rmtree(folder, ignore_errors=True)
                raise
    except Timeout:
        raise ValueError(f"another process is writing {target}: wait for it or stop it") from None


def publish(folder: Path, result: Path, target: Path) -> None:
    """Renames `result`, the finished part of a staging folder, to its place and removes the rest."""
    end_submitted(folder)  # first: if killed below, no later run waits for jobs
    result.rename(target)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def submitted_jobs(folder: Path, submitting: bool) -> Iterator[None]:
    """Marks a folder as one that jobs will write into after the block; not if the block raises.

    Args:
        folder: Exists.
        submitting: Whether the block submits jobs.
    """
    if submitting:
        (folder / _SUBMITTED).touch()
    try:
        yield
    except BaseException:
        end_submitted(folder)
        raise


def end_submitted(folder: Path) -> None:
    """Removes the mark: the jobs are done."""
    (folder / _SUBMITTED).unlink(missing_ok=True)


def refuse_submitted(folder: Path, target: Path) -> None:
    """Raises ValueError if submitted jobs may still write into a staging folder."""
    if (folder / _SUBMITTED).exists():
        raise ValueError(
            f"Slurm jobs for {target} were submitted already: wait for them, or cancel them and delete "
            f"{folder / _SUBMITTED} to submit what is missing"
        )


def _claim(folder: Path, target: Path, request: dict[str, Any], has_results: Callable[[Path], bool]) -> None:
    refuse_submitted(folder, target)
    file = folder / _REQUEST
    # Results without their request are of unknown options: start anew.
    if not (file.exists() and has_results(folder)):
        _remove(path for path in folder.iterdir() if path.name != _LOCK)
        write_atomically(file, json.dumps(request, indent=1) + "\n")
    elif json.loads(file.read_text()) != request:
        raise ValueError(
            f"{folder} holds work that was begun with other options: repeat those of {file}, or delete that folder"
        )
    _remove(folder.glob("*.partial"))  # left by killed processes


def _remove(paths: Iterator[Path]) -> None:
    """Removes files and folders; some may vanish meanwhile."""
    for path in list(paths):
        if path.is_dir():
            shutil.rmtree(path, onexc=_accept_missing)
        else:
            path.unlink(missing_ok=True)


def _accept_missing(function: Callable[..., Any], path: str, error: BaseException) -> None:
    """Called by `shutil.rmtree` for what it cannot remove."""
    if not isinstance(error, FileNotFoundError):
        raise error
