"""What our two software renderers share: geometry in flat arrays, and finding the nearest face at each pixel.

Both draw the triangles that PyBullet's renderers draw, but look at each pixel's colour once, skip links that are out
of the picture, and draw what never moves once per standing camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras import Camera
from . import raster
from .bullet import Colors
from .stage import Group, Stage

BACKDROPS = 3
"""Standing cameras and sizes whose backdrops are kept, some MB each."""


class FastRenderer:
    """Draws a stage; its subclasses say how light falls.

    Args:
        stage: What there is to see, and where.
    """

    smallest = np.float32(0)
    """Faces of fewer doubled square pixels are not drawn."""
    sample = 0.0
    """Where in a pixel it is sampled: 0 its lower left corner, 0.5 its middle."""

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
        ).astype(np.uint32)  # unsigned: numba need not look out for negative indices
        self._normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)
        self._uvs = np.concatenate([mesh.uvs for mesh in meshes]).astype(np.float32)
        self._owner = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        self._screen = np.empty((self._vertices.shape[1], 3), np.float32)
        self._parts = [_Part(self._vertices[:, v], v, f) for v, f in _ranges(stage.groups)]
        self._still = [i for i, group in enumerate(stage.groups) if group.still]
        self._moving = [i for i, group in enumerate(stage.groups) if not group.still]
        # blocks tremble where they lie; joints stand still to the last bit
        self._slow = [i for i in self._moving if stage.groups[i].jointed]
        self._backdrops: dict[tuple[int, bytes], tuple[_Layer, _Layer]] = {}

    def draw(
        self, camera: Camera, view: np.ndarray, size: int, colors: Colors, keep: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """A picture of the present state and its depth.

        Args:
            camera: Field of view and clip planes.
            view: (4, 4) world to eye.
            size: Pixels per side.
            colors: Rgba of (body, link) that were repainted.
            keep: The camera stands still: remember what never moves.

        Returns:
            (size, size, 3) uint8, and (size, size) float32 of 1 / distance along the view axis (0 where there is
            nothing).
        """
        lens = self._lens(camera, size) @ view
        poses = self._stage.poses()
        if keep:
            layer, rest = self._settled(camera, lens, size, poses, colors)
            canvas, closeness = layer.canvas.copy(), layer.closeness.copy()
        else:
            canvas, closeness = self._blank(size), np.zeros((size, size), np.float32)
            rest = list(range(len(self._parts)))
        self._paint(rest, lens, camera, poses, colors, canvas, closeness)
        return self._finish(canvas, closeness, poses), self._inverse(closeness, camera)[::-1]

    def _settled(
        self, camera: Camera, lens: np.ndarray, size: int, poses: np.ndarray, colors: Colors
    ) -> tuple["_Layer", list[int]]:
        """A painting of what has not moved since the last picture of this camera, and the groups it lacks."""
        key = size, lens.tobytes()
        if key not in self._backdrops:
            if len(self._backdrops) >= BACKDROPS:  # a picture of another size than usual: forget the oldest
                del self._backdrops[next(iter(self._backdrops))]
            bottom = _Layer(self._blank(size), np.zeros((size, size), np.float32), poses.copy(), colors, [])
            self._paint(self._still, lens, camera, poses, {}, bottom.canvas, bottom.closeness)
            self._backdrops[key] = bottom, bottom
        bottom, layer = self._backdrops[key]
        same = (poses == layer.poses).all((1, 2))
        groups = [i for i in self._slow if same[i]] if colors == layer.colors else []
        if groups != layer.groups:
            layer = _Layer(bottom.canvas.copy(), bottom.closeness.copy(), poses.copy(), colors, groups)
            self._paint(groups, lens, camera, poses, colors, layer.canvas, layer.closeness)
        else:  # the groups painted have not moved: only the others' poses are new
            layer.poses[:] = poses
            layer.colors = colors
        self._backdrops[key] = bottom, layer
        return layer, [i for i in self._moving if i not in groups]

    def _rule(self, camera: Camera, group: int) -> tuple[float, float, float]:
        """What `raster.nearest` calls close; 1 / w by default."""
        return 0.0, 0.0, 0.0

    def _inverse(self, closeness: np.ndarray, camera: Camera) -> np.ndarray:
        """1 / distance from closeness."""
        return closeness

    def _blank(self, size: int) -> np.ndarray:
        """An empty canvas: whatever `_shade` fills."""
        raise NotImplementedError

    def _shade(self, ids: np.ndarray, poses: np.ndarray, colors: np.ndarray, canvas: np.ndarray) -> None:
        """Fills the canvas where `ids` names a face."""
        raise NotImplementedError

    def _finish(self, canvas: np.ndarray, closeness: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """The picture, (size, size, 3) uint8."""
        raise NotImplementedError

    def _lens(self, camera: Camera, size: int) -> np.ndarray:
        """(3, 4) eye coordinates to homogeneous pixels (column * w, row * w, w)."""
        focal = size / 2 / np.tan(np.radians(camera.fov) / 2)
        middle = size / 2 - self.sample
        return np.array([[focal, 0, -middle, 0], [0, focal, -middle, 0], [0, 0, -1, 0]])

    def _paint(
        self,
        drawn: Sequence[int],
        lens: np.ndarray,
        camera: Camera,
        poses: np.ndarray,
        colors: Colors,
        canvas: np.ndarray,
        closeness: np.ndarray,
    ) -> None:
        size = len(closeness)
        limits = np.float32(camera.near), np.float32(camera.far)
        ids = np.full((size, size), raster.NOTHING, np.int32)
        matrices = (lens @ poses).astype(np.float32)
        for index in drawn:
            part, matrix = self._parts[index], matrices[index]
            if raster.outside(matrix, part.center, part.radius, size):
                continue
            behind = raster.project(self._vertices[:, part.vertices], matrix, self._screen[part.vertices])
            first, last = part.faces.start, part.faces.stop
            raster.nearest(
                self._faces,
                first,
                last,
                self._screen,
                behind,
                limits,
                self.smallest,
                self._rule(camera, index),
                closeness,
                ids,
            )
        tints = self._own_colors
        if colors:
            tints = tints.copy()
            for index, key in enumerate(self._keys):
                if key in colors:
                    tints[index] = colors[key]
        self._shade(ids, poses, tints, canvas)


@dataclass
class _Layer:
    """Part of a picture: `groups` are painted on it, besides what never moves.

    Attributes:
        poses, colors: As they were when the camera last took a picture.
    """

    canvas: np.ndarray
    closeness: np.ndarray
    poses: np.ndarray
    colors: Colors
    groups: list[int]


class _Part:
    """Where a group's vertices and faces lie in the arrays, and the sphere around them."""

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


def pack(textures: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All texels of pictures in one (T, 3) array, and (start, width, height) of each; equal pictures share them."""
    starts: dict[int, int] = {}
    rows: list[np.ndarray] = [np.zeros((1, 3), np.uint8)]
    count = 1
    places = np.zeros((len(textures), 3), np.int64)
    for index, texture in enumerate(textures):
        if id(texture) not in starts:
            starts[id(texture)] = count
            rows.append(texture.reshape(-1, 3))
            count += len(rows[-1])
        places[index] = starts[id(texture)], texture.shape[1], texture.shape[0]
    return places, np.concatenate(rows)
