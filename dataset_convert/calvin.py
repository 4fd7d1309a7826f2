"""One split of a CALVIN dataset on disk: its recordings, scenes, annotated windows and frames.

Layout of a split (`training/` or `validation/`), of the public data and of `lansar-record` alike::

    episode_0000000.npz ...            one file per frame
    ep_start_end_ids.npy               (N, 2) first and last frame of each uninterrupted recording
    scene_info.npy                     pickled {scene name: [first frame, last frame]}; public data: in training/ only
    lang_annotations/auto_lang_ann.npy pickled {"language": {"ann", "task", "emb"}, "info": {"indx"}}
    .hydra/merged_config.yaml          how it was recorded

A language window is `[start, end)`: its end is exclusive. Recordings and scenes include their last frame.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dataset_convert.frames import frame_file, frame_numbers, read_frame
from dataset_convert.language import LANG_FOLDER, find_faults, language_file, read_windows
from dataset_convert.look import read_look
from dataset_convert.scenes import find_scenes, read_recordings


class CalvinSplit:
    """The index of one split, read and checked once; frames are read on demand.

    Args:
        root: The dataset's folder.
        split: The split's name.
        lang_folder: Name of the split's folder with the language index.
        scene: Letter of the scene that all of the split was recorded in, where no file says it; "" if it is not known.
        skip_bad: List faulty windows in `faults`; otherwise the first one is an error.

    Attributes:
        root: The dataset's folder.
        name: The split's name.
        folder: The split's folder.
        language: The language index.
        scenes: Scene letter to its (first, last) frame, both inclusive.
        scenes_from: Where the scenes are known from, for people.
        windows: The annotated windows in the file's order.
        faults: Numbers of the windows that cannot become an episode, and why not.
        recordings: (N, 2) first and last frame of each uninterrupted recording, in order.
        look: What drew the pictures, and their size.
        source_sha256: Hash of the index files, which identifies what was converted.

    Raises:
        FileNotFoundError: The folder or one of its index files is missing.
        ValueError: An index file is malformed, or a window is faulty and `skip_bad` is off.
    """

    def __init__(
        self, root: Path, split: str, *, lang_folder: str = LANG_FOLDER, scene: str = "", skip_bad: bool = False
    ):
        self.root, self.name = root, split
        self.folder = root / split
        if not self.folder.is_dir():
            found = sorted(path.parent.name for path in root.glob("*/ep_start_end_ids.npy"))
            raise FileNotFoundError(
                f"{self.folder} is not a folder: --root must hold --split={split}"
                + (f" (splits found: {', '.join(found)})" if found else " with CALVIN's files")
            )
        self.look = read_look(self.folder)
        index = self.folder / "ep_start_end_ids.npy"
        self.recordings = read_recordings(index)
        scenes = find_scenes(self.folder, self.recordings, scene)
        self.scenes, self.scenes_from = scenes.ranges, scenes.source
        self.language = language_file(self.folder, lang_folder)
        self.windows = read_windows(self.language, self.scenes)
        self.faults = find_faults(self.windows, self.recordings)
        if self.faults and not skip_bad:
            first = next(iter(self.faults.values()))
            raise ValueError(
                f"{self.language}: {first} ({len(self.faults)} such windows; --skip_bad=true leaves them out)"
            )
        digest = hashlib.sha256()
        for path in (self.language, scenes.file, index):
            digest.update(path.read_bytes() if path else b"")
        self.source_sha256 = digest.hexdigest()

    def frame_file(self, frame: int) -> Path:
        """The file of one frame, whether or not it exists."""
        return frame_file(self.folder, frame)

    def frames(self) -> np.ndarray:
        """The numbers of all frame files there are, sorted, (n,) int64."""
        return frame_numbers(self.folder)

    def read(self, frames: Iterable[int], keys: Iterable[str]) -> dict[str, np.ndarray]:
        """Reads some arrays of some frames.

        Args:
            frames: n frame numbers.
            keys: Names out of `VECTORS`, `RGB`, `DEPTH`, `TACTILE` and `INTERVENTION`.

        Returns:
            For each key an array of shape (n, ...) in the file's floating dtype, uint8 for colours, or bool.

        Raises:
            FileNotFoundError: A frame's file is missing.
            OSError: The machine cannot read a file, which need not be defective.
            ValueError: A file is truncated, or an array in it is missing or has a wrong shape or dtype; the
                message names the file and the key.
        """
        columns: dict[str, list[np.ndarray]] = {key: [] for key in keys}
        for frame in frames:
            for key, array in read_frame(self.frame_file(frame), columns, self.look.image_size).items():
                columns[key].append(array)
        return {key: np.stack(column) for key, column in columns.items()}
