"""`episodes.jsonl`: what became of each episode, written by all environments of an evaluation into one file."""

import json
from pathlib import Path
from typing import Any

from filelock import FileLock

from ..benchmark import EPISODES_FILE

LOCK_FILE = f".{EPISODES_FILE}.lock"
"""Lies beside `episodes.jsonl`, hidden and empty. It stays there, since waiting processes may have opened it."""


def append_episode(folder: Path, episode: dict[str, Any]) -> None:
    """Appends one whole line to the folder's `episodes.jsonl`; safe while other processes do the same.

    Args:
        folder: Made if missing.
        episode: JSON; `CalvinEnv` decides what it holds.
    """
    line = json.dumps(episode) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / LOCK_FILE), open(folder / EPISODES_FILE, "a") as file:
        file.write(line)
