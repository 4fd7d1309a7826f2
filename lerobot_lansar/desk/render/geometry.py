"""All triangles of a stage in flat arrays, cut into clusters that are skipped as a whole.

A cluster holds up to `CLUSTER` faces of one link that lie together and look the same way. One that turns its back to
the eye is skipped after one look, and its corners are projected side by side, which compilers make fast code of.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from .stage import Group

CLUSTER = 32
"""Faces in a cluster; the last one of a link is filled up with faces of no size."""
_CELLS = 16  # per axis, of the grid by which faces are sorted


class Clusters:
    """Arrays over K clusters and F = K * CLUSTER faces; face `f` is number `f % CLUSTER` of cluster `f // CLUSTER`.

    Args:
        points: For each group its faces, (n, 3, 3): the corners of each, m, in the link's frame.

    Attributes:
        corners: (K, 9, CLUSTER) float32: x, y, z of the first corners, of the second and of the third.
        cones: (K, 8) float64: center (3) and radius (m) of a cluster, the direction that its faces look in (3), and
            the sine of the largest angle between that and a face's normal (2 where that is no use).
        ranges: (G, 2) int64 first cluster of each group, and the one after its last.
        places: (n,) int64 number of each face, in the order given; the other numbers are faces of no size.
    """

    def __init__(self, points: Sequence[np.ndarray]):
        cones: list[list[float]] = []
        places: list[np.ndarray] = []
        ends = [0]
        for faces in points:
            order, bounds = _clustered(faces)
            place = np.empty(len(faces), np.int64)
            for first, end in pairwise(bounds):
                place[order[first:end]] = np.arange(end - first) + CLUSTER * len(cones)
                cones.append(_cone(faces[order[first:end]]))
            places.append(place)
            ends.append(len(cones))
        self.cones, self.places = np.array(cones), np.concatenate(places)
        self.ranges = np.array(list(pairwise(ends)))
        self.corners = np.ascontiguousarray(
            self.filled(np.concatenate(points)).reshape(-1, CLUSTER, 9).transpose(0, 2, 1)
        )

    def filled(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of all faces as (F, ...) float32 or int32, by their numbers."""
        dtype = np.float32 if values.dtype.kind == "f" else np.int32
        rows = np.zeros((CLUSTER * len(self.cones), *values.shape[1:]), dtype)
        rows[self.places] = values
        return rows


class Geometry(Clusters):
    """The faces of all visuals, with what coloring them needs.

    Args:
        groups: Whose visuals these are.

    Attributes:
        faces: (F, 24) float32, all of a face in one piece of memory: positions of its corners (9, m), unit normals
            there (9) and texture coordinates there (6).
        shapes: (F,) int32 number of the visual that a face belongs to.
        ranks: (F,) int32 place of a face in the order in which Bullet draws them.
        spheres: (G, 4) center and radius of each group, m.
    """

    def __init__(self, groups: Sequence[Group]):
        meshes = [visual.mesh for group in groups for visual in group.visuals]
        super().__init__([corners_of(group) for group in groups])
        counts = [len(mesh.faces) for mesh in meshes]
        points = [mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in meshes]
        normals = [mesh.normals.reshape(-1, 9) for mesh in meshes]
        uvs = [mesh.uvs.reshape(-1, 6) for mesh in meshes]
        self.faces = self.filled(np.hstack([np.concatenate(part) for part in (points, normals, uvs)]))
        self.shapes = self.filled(np.repeat(np.arange(len(meshes)), counts))
        self.ranks = self.filled(np.arange(sum(counts)))
        self.spheres = np.array([_sphere(corners_of(group).reshape(-1, 3)) for group in groups])


def corners_of(group: Group) -> np.ndarray:
    """The faces of a group, (n, 3, 3): the corners of each, m, in the link's frame."""
    return np.concatenate([visual.mesh.vertices[visual.mesh.faces] for visual in group.visuals])


def simplified(faces: np.ndarray, cell: float) -> np.ndarray:
    """Faces (n, 3, 3) whose corners in one cell of a grid have become one: what a shadow map of that resolution shows.

    Args:
        faces: Corners, m.
        cell: Width of the grid, m. Corners alone in their cell stay where they are.
    """
    points = faces.reshape(-1, 3).astype(np.float64)
    _, places = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    places = places.ravel()
    counts = np.bincount(places)
    means = np.stack([np.bincount(places, points[:, axis]) / counts for axis in range(3)], 1)
    corners = places.reshape(-1, 3)
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    first = corners.argmin(1)[:, None]  # the same face may begin at any of its corners
    corners = np.unique(np.take_along_axis(corners, (first + np.arange(3)) % 3, 1), axis=0)
    return means[corners].astype(np.float32)


def _clustered(points: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """An order of faces (F, 3, 3) in which neighbours lie together and look the same way, and where to cut it."""
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    side = np.abs(normals).argmax(1)
    signs = np.take_along_axis(normals, (side[:, None] + np.arange(3)) % 3, 1) > 0
    sector = side * 8 + signs @ [4, 2, 1]  # of 24: the axis that a normal is nearest to, and its octant
    middle = points.mean(1)
    low, high = middle.min(0), middle.max(0)
    cell = np.clip((middle - low) / np.maximum(high - low, 1e-9) * _CELLS, 0, _CELLS - 1).astype(int)
    along = sum(((cell[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(4) for axis in range(3))
    order = np.lexsort((along, sector))
    edges = [0, *(np.flatnonzero(np.diff(sector[order])) + 1).tolist(), len(order)]
    bounds = [start for a, b in pairwise(edges) for start in range(a, b, CLUSTER)]
    return order, [*bounds, len(order)]


def _sphere(points: np.ndarray) -> list[float]:
    """Center (3) and radius of a sphere around points (n, 3)."""
    center = (points.min(0) + points.max(0)) / 2
    return [*center, float(np.linalg.norm(points - center, axis=1).max())]


def _cone(faces: np.ndarray) -> list[float]:
    """A row of `Clusters.cones` from faces (n, 3, 3)."""
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    axis = normals.sum(0)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    cosine = float((normals @ axis).min()) if len(normals) else 1.0
    sine = np.sqrt(max(1 - cosine**2, 0.0)) + 1e-4 if cosine > 0 else 2.0  # the rest is rounding's share
    return [*_sphere(faces.reshape(-1, 3).astype(np.float64)), *axis, sine]
