"""Reads a split's language index: the annotated windows, and the embeddings of their sentences.

CALVIN's loader looks for `auto_lang_ann.npy` in a folder that the user names, `lang_annotations` by default, then in
the split's own folder. So does this.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset_convert.safe_pickle import load_object_array
from lerobot_lansar.clip.store import dataset_fingerprint

LANG_FOLDER = "lang_annotations"
"""The folder in which public data and recordings have their language index."""

EMBEDDINGS = "lang"
"""A dataset's folder for the embeddings of its windows' sentences."""

_INDEX = "auto_lang_ann.npy"


@dataclass(frozen=True)
class Window:
    """One annotated demonstration: frames `start` to `end - 1` of the split.

    Attributes:
        start: First frame number.
        end: First frame number after the window: exclusive in CALVIN, which is easy to get wrong.
        task: Task name, such as `open_drawer`.
        sentence: The command in words.
        scene: The scene's letter, such as `D`; "" if the window lies in no scene.
    """

    start: int
    end: int
    task: str
    sentence: str
    scene: str

    def __len__(self) -> int:
        return self.end - self.start


def language_file(folder: Path, lang_folder: str) -> Path:
    """A split's language index, whether or not it exists.

    Args:
        folder: The split's folder.
        lang_folder: Name of the folder in it.

    Raises:
        FileNotFoundError: A folder other than the usual one is named and holds none.
    """
    path = folder / lang_folder / _INDEX
    if path.is_file():
        return path
    if lang_folder == LANG_FOLDER:
        return folder / _INDEX if (folder / _INDEX).is_file() else path
    found = sorted(file.parent.name for file in folder.glob(f"*/{_INDEX}"))
    raise FileNotFoundError(
        f"{path} is missing: --lang_folder={lang_folder} (folders found: {', '.join(found) or 'none'})"
    )


def read_windows(path: Path, scenes: dict[str, tuple[int, int]]) -> list[Window]:
    """The annotated windows in the file's order.

    Args:
        path: What `language_file` returned.
        scenes: Scene letter to its (first, last) frame.

    Raises:
        FileNotFoundError: The file is missing.
        ValueError: It is malformed.
    """
    stored = load_object_array(path)
    try:
        spans = [(int(start), int(end)) for start, end in stored["info"]["indx"]]
        sentences, tasks = (_strings(stored["language"][key]) for key in ("ann", "task"))
        if not len(spans) == len(sentences) == len(tasks):
            raise ValueError(f"{len(spans)} windows, {len(sentences)} sentences, {len(tasks)} tasks")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        wanted = "language.ann, language.task and info.indx of one length"
        raise ValueError(f"{path}: expected {wanted} ({error})") from error
    return [
        Window(start, end, task, sentence.strip(), scene_of(start, end, scenes))
        for (start, end), task, sentence in zip(spans, tasks, sentences, strict=True)
    ]


def _strings(stored: Iterable[Any]) -> list[str]:
    if not all(isinstance(item, str) for item in stored):
        raise TypeError("a command or a task is not a string")
    return [str(item) for item in stored]


def scene_of(start: int, end: int, scenes: dict[str, tuple[int, int]]) -> str:
    """The scene of frames `start` to `end`, the latter excluded; "" if they are not in one."""
    letters = (letter for letter, (first, last) in scenes.items() if first <= start and end - 1 <= last)
    return next(letters, "")


def find_faults(windows: list[Window], recordings: np.ndarray) -> dict[int, str]:
    """Windows that cannot become an episode: their numbers, and why not.

    Args:
        windows: Of the split.
        recordings: (N, 2) first and last frame of each uninterrupted recording, in order.
    """
    # A window across two recordings would join frames that are not 1/30 s apart.
    at = np.searchsorted(recordings[:, 0], [window.start for window in windows], side="right") - 1
    faults = {}
    for number, (window, row) in enumerate(zip(windows, at, strict=True)):
        what = f"window [{window.start}, {window.end}) of {window.task!r}"
        if window.end <= window.start:
            faults[number] = f"{what} is empty"
        elif not window.scene:
            faults[number] = f"{what} lies in no scene of scene_info.npy"
        elif row < 0 or window.end - 1 > recordings[row, 1]:
            faults[number] = f"{what} is not inside one recording of ep_start_end_ids.npy"
        elif not window.sentence:
            faults[number] = f"{what} has an empty sentence"
    return faults


def read_embeddings(path: Path, windows: int) -> np.ndarray:
    """The embeddings of the windows' sentences that the annotation's author stored beside them.

    Args:
        path: What `language_file` returned.
        windows: How many there must be.

    Returns:
        (windows, D) float32, a row per window.

    Raises:
        ValueError: There are none, or not one of each window.
    """
    stored = load_object_array(path)["language"].get("emb")
    try:
        rows = np.asarray(stored, dtype=np.float32)
        rows = rows.reshape(len(rows), -1)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: language.emb holds no numbers ({error}); leave out --lang_embeddings") from error
    if len(rows) != windows or not rows.size or not np.isfinite(rows).all():
        raise ValueError(
            f"{path}: language.emb is {rows.shape}, expected finite numbers for each of {windows} windows; "
            "leave out --lang_embeddings"
        )
    return rows


def write_embeddings(root: Path, lang_folder: str, rows: np.ndarray) -> None:
    """Keeps sentence embeddings beside a dataset: `lang/<encoder>.npy`, and what they are in `lang/<encoder>.json`.

    Args:
        root: The dataset's folder, whose frame tables are complete.
        lang_folder: Where they are from; its name without `lang_` is the encoder's, except in `LANG_FOLDER`.
        rows: (windows, D) float32.
    """
    name = embeddings_name(lang_folder)
    (root / EMBEDDINGS).mkdir(exist_ok=True)
    np.save(root / EMBEDDINGS / f"{name}.npy", rows)
    description = {
        "encoder": None if lang_folder == LANG_FOLDER else name,
        "lang_folder": lang_folder,
        "row": "calvin.window",
        "windows": len(rows),
        "embed_dim": rows.shape[1],
        "fingerprint": dataset_fingerprint(root),
    }
    (root / EMBEDDINGS / f"{name}.json").write_text(json.dumps(description, indent=1) + "\n")


def embeddings_name(lang_folder: str) -> str:
    """What the files with a folder's embeddings are called, without their extensions."""
    return lang_folder if lang_folder == LANG_FOLDER else lang_folder.removeprefix("lang_").replace("/", "_")
