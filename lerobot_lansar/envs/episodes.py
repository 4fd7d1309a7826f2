"""`episodes.jsonl`: what became of each episode, written by all environments of an evaluation into one file."""

import json
import os
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock

from ..benchmark import EPISODES_FILE

LOCK_FILE = f".{EPISODES_FILE}.lock"
"""Lies beside `episodes.jsonl`, hidden and empty. It stays there, since waiting processes may have opened it."""


def append_episode(folder: Path, episode: dict[str, Any]) -> None:
    """Appends one whole line to the folder's `episodes.jsonl`; safe while other processes do the same.

    The beginning of a line that a killed process left at the end of the file is removed.

    Args:
        folder: Made if missing.
        episode: JSON; `CalvinEnv` decides what it holds.
    """
    line = json.dumps(episode) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / LOCK_FILE), open(folder / EPISODES_FILE, "a+b") as file:
        file.truncate(_whole_lines(file))
        file.write(line.encode())


def _whole_lines(file: BinaryIO) -> int:
    """How many bytes of a file are whole lines."""
    end = file.seek(0, os.SEEK_END)
    while end:
        start = max(0, end - 4096)
        file.seek(start)
        newline = file.read(end - start).rfind(b"\n")
        if newline >= 0:
            return start + newline + 1
        end = start
    return 0
