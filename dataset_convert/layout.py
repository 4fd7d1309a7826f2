"""How a converted dataset lies on disk: its frame tables, camera features, videos and manifest."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lerobot_lansar.calvin import CAMERAS
from lerobot_lansar.pictures import resize

FORMAT = 2
"""Of what is written, in the manifest. 1 had CALVIN's own angles in states, which jump."""


def check_format(folder: Path, manifest: dict[str, Any]) -> None:
    """Raises ValueError if a dataset was made by a version of the converter that wrote another format."""
    found = manifest["request"].get("format", 1)
    if found != FORMAT:
        raise ValueError(
            f"{folder} was made by another version of lansar-convert (format {found}, here {FORMAT}; format 1 has "
            "CALVIN's own angles, which jump): convert again"
        )


# H.264 at these settings keeps pictures better than LeRobot's default (libsvtav1, crf 30), encodes two to four times as
# fast, and takes a tenth more bytes (docs/dataset.md).
@dataclass
class RGBEncoder:
    """How videos are encoded, in LeRobot's terms."""

    # Codec, by LeRobot's name.
    vcodec: str = "h264"
    # Quality: lower is better and larger.
    crf: int = 18
    # Speed against size, one of the codec's presets; empty: the codec's default.
    preset: str = "veryfast"
    # Frames from one key frame to the next; 2 lets training jump to any frame.
    g: int = 2
    # Pixel format: yuv444p keeps each pixel's colour, yuv420p that of four pixels together. auto: yuv444p with h264 and
    # hevc, otherwise yuv420p.
    pix_fmt: str = "auto"


@dataclass(frozen=True)
class Codec:
    """How a video is encoded, in FFmpeg's terms.

    Attributes:
        name: The codec's name.
        pix_fmt: Pixel format.
        options: The codec's options.
        depth: Arguments of LeRobot's `quantize_depth`; None for colours.
    """

    name: str
    pix_fmt: str
    options: dict[str, str]
    depth: dict[str, Any] | None = None


@dataclass(frozen=True)
class Picture:
    """One camera feature.

    Pictures that come at another size are brought to that of the feature.

    Attributes:
        key: LeRobot's feature.
        array: CALVIN's array.
        channels: Which part of the array's last axis, `slice(None)` for all of it.
        shape: (H, W, C) of the feature.
        codec: Of its video; None: single pictures in the parquet files (PNG, depth as 32-bit float TIFF).
    """

    key: str
    array: str
    channels: slice | int
    shape: tuple[int, int, int]
    codec: Codec | None = None

    @property
    def is_depth(self) -> bool:
        """Whether it holds distances (m) and not colours."""
        return self.shape[2] == 1

    def of(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """This feature's part of CALVIN's arrays: (n, H, W, 3) uint8, or (n, H, W) float32 (m)."""
        found = arrays[self.array]
        if self.is_depth:
            found = found if found.ndim == 3 else found[..., self.channels]
            return self._resized(found.astype(np.float32))
        return self._resized(found[..., self.channels])

    def _resized(self, pictures: np.ndarray) -> np.ndarray:
        height, width = self.shape[:2]
        if pictures.shape[1:3] == (height, width):
            return pictures
        return np.stack([resize(picture, width) for picture in pictures])  # ten times faster than all at once


def camera_sizes(pictures: Iterable[Picture]) -> dict[str, int]:
    """Camera to the width and height of its pictures, of those features that show a camera's colours."""
    keys = {f"observation.images.{camera}": camera for camera in CAMERAS}
    return {keys[picture.key]: picture.shape[0] for picture in pictures if picture.key in keys}


@dataclass(frozen=True)
class Layout:
    """How the frame tables and videos look.

    Attributes:
        schema: Of the parquet files.
        pictures: All camera features.
        chunks_size: Files per folder.
        data_path, video_path: LeRobot's templates.
    """

    schema: pa.Schema
    pictures: tuple[Picture, ...]
    chunks_size: int
    data_path: str
    video_path: str

    def numbers(self, shard: int) -> dict[str, int]:
        """Chunk and file number of a shard."""
        chunk, file = divmod(shard, self.chunks_size)
        return {"chunk_index": chunk, "file_index": file}

    def data_file(self, shard: int) -> str:
        """The shard's frame table, relative to the dataset's folder."""
        return self.data_path.format(**self.numbers(shard))

    def video_file(self, shard: int, key: str) -> str:
        """The shard's video of one camera, relative to the dataset's folder."""
        return self.video_path.format(video_key=key, **self.numbers(shard))

    def camera_sizes(self) -> dict[str, int]:
        """Camera to the width and height of its pictures; none if the dataset has no pictures."""
        return camera_sizes(self.pictures)

    def files(self, shard: int) -> list[str]:
        """The shard's frame table and videos, relative to the dataset's folder."""
        videos = [self.video_file(shard, picture.key) for picture in self.pictures if picture.codec]
        return [self.data_file(shard), *videos]
