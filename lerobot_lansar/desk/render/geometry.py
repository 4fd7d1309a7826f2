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


class Geometry:
    """Arrays over K clusters and F = K * CLUSTER faces; face `f` is number `f % CLUSTER` of cluster `f // CLUSTER`.

    Args:
        groups: Whose visuals these are.

    Attributes:
        corners: (K, 9, CLUSTER) float32: x, y, z of the first corners, of the second and of the third, m, in the
            link's frame.
        normals: (F, 3, 3) float32 unit normal of each corner. uvs: (F, 3, 2) float32 texture coordinates.
        shapes: (F,) int32 number of the visual that a face belongs to.
        ranks: (F,) int32 place of a face in the order in which Bullet draws them.
        cones: (K, 8) float64: center (3) and radius (m) of a cluster, the direction that its faces look in (3), and
            the sine of the largest angle between that and a face's normal (2 where that is no use).
        ranges: (G, 2) int64 first cluster of each group, and the one after its last. spheres: (G, 4) center, radius.
    """

    def __init__(self, groups: Sequence[Group]):
        corners: list[np.ndarray] = []
        normals: list[np.ndarray] = []
        uvs: list[np.ndarray] = []
        shapes: list[np.ndarray] = []
        ranks: list[np.ndarray] = []
        cones: list[list[float]] = []
        spheres: list[list[float]] = []
        ends, shape, rank = [0], 0, 0
        for group in groups:
            meshes = [visual.mesh for visual in group.visuals]
            points = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
            order, bounds = _clustered(points)
            owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]) + shape
            places = np.concatenate([np.arange(b - a) + CLUSTER * k for k, (a, b) in enumerate(pairwise(bounds))])
            size = CLUSTER * (len(bounds) - 1)
            for rows, values in (
                (corners, points),
                (normals, np.concatenate([mesh.normals for mesh in meshes])),
                (uvs, np.concatenate([mesh.uvs for mesh in meshes])),
                (shapes, owner),
                (ranks, np.arange(len(order)) + rank),
            ):
                padded = np.zeros((size, *values.shape[1:]), np.float32 if values.dtype.kind == "f" else np.int32)
                padded[places] = values[order]
                rows.append(padded)
            cones += [_cone(points[order[a:b]]) for a, b in pairwise(bounds)]
            low, high = points.min((0, 1)), points.max((0, 1))
            spheres.append([*(low + high) / 2, float(np.linalg.norm(high - low)) / 2])
            ends.append(len(cones))
            shape, rank = shape + len(meshes), rank + len(order)
        flat = np.concatenate(corners).reshape(-1, CLUSTER, 9)
        self.corners = np.ascontiguousarray(flat.transpose(0, 2, 1))
        self.normals, self.uvs = np.concatenate(normals), np.concatenate(uvs)
        self.shapes, self.ranks = np.concatenate(shapes), np.concatenate(ranks)
        self.cones, self.spheres = np.array(cones), np.array(spheres)
        self.ranges = np.array(list(pairwise(ends)))


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


def _cone(points: np.ndarray) -> list[float]:
    """A row of `Geometry.cones` from faces (n, 3, 3)."""
    corners = points.reshape(-1, 3).astype(np.float64)
    center = (corners.min(0) + corners.max(0)) / 2
    radius = float(np.linalg.norm(corners - center, axis=1).max())
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    axis = normals.sum(0)
    axis /= max(float(np.linalg.norm(axis)), 1e-9)
    cosine = float((normals @ axis).min()) if len(normals) else 1.0
    sine = np.sqrt(max(1 - cosine**2, 0.0)) + 1e-4 if cosine > 0 else 2.0  # the rest is rounding's share
    return [*center, radius, *axis, sine]
