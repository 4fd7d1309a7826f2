"""What our two software renderers share: finding the nearest face at each pixel, and backdrops of fixed cameras.

Both draw the triangles that PyBullet's renderers draw, but compute each pixel's colour once, skip what is out of the
picture or faces away, and draw what never moves once per fixed camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ..cameras import Intrinsics
from . import raster
from .bullet import Colors
from .geometry import Geometry
from .stage import Stage

BACKDROPS = 3
"""How many backdrops, a few MB each, are kept: one per fixed camera and picture size."""


_NONE = np.zeros(0)


@dataclass
class Frame:
    """A picture that is being drawn.

    Attributes:
        intrinsics: Field of view and clip planes.
        projection: (3, 4) world coordinates to homogeneous pixels (column * w, row * w, w).
        poses: (G, 4, 4) of the groups. colors: Rgba of repainted links, by (body, link).
        world: (3, 4) homogeneous pixels to world coordinates, m; its last column is where the camera is.
        picture: (size, size, 3) uint8. inverse_depth: (size, size) float32, 1 / w, row 0 at the bottom.
    """

    intrinsics: Intrinsics
    projection: np.ndarray
    poses: np.ndarray
    colors: Colors
    picture: np.ndarray
    inverse_depth: np.ndarray

    def __post_init__(self) -> None:
        self.world = _world(self.projection.tobytes())


@lru_cache(8)  # fixed cameras ask for the same one again and again
def _world(projection: bytes) -> np.ndarray:
    matrix = np.frombuffer(projection).reshape(3, 4)
    back = np.linalg.inv(matrix[:, :3])
    return np.column_stack([back, -back @ matrix[:, 3]])


@dataclass
class Layer:
    """Part of a fixed camera's picture.

    Attributes:
        picture, inverse_depth: Drawn so far.
        poses, colors: Those of the camera's last picture.
        groups: Groups that are drawn, besides those that never move.
        surface, lit, dark: What a look remembers of each pixel, which ones it may have to correct, and how they look in
            full shadow.
    """

    picture: np.ndarray
    inverse_depth: np.ndarray
    poses: np.ndarray
    colors: Colors
    groups: list[int]
    surface: np.ndarray
    lit: np.ndarray = field(default_factory=lambda: np.zeros(0))
    dark: np.ndarray = field(default_factory=lambda: np.zeros(0))


class SoftwareRenderer:
    """Draws a stage; subclasses define colours and light.

    Args:
        stage: What there is to draw, and where.
    """

    min_area = np.float32(0)
    """Faces whose doubled area in the picture is smaller (square pixels) are not drawn."""
    sample = 0.0
    """Where pixels are sampled: 0 at the lower left corner, 0.5 in the middle."""
    first_wins = False
    """Which of two faces at the same depth is seen: the one that Bullet draws first, or the one that it draws last."""
    background = (255, 255, 255)

    def __init__(self, stage: Stage):
        self._stage = stage
        self._geometry = Geometry(stage.groups)
        visuals = [visual for group in stage.groups for visual in group.visuals]
        self._keys = [(visual.body, visual.link) for visual in visuals]
        self._own_colors = np.array([visual.color for visual in visuals], np.float32)
        self._groups = np.repeat(np.arange(len(stage.groups)), [len(g.visuals) for g in stage.groups])
        self._still = [i for i, group in enumerate(stage.groups) if group.still]
        self._moving = [i for i, group in enumerate(stage.groups) if not group.still]
        # resting blocks tremble; resting joints stand still to the last bit
        self._jointed = [i for i in self._moving if stage.groups[i].jointed]
        self._blanks: dict[int, np.ndarray] = {}
        self._backdrops: dict[tuple[int, bytes], tuple[Layer, Layer]] = {}

    def draw(
        self, intrinsics: Intrinsics, view: np.ndarray, size: int, colors: Colors, fixed: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """A picture of the present state and its inverse depth.

        Args:
            intrinsics: Field of view and clip planes.
            view: (4, 4) world to eye.
            size: Pixels per side.
            colors: Rgba of repainted links, by (body, link).
            fixed: Whether the camera never moves; then bodies that never move either are drawn only once.

        Returns:
            Picture (size, size, 3) uint8, and inverse depth (size, size) float32: 1 / distance along the view axis
            (1/m), 0 where there is nothing.
        """
        projection, poses = self._intrinsic_matrix(intrinsics, size) @ view, self._stage.poses()
        self._prepare(poses)
        if not fixed:
            frame = self._blank(intrinsics, projection, size, poses, colors)
            self._paint(range(len(self._stage.groups)), frame)
            return frame.picture, frame.inverse_depth[::-1]
        layer, rest = self._backdrop(intrinsics, projection, size, poses, colors)
        picture, inverse_depth = layer.picture.copy(), layer.inverse_depth.copy()
        frame = Frame(intrinsics, projection, poses, colors, picture, inverse_depth)
        ids = self._paint(rest, frame)
        self._relight(layer, ids, frame)
        return frame.picture, frame.inverse_depth[::-1]

    def _backdrop(
        self, intrinsics: Intrinsics, projection: np.ndarray, size: int, poses: np.ndarray, colors: Colors
    ) -> tuple[Layer, list[int]]:
        """What has not moved since this camera's last picture, already drawn, and the groups still to be drawn."""
        key = size, projection.tobytes()
        if key not in self._backdrops:
            if len(self._backdrops) >= BACKDROPS:  # forget the oldest
                del self._backdrops[next(iter(self._backdrops))]
            blank = self._blank(intrinsics, projection, size, poses, {})
            bottom = Layer(blank.picture, blank.inverse_depth, poses.copy(), colors, [], self._surface(size))
            self._paint(self._still, blank, bottom)
            self._backdrops[key] = bottom, bottom
        bottom, layer = self._backdrops[key]
        unmoved = (poses == layer.poses).all((1, 2))
        groups = [i for i in self._jointed if unmoved[i]] if colors == layer.colors else []
        if groups != layer.groups:
            picture, inverse_depth, surface = (a.copy() for a in (bottom.picture, bottom.inverse_depth, bottom.surface))
            layer = Layer(picture, inverse_depth, poses.copy(), colors, groups, surface)
            self._paint(groups, Frame(intrinsics, projection, poses, colors, picture, inverse_depth), layer)
        else:  # the layer's own groups have not moved: only the other groups' poses are new
            layer.poses[:] = poses
            layer.colors = colors
        self._backdrops[key] = bottom, layer
        return layer, [i for i in self._moving if i not in groups]

    def _paint(self, groups: Sequence[int], frame: Frame, layer: Layer | None = None) -> np.ndarray:
        """Draws groups onto a frame, which may be a layer's; returns the number of the face drawn at each pixel."""
        ids = np.full(frame.inverse_depth.shape, raster.NOTHING, np.int32)
        matrices, geometry = (frame.projection @ frame.poses).astype(np.float32), self._geometry
        raster.nearest(
            np.asarray(groups, np.int64),
            matrices,
            ((frame.world[:, 3] - frame.poses[:, :3, 3])[:, None] @ frame.poses[:, :3, :3])[:, 0],
            geometry.spheres,
            geometry.ranges,
            geometry.cones,
            geometry.corners,
            geometry.ranks,
            (np.float32(frame.intrinsics.near), np.float32(frame.intrinsics.far)),
            self.min_area,
            self.first_wins,
            frame.inverse_depth,
            ids,
        )
        rgba = self._own_colors
        if frame.colors:
            rgba = rgba.copy()
            for index, key in enumerate(self._keys):
                if key in frame.colors:
                    rgba[index] = frame.colors[key]
        self._shade(ids, matrices, rgba, frame, layer)
        return ids

    def _blank(
        self, intrinsics: Intrinsics, projection: np.ndarray, size: int, poses: np.ndarray, colors: Colors
    ) -> Frame:
        if size not in self._blanks:
            self._blanks = {size: np.full((size, size, 3), self.background, np.uint8)}
        picture = self._blanks[size].copy()
        return Frame(intrinsics, projection, poses, colors, picture, np.zeros((size, size), np.float32))

    def _intrinsic_matrix(self, intrinsics: Intrinsics, size: int) -> np.ndarray:
        """(3, 4) eye coordinates to homogeneous pixels (column * w, row * w, w)."""
        focal = size / 2 / np.tan(np.radians(intrinsics.fov) / 2)
        middle = size / 2 - self.sample
        return np.array([[focal, 0, -middle, 0], [0, focal, -middle, 0], [0, 0, -1, 0]])

    def _surface(self, size: int) -> np.ndarray:
        """Space for what a layer remembers besides its picture."""
        return _NONE

    def _prepare(self, poses: np.ndarray) -> None:
        """Called before a picture is drawn."""

    def _shade(
        self, ids: np.ndarray, matrices: np.ndarray, rgba: np.ndarray, frame: Frame, layer: Layer | None
    ) -> None:
        """Fills the pixels at which `ids` (size, size) holds the number of a face; in `layer` if one is drawn."""
        raise NotImplementedError

    def _relight(self, layer: Layer, ids: np.ndarray, frame: Frame) -> None:
        """Corrects pixels of a layer that look different now; those at which `ids` holds a face were drawn over."""


def pack(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Images in one array; an image that occurs twice is held once.

    Args:
        images: (height, width, 3) uint8 each.

    Returns:
        (images, 3) int64: first texel, width and height of each image; and all texels, (T, 3) uint8.
    """
    starts: dict[int, int] = {}
    texels: list[np.ndarray] = [np.zeros((1, 3), np.uint8)]
    count = 1
    table = np.zeros((len(images), 3), np.int64)
    for index, image in enumerate(images):
        if id(image) not in starts:
            starts[id(image)] = count
            texels.append(image.reshape(-1, 3))
            count += len(texels[-1])
        table[index] = starts[id(image)], image.shape[1], image.shape[0]
    return table, np.concatenate(texels)
