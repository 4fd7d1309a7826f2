"""`renderer="fast"`: the pictures that PyBullet's TinyRenderer draws."""

import numpy as np

from . import raster
from .fast import FastRenderer, pack
from .stage import Stage

LIGHT = np.array([-50.0, 30.0, 100.0]) / np.linalg.norm([-50.0, 30.0, 100.0])
"""Direction to TinyRenderer's light."""


class TinyLook(FastRenderer):
    """Nearest texels, one distant light, no shadows, white background."""

    smallest = np.float32(0.01)

    def __init__(self, stage: Stage):
        super().__init__(stage)
        textures = [visual.mesh.texture for group in stage.groups for visual in group.visuals]
        places, self._texels = pack([texture for texture in textures if texture is not None])
        self._places = np.zeros((len(textures), 3), np.int64)
        self._places[[texture is not None for texture in textures]] = places

    def _blank(self, size: int) -> np.ndarray:
        return np.full((size, size, 3), 255, np.uint8)

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        rotations = poses[self._groups, :3, :3]
        raster.shade_tiny(
            ids,
            self._faces,
            self._screen,
            self._owner,
            self._normals,
            self._uvs,
            self._places,
            self._texels,
            colors,
            LIGHT @ rotations,
            rotations[:, 2],
            canvas,
        )

    def _finish(self, canvas: np.ndarray, closeness: np.ndarray, poses: np.ndarray) -> np.ndarray:
        return canvas
