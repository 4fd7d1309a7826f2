"""`renderer="fast_gl"`: the pictures that Bullet's OpenGL renderer draws, CALVIN's public data among them."""

import numpy as np
from PIL import Image

from ..cameras import Camera
from . import raster
from .fast import FastRenderer, pack
from .stage import Stage

LIGHT = np.array([-5.0, -40.0, 200.0])
"""Where the EGL plugin's light is, m."""
HIGHLIGHT_EYE = 20 * np.array([np.sin(np.radians(20)), -np.cos(np.radians(20)), 0.0])
"""The plugin computes highlights for its window's own camera, not for the one that takes the picture."""
BACKGROUND = (179, 179, 204)

TEXELS_PER_METRE = 4096 / 20
"""Of the plugin's shadow map, which spans 20 m around the origin."""
STEP = 299 / 65535
"""Height (m) of one step of the shadow map's 16 bits: it spans distances of 1 to 300 m."""
_REGION = (-1.45, 0.85, -1.55, 0.7, 0.0, 1.3)
"""Box (m) around everything that can cast a shadow: x, y and z, lowest and highest."""


class OpenGLLook(FastRenderer):
    """Trilinear texels, one near light with highlights and a shadow, grey-blue background."""

    sample = 0.5

    def __init__(self, stage: Stage):
        super().__init__(stage)
        textures = [visual.mesh.texture for group in stage.groups for visual in group.visuals]
        chains = {id(texture): mipmaps(texture) for texture in textures if texture is not None}
        firsts: dict[int, int] = {}
        flat: list[np.ndarray] = []
        for key, chain in chains.items():
            firsts[key] = len(flat)
            flat += chain
        self._levels, self._texels = pack(flat)
        self._places = np.array(
            [(firsts[id(t)], len(chains[id(t)])) if t is not None else (0, 0) for t in textures], np.int64
        )
        self._shadow, extent = shadow_matrix()
        self._casters = np.zeros((extent, extent), np.float32)
        poses = self._stage.poses()
        self._cast(self._still, poses, self._casters)
        self._heights, self._shadow_of = self._casters, np.zeros(0)

    def _blank(self, size: int) -> np.ndarray:
        return np.zeros((size, size, 8), np.float32)

    def _rule(self, camera: Camera, group: int) -> tuple[float, float, float]:
        """The plugin asks for a depth buffer of 8 bits and gets one of 16; what was loaded first wins."""
        offset, scale = _depth_steps(camera)
        return offset, scale, float(raster.RANKS - 1 - group % raster.RANKS)

    def _inverse(self, closeness: np.ndarray, camera: Camera) -> np.ndarray:
        offset, scale = _depth_steps(camera)
        steps = np.floor(closeness / raster.RANKS)
        return np.where(closeness > 0, (steps - offset) / scale, 0).astype(np.float32)

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        raster.light_gl(
            ids,
            self._faces,
            self._screen,
            self._owner,
            self._normals,
            self._uvs,
            self._places,
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

    def _finish(self, canvas: np.ndarray, closeness: np.ndarray, poses: np.ndarray) -> np.ndarray:
        if not np.array_equal(poses, self._shadow_of):  # both cameras see the same shadow
            self._heights = self._casters.copy()
            self._cast(self._moving, poses, self._heights)
            self._shadow_of = poses.copy()
        picture = np.empty((*closeness.shape, 3), np.uint8)
        picture[:] = BACKGROUND
        raster.compose_gl(canvas, closeness, self._heights, STEP, picture)
        return picture

    def _cast(self, groups: list[int], poses: np.ndarray, heights: np.ndarray) -> None:
        """Enters the back faces of groups into the shadow map."""
        ids = np.empty(heights.shape, np.int32)
        limits = np.float32(1e-6), np.float32(np.inf)
        matrices = (self._shadow @ poses).astype(np.float32)
        for index in groups:
            part = self._parts[index]
            raster.project_flat(self._vertices[:, part.vertices], matrices[index], self._screen[part.vertices])
            first, last = part.faces.start, part.faces.stop
            raster.nearest(
                self._faces,
                first,
                last,
                self._screen,
                False,
                limits,
                self.smallest,
                (0.0, 0.0, 0.0),
                heights,
                ids,
            )


def _depth_steps(camera: Camera) -> tuple[float, float]:
    """Steps of a 16-bit depth buffer in front of the far plane at w m: offset + scale / w."""
    near, far = camera.near, camera.far
    return -65535 * near / (far - near), 65535 * far * near / (far - near)


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
    """A texture and its halvings down to one texel, each the mean of what it covers."""
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(1, n // 2) for n in levels[-1].shape[:2])
        levels.append(np.array(Image.fromarray(levels[-1]).resize((width, height), Image.Resampling.BOX)))
    return levels
