"""What our two software renderers share: geometry in flat arrays, and finding the nearest face at each pixel.

Both draw the triangles that PyBullet's renderers draw, but compute each pixel's colour once, skip links that are out
of the picture, and draw what never moves once per fixed camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras import Intrinsics
from . import raster
from .bullet import Colors
from .stage import Group, Stage

BACKDROPS = 3
"""How many backdrops, a few MB each, are kept: one per fixed camera and picture size."""


class FastRenderer:
    """Draws a stage; subclasses define colours and light.

    Args:
        stage: What there is to draw, and where.
    """

    min_area = np.float32(0)
    """Faces whose doubled area in the picture is smaller (square pixels) are not drawn."""
    sample = 0.0
    """Where pixels are sampled: 0 at the lower left corner, 0.5 in the middle."""

    def __init__(self, stage: Stage):
        self._stage = stage
        visuals = [visual for group in stage.groups for visual in group.visuals]
        meshes = [visual.mesh for visual in visuals]
        self._keys = [(visual.body, visual.link) for visual in visuals]
        self._own_colors = np.array([visual.color for visual in visuals], np.float32)
        self._groups = np.repeat(np.arange(len(stage.groups)), [len(g.visuals) for g in stage.groups])
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        self._vertices = np.ascontiguousarray(np.concatenate([mesh.vertices for mesh in meshes]).T)
        self._faces = np.concatenate(
            [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts[:-1], strict=True)]
        ).astype(np.uint32)  # unsigned: numba need not check for negative indices
        self._normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)
        self._uvs = np.concatenate([mesh.uvs for mesh in meshes]).astype(np.float32)
        self._owner = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        self._screen = np.empty((self._vertices.shape[1], 3), np.float32)
        self._parts = [_Part(self._vertices[:, v], v, f) for v, f in _ranges(stage.groups)]
        self._still = [i for i, group in enumerate(stage.groups) if group.still]
        self._moving = [i for i, group in enumerate(stage.groups) if not group.still]
        # resting blocks tremble; resting joints stand still to the last bit
        self._jointed = [i for i in self._moving if stage.groups[i].jointed]
        self._backdrops: dict[tuple[int, bytes], tuple[_Layer, _Layer]] = {}

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
        projection = self._intrinsic_matrix(intrinsics, size) @ view
        poses = self._stage.poses()
        if fixed:
            layer, rest = self._backdrop(intrinsics, projection, size, poses, colors)
            canvas, depth_buffer = layer.canvas.copy(), layer.depth_buffer.copy()
        else:
            canvas, depth_buffer = self._blank(size), np.zeros((size, size), np.float32)
            rest = list(range(len(self._parts)))
        self._paint(rest, projection, intrinsics, poses, colors, canvas, depth_buffer)
        return self._finish(canvas, depth_buffer, poses), self._inverse_depth(depth_buffer, intrinsics)[::-1]

    def _backdrop(
        self, intrinsics: Intrinsics, projection: np.ndarray, size: int, poses: np.ndarray, colors: Colors
    ) -> tuple["_Layer", list[int]]:
        """What has not moved since this camera's last picture, already drawn, and the groups still to be drawn."""
        key = size, projection.tobytes()
        if key not in self._backdrops:
            if len(self._backdrops) >= BACKDROPS:  # forget the oldest
                del self._backdrops[next(iter(self._backdrops))]
            bottom = _Layer(self._blank(size), np.zeros((size, size), np.float32), poses.copy(), colors, [])
            self._paint(self._still, projection, intrinsics, poses, {}, bottom.canvas, bottom.depth_buffer)
            self._backdrops[key] = bottom, bottom
        bottom, layer = self._backdrops[key]
        unmoved = (poses == layer.poses).all((1, 2))
        groups = [i for i in self._jointed if unmoved[i]] if colors == layer.colors else []
        if groups != layer.groups:
            layer = _Layer(bottom.canvas.copy(), bottom.depth_buffer.copy(), poses.copy(), colors, groups)
            self._paint(groups, projection, intrinsics, poses, colors, layer.canvas, layer.depth_buffer)
        else:  # the layer's own groups have not moved: only the other groups' poses are new
            layer.poses[:] = poses
            layer.colors = colors
        self._backdrops[key] = bottom, layer
        return layer, [i for i in self._moving if i not in groups]

    def _encoding(self, intrinsics: Intrinsics, group: int) -> tuple[float, float, float]:
        """What the depth buffer holds (`raster.nearest`); inverse depth by default."""
        return 0.0, 0.0, 0.0

    def _inverse_depth(self, depth_buffer: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
        """Inverse depth (1/m) from the depth buffer."""
        return depth_buffer

    def _blank(self, size: int) -> np.ndarray:
        """An empty canvas for `_shade`."""
        raise NotImplementedError

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        """Fills the canvas where `ids` (size, size) holds the number of a face."""
        raise NotImplementedError

    def _finish(self, canvas: np.ndarray, depth_buffer: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """The picture, (size, size, 3) uint8."""
        raise NotImplementedError

    def _intrinsic_matrix(self, intrinsics: Intrinsics, size: int) -> np.ndarray:
        """(3, 4) eye coordinates to homogeneous pixels (column * w, row * w, w)."""
        focal = size / 2 / np.tan(np.radians(intrinsics.fov) / 2)
        middle = size / 2 - self.sample
        return np.array([[focal, 0, -middle, 0], [0, focal, -middle, 0], [0, 0, -1, 0]])

    def _paint(
        self,
        groups: Sequence[int],
        projection: np.ndarray,
        intrinsics: Intrinsics,
        poses: np.ndarray,
        colors: Colors,
        canvas: np.ndarray,
        depth_buffer: np.ndarray,
    ) -> None:
        """Draws groups onto a canvas and its depth buffer."""
        size = len(depth_buffer)
        limits = np.float32(intrinsics.near), np.float32(intrinsics.far)
        ids = np.full((size, size), raster.NOTHING, np.int32)
        matrices = (projection @ poses).astype(np.float32)
        for group in groups:
            part, matrix = self._parts[group], matrices[group]
            if raster.outside(matrix, part.center, part.radius, size):
                continue
            behind = raster.project(self._vertices[:, part.vertices], matrix, self._screen[part.vertices])
            encoding = self._encoding(intrinsics, group)
            self._enter(part, behind, limits, encoding, depth_buffer, ids)
        rgba = self._own_colors
        if colors:
            rgba = rgba.copy()
            for index, key in enumerate(self._keys):
                if key in colors:
                    rgba[index] = colors[key]
        self._shade(ids, poses, rgba, canvas)

    def _enter(
        self,
        part: "_Part",
        behind: bool,
        limits: tuple[np.float32, np.float32],
        encoding: tuple[float, float, float],
        depth_buffer: np.ndarray,
        ids: np.ndarray,
    ) -> None:
        """Enters a part's faces, whose vertices are already projected, into the buffers (`raster.nearest`)."""
        faces, screen, (first, last) = self._faces, self._screen, (part.faces.start, part.faces.stop)
        raster.nearest(faces, first, last, screen, behind, limits, self.min_area, encoding, depth_buffer, ids)


@dataclass
class _Layer:
    """Part of a picture.

    Attributes:
        canvas, depth_buffer: Drawn so far.
        poses, colors: Those of the camera's last picture.
        groups: Groups that are drawn, besides those that never move.
    """

    canvas: np.ndarray
    depth_buffer: np.ndarray
    poses: np.ndarray
    colors: Colors
    groups: list[int]


class _Part:
    """Where the arrays hold a group's vertices and faces, and the sphere around them."""

    def __init__(self, points: np.ndarray, vertices: slice, faces: slice):
        self.vertices, self.faces = vertices, faces
        low, high = points.min(1), points.max(1)
        self.center = ((low + high) / 2).astype(np.float64)
        self.radius = float(np.linalg.norm(high - low) / 2)


def _ranges(groups: Sequence[Group]) -> Iterator[tuple[slice, slice]]:
    vertex = face = 0
    for group in groups:
        first_vertex, first_face = vertex, face
        for visual in group.visuals:
            vertex += len(visual.mesh.vertices)
            face += len(visual.mesh.faces)
        yield slice(first_vertex, vertex), slice(first_face, face)


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
