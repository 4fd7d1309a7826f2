"""`renderer="fast_gl"`: the pictures that Bullet's OpenGL renderer draws, among them those of CALVIN's public data."""

import numpy as np
from PIL import Image

from ..cameras import Intrinsics
from . import raster, shading
from .fast import FastRenderer, pack
from .stage import Stage

LIGHT = np.array([-5.0, -40.0, 200.0])
"""Position of the EGL plugin's light, m."""
HIGHLIGHT_EYE = 20 * np.array([np.sin(np.radians(20)), -np.cos(np.radians(20)), 0.0])
"""Position of the camera for which the plugin computes highlights, m: always that of its own window."""
BACKGROUND = (179, 179, 204)

TEXELS_PER_METRE = 4096 / 20
"""Resolution of the plugin's shadow map, which spans 20 m around the origin."""
STEP = 299 / 65535
"""Height of one step of the shadow map's 16 bits (m): it spans distances of 1 to 300 m."""
_REGION = (-1.45, 0.85, -1.55, 0.7, 0.0, 1.3)
"""Minimum and maximum x, y and z of everything that can cast a shadow (m)."""


class OpenGLLook(FastRenderer):
    """Trilinear texels, one near light with highlights and a shadow, grey-blue background."""

    sample = 0.5

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
        self._shadow, extent = shadow_matrix()
        self._casters = np.zeros((extent, extent), np.float32)
        poses = self._stage.poses()
        self._cast(self._still, poses, self._casters)
        self._heights, self._shadow_poses = self._casters, np.zeros(0)

    def _blank(self, size: int) -> np.ndarray:
        return np.zeros((size, size, 8), np.float32)

    def _encoding(self, intrinsics: Intrinsics, group: int) -> tuple[float, float, float]:
        """The plugin asks for a depth buffer of 8 bits and gets 16; at equal depth, what was loaded first wins."""
        offset, scale = _depth_steps(intrinsics)
        return offset, scale, float(raster.RANKS - 1 - group % raster.RANKS)

    def _inverse_depth(self, depth_buffer: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
        offset, scale = _depth_steps(intrinsics)
        steps = np.floor(depth_buffer / raster.RANKS)
        return np.where(depth_buffer > 0, (steps - offset) / scale, 0).astype(np.float32)

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        shading.light_gl(
            ids,
            self._faces,
            self._screen,
            self._owner,
            self._normals,
            self._uvs,
            self._textures,
            self._levels,
            self._texels,
            colors,
            poses,
            self._groups,
            self._vertices,
            LIGHT,
            HIGHLIGHT_EYE,
            self._shadow,
            canvas,
        )

    def _finish(self, canvas: np.ndarray, depth_buffer: np.ndarray, poses: np.ndarray) -> np.ndarray:
        if not np.array_equal(poses, self._shadow_poses):  # both cameras see the same shadow
            self._heights = self._casters.copy()
            self._cast(self._moving, poses, self._heights)
            self._shadow_poses = poses.copy()
        picture = np.empty((*depth_buffer.shape, 3), np.uint8)
        picture[:] = BACKGROUND
        shading.compose_gl(canvas, depth_buffer, self._heights, STEP, picture)
        return picture

    def _cast(self, groups: list[int], poses: np.ndarray, heights: np.ndarray) -> None:
        """Enters the back faces of groups into the shadow map `heights`."""
        ids = np.empty(heights.shape, np.int32)
        limits = np.float32(1e-6), np.float32(np.inf)
        matrices = (self._shadow @ poses).astype(np.float32)
        for group in groups:
            part = self._parts[group]
            raster.project_flat(self._vertices[:, part.vertices], matrices[group], self._screen[part.vertices])
            self._enter(part, False, limits, (0.0, 0.0, 0.0), heights, ids)


def _depth_steps(intrinsics: Intrinsics) -> tuple[float, float]:
    """(offset, scale): what is w m away is offset + scale / w steps of 16 bits in front of the far plane."""
    near, far = intrinsics.near, intrinsics.far
    return -65535 * near / (far - near), 65535 * far * near / (far - near)


def shadow_matrix() -> tuple[np.ndarray, int]:
    """World to the shadow map, (3, 4): column, row and height towards the light (m); and its side in texels.

    Columns run in the opposite direction of the plugin's. This turns back faces, which cast the shadow, to the front.
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
    """A texture and its halvings down to one texel; every texel is the mean of those that it covers."""
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(1, n // 2) for n in levels[-1].shape[:2])
        levels.append(np.array(Image.fromarray(levels[-1]).resize((width, height), Image.Resampling.BOX)))
    return levels
