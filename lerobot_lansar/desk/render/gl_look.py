"""`renderer="gl"`: the pictures that Bullet's OpenGL renderer draws on a GPU, CALVIN's public data among them."""

from collections.abc import Sequence

import numpy as np
from PIL import Image

from . import raster, shading
from .geometry import Clusters, corners_of, simplified
from .software import Frame, Layer, SoftwareRenderer, pack
from .stage import Stage

LIGHT = np.array([-5.0, -40.0, 200.0])
"""Where the EGL plugin's light is, m."""
HIGHLIGHT_EYE = np.array([-2.0, -0.17, 0.0])
"""The eye (m) that highlights are for: not the camera's. Fitted to a frame of the public data."""

TEXELS_PER_METRE = 4096 / 20
"""Of the plugin's shadow map, which spans 20 m around the origin."""
_NO_SURFACE = np.zeros((1, 1, 8), np.float32)
_REGION = (-1.45, 0.85, -1.55, 0.7, 0.0, 1.3)
"""Box (m) around everything that can cast a shadow: x, y and z, lowest and highest."""


class OpenGLLook(SoftwareRenderer):
    """Trilinear texels, one near light with highlights and a shadow, grey-blue background."""

    sample = 0.5
    first_wins = True
    background = (179, 179, 204)

    def __init__(self, stage: Stage):
        super().__init__(stage)
        images = [visual.mesh.texture for group in stage.groups for visual in group.visuals]
        levels: list[np.ndarray] = []
        ranges: dict[int, tuple[int, int]] = {}  # image to first level and number of levels
        for image in images:
            if image is not None and id(image) not in ranges:
                chain = mipmaps(image)
                ranges[id(image)] = len(levels), len(chain)
                levels += chain
        self._levels, self._texels = pack(levels)
        self._textures = np.array([ranges.get(id(image), (0, 0)) for image in images], np.int64)
        cell = 0.6 / TEXELS_PER_METRE  # finer detail casts no shadow of its own
        self._caster_clusters = Clusters([simplified(corners_of(group), cell) for group in stage.groups])
        self._shadow, extent = shadow_matrix()
        self._lamp = np.stack([LIGHT, HIGHLIGHT_EYE])
        poses = self._stage.poses()
        self._casters = np.zeros((extent, extent), np.float32)
        self._dirty = np.zeros((extent // raster.BLOCK + 1, extent // raster.BLOCK + 1), np.uint8)
        self._cast(self._still, poses, self._casters, self._dirty.copy())
        # The same with the links that have not moved lately, which links they are, and where all were.
        self._base = self._casters, self._dirty, list[int](), poses.copy()
        self._heights, self._heights_of = self._casters, np.zeros(0)

    def _prepare(self, poses: np.ndarray) -> None:
        if np.array_equal(poses, self._heights_of):  # both cameras see the same shadow
            return
        settled, dirty, groups, before = self._base
        unmoved = (poses == before).all((1, 2))
        if groups != (groups := [i for i in self._jointed if unmoved[i]]):
            settled, dirty = self._casters.copy(), np.zeros_like(self._dirty)
            self._cast(groups, poses, settled, dirty)
        self._base = settled, dirty, groups, poses.copy()
        self._heights, self._dirty = settled.copy(), dirty.copy()
        self._cast([i for i in self._moving if i not in groups], poses, self._heights, self._dirty)
        self._heights_of = self._base[3]

    def _surface(self, size: int) -> np.ndarray:
        return np.zeros((size, size, 8), np.float32)

    def _shade(
        self, ids: np.ndarray, matrices: np.ndarray, rgba: np.ndarray, frame: Frame, layer: Layer | None
    ) -> None:
        geometry = self._geometry
        # a layer keeps what does not change: the shadow of what never moves
        heights, surface = (self._heights, _NO_SURFACE) if layer is None else (self._casters, layer.surface)
        shading.shade_gl(
            ids,
            frame.inverse_depth,
            geometry.faces,
            matrices,
            geometry.shapes,
            self._groups,
            self._textures,
            self._levels,
            self._texels,
            rgba,
            frame.poses[:, :3, :3].copy(),
            frame.world,
            self._lamp,
            self._shadow,
            heights,
            frame.picture,
            layer is not None,
            surface,
        )
        if layer is not None:
            layer.lit = self._lit(layer)
            layer.dark = np.empty((len(layer.lit), 3), np.uint8)
            shading.darken(layer.lit, layer.surface, layer.dark)

    def _lit(self, layer: Layer) -> np.ndarray:
        """Pixels of a layer on which a shadow can fall, (n, 3) int32: number, and the shadow map's column and row."""
        texels = np.floor(layer.surface[..., 5:7]).reshape(-1, 2)
        inside = ((texels >= 0) & (texels < len(self._casters) - 1)).all(-1)
        lit = (layer.inverse_depth.ravel() > 0) & (layer.surface[..., 3].ravel() >= 0.5)
        pixels = np.flatnonzero(inside & lit)
        return np.column_stack([pixels, texels[pixels]]).astype(np.int32)

    def _relight(self, layer: Layer, ids: np.ndarray, frame: Frame) -> None:
        shading.relight(layer.lit, layer.dark, ids, layer.surface, self._heights, self._dirty, frame.picture)

    def _cast(self, groups: Sequence[int], poses: np.ndarray, heights: np.ndarray, dirty: np.ndarray) -> None:
        """Enters groups into a shadow map, and marks the blocks that it writes to."""
        matrices, clusters = self._shadow @ poses, self._caster_clusters
        raster.cast(
            np.asarray(groups, np.int64),
            matrices.astype(np.float32),
            matrices[:, 2, :3],
            clusters.ranges,
            clusters.cones,
            clusters.corners,
            heights,
            dirty,
        )


def shadow_matrix() -> tuple[np.ndarray, int]:
    """World to the shadow map, (3, 4): column, row and height towards the light (m); and how many texels a side has.

    The columns run against the plugin's, so that the back faces, which cast the shadow, turn to the front.
    """
    forward = -LIGHT / np.linalg.norm(LIGHT)
    up = np.cross(np.array([1.0, 0.0, 0.0]), -forward)
    side = np.cross(forward, up / np.linalg.norm(up))
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    axes = np.array([-side * TEXELS_PER_METRE, up * TEXELS_PER_METRE, -forward])
    offset = -axes @ LIGHT + [4096 / 2 - 0.5, 4096 / 2 - 0.5, 300.0]
    corners = np.stack(np.meshgrid(_REGION[0:2], _REGION[2:4], _REGION[4:6]), -1).reshape(-1, 3)
    seen = corners @ axes[:2].T + offset[:2]
    origin = np.floor(seen.min(0))
    offset[:2] -= origin
    return np.column_stack([axes, offset]), int((seen - origin).max()) + 2


def mipmaps(texture: np.ndarray) -> list[np.ndarray]:
    """A texture and its halvings down to one texel, each the mean of what it covers; halves are rounded down, as the
    GPU did that recorded the public data."""
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        size = tuple(max(1, n // 2) for n in levels[-1].shape[1::-1])
        channels = [Image.fromarray(levels[-1][..., i].astype(np.float32)) for i in range(3)]
        means = [np.array(channel.resize(size, Image.Resampling.BOX)) for channel in channels]
        levels.append(np.ceil(np.stack(means, -1) - 0.5 - 1e-4).astype(np.uint8))
    return levels
