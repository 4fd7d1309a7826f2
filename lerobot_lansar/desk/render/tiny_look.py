"""`renderer="fast"`: the pictures that PyBullet's TinyRenderer draws."""

import numpy as np

from . import shading
from .fast import FastRenderer, pack
from .stage import Stage

LIGHT = np.array([-50.0, 30.0, 100.0]) / np.linalg.norm([-50.0, 30.0, 100.0])
"""Direction to TinyRenderer's light."""


class TinyLook(FastRenderer):
    """Nearest texels, one distant light, no shadows, white background."""

    min_area = np.float32(0.01)

    def __init__(self, stage: Stage):
        super().__init__(stage)
        images = [visual.mesh.texture for group in stage.groups for visual in group.visuals]
        table, self._texels = pack([image for image in images if image is not None])
        self._textures = np.zeros((len(images), 3), np.int64)
        self._textures[[image is not None for image in images]] = table

    def _blank(self, size: int) -> np.ndarray:
        return np.full((size, size, 3), 255, np.uint8)

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        rotations = poses[self._groups, :3, :3]
        shading.shade_tiny(
            ids,
            self._faces,
            self._screen,
            self._owner,
            self._normals,
            self._uvs,
            self._textures,
            self._texels,
            colors,
            LIGHT @ rotations,
            rotations[:, 2],
            canvas,
        )

    def _finish(self, canvas: np.ndarray, depth_buffer: np.ndarray, poses: np.ndarray) -> np.ndarray:
        return canvas
