"""Writes a video picture by picture."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..calvin import CONTROL_HZ


class Video:
    """An mp4 that is written picture by picture and appears when it is complete.

    Its size is that of its first picture, whose width and height must be even. Without a picture there is no file.
    """

    def __init__(self, path: Path):
        import av  # late: not everybody who drives a desk makes a video

        self._path, self._partial = path, path.with_name(f".{path.name}.partial.mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self._partial), "w")
        self._stream: Any = self._container.add_stream("libx264", rate=Fraction(CONTROL_HZ), pix_fmt="yuv420p")
        self._stream.width = self._stream.height = 0
        self._frame = av.VideoFrame.from_ndarray

    def add(self, picture: np.ndarray) -> None:
        """Appends a picture, (height, width, 3) uint8."""
        if not self._stream.width:
            self._stream.height, self._stream.width = picture.shape[:2]
        self._container.mux(self._stream.encode(self._frame(picture, format="rgb24")))

    def __enter__(self) -> "Video":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        complete = kind is None and self._stream.width > 0
        if self._stream.width:
            self._container.mux(self._stream.encode())
        self._container.close()
        if complete:
            self._partial.replace(self._path)
            print(f"video: {self._path}")
        else:
            self._partial.unlink(missing_ok=True)
