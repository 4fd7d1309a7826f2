"""`renderer="tiny"`: the pictures that PyBullet's TinyRenderer draws."""

import numpy as np

from . import shading
from .software import Frame, Layer, SoftwareRenderer, pack
from .stage import Stage

LIGHT = np.array([-50.0, 30.0, 100.0]) / np.linalg.norm([-50.0, 30.0, 100.0])
"""Direction to TinyRenderer's light."""


class TinyLook(SoftwareRenderer):
    """Nearest texels, one distant light, no shadows, white background."""

    min_area = np.float32(0.01)

    def __init__(self, stage: Stage):
        super().__init__(stage)
        images = [visual.mesh.texture for group in stage.groups for visual in group.visuals]
        table, self._texels = pack([image for image in images if image is not None])
        self._textures = np.zeros((len(images), 3), np.int64)
        self._textures[[image is not None for image in images]] = table

    def _shade(
        self, ids: np.ndarray, matrices: np.ndarray, rgba: np.ndarray, frame: Frame, layer: Layer | None
    ) -> None:
        rotations, geometry = frame.poses[self._groups, :3, :3], self._geometry
        shading.shade_tiny(
            ids,
            geometry.faces,
            matrices,
            geometry.shapes,
            self._groups,
            self._textures,
            self._texels,
            rgba,
            LIGHT @ rotations,
            rotations[:, 2],
            frame.picture,
        )
