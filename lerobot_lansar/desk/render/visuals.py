"""What the bodies of a Bullet client look like: triangles, colours and textures."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as p
import trimesh
from scipy.spatial import ConvexHull
from trimesh.exchange.obj import load_obj
from trimesh.exchange.stl import HeaderError, load_stl_binary

from ..errors import DeskError

_CYLINDER_SIDES = 32  # Bullet draws a cylinder as a prism, keeps one of its corners for each of _directions ...
_MARGIN = 0.001  # ... and moves it outwards by this (m)


@dataclass(frozen=True)
class Mesh:
    """Triangles of one shape.

    Attributes:
        vertices: (V, 3) float32 positions, m.
        faces: (F, 3) int32 rows of `vertices`, counter-clockwise seen from outside.
        normals: (F, 3, 3) float32 unit normal of each corner.
        uvs: (F, 3, 2) float32 texture coordinates of each corner, v upwards.
        texture: (height, width, 3) uint8 with row 0 on top, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    texture: np.ndarray | None = None

    def placed(self, scale: np.ndarray, frame: np.ndarray) -> "Mesh":
        """The mesh scaled by (3,) and then moved by the rigid transform `frame` (4, 4)."""
        vertices = (self.vertices * scale) @ frame[:3, :3].T + frame[:3, 3]
        normals = self.normals @ frame[:3, :3].T
        return Mesh(vertices.astype(np.float32), self.faces, normals.astype(np.float32), self.uvs, self.texture)


@dataclass(frozen=True)
class Visual:
    """A shape fixed to a link.

    Attributes:
        body, link: Bullet's ids; link -1 is the body's base.
        mesh: In the link's URDF frame.
        color: (4,) rgba, 0 to 1, multiplied with the texture.
    """

    body: int
    link: int
    mesh: Mesh
    color: tuple[float, ...]


def read_visuals(client: int, round_boxes: bool = False) -> list[Visual]:
    """All visual shapes of all bodies of a Bullet client, in the order in which Bullet draws them.

    Args:
        client: Bullet client.
        round_boxes: Whether boxes are lit as if they were round, as the EGL plugin does.

    Raises:
        DeskError: A shape is of an unknown kind, or a mesh file cannot be read.
    """
    visuals = []
    for index in range(p.getNumBodies(physicsClientId=client)):
        body = p.getBodyUniqueId(index, physicsClientId=client)
        for shape in p.getVisualShapeData(body, physicsClientId=client):
            _, link, kind, size, file, position, orientation, color = shape[:8]
            mesh, scale = _shape(kind, size, file.decode(), round_boxes)
            visuals.append(Visual(body, link, mesh.placed(scale, transform(position, orientation)), color))
    return visuals


def transform(position: Any, orientation: Any) -> np.ndarray:
    """(4, 4) rigid transform from a position (3,) and a quaternion xyzw (4,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(p.getMatrixFromQuaternion(orientation), (3, 3))
    matrix[:3, 3] = position
    return matrix


def _shape(kind: int, size: tuple[float, ...], file: str, round_boxes: bool) -> tuple[Mesh, np.ndarray]:
    """The shape's mesh and the scale (3,) to apply to it."""
    one = np.ones(3)
    if kind == p.GEOM_MESH:
        return load_mesh(file), np.array(size)
    if kind == p.GEOM_BOX and round_boxes:
        return _hull(_box().vertices * size), one
    if kind == p.GEOM_BOX:
        return _box(), np.array(size)
    if kind == p.GEOM_SPHERE:
        return _hull(_directions() * size[0]), one
    if kind == p.GEOM_CYLINDER:
        length, radius = size[:2]
        angles = 2 * np.pi * np.arange(_CYLINDER_SIDES) / _CYLINDER_SIDES
        ring = np.stack([radius * np.sin(angles), radius * np.cos(angles)], 1)
        corners = np.concatenate([np.insert(ring, 2, z, 1) for z in (length / 2, -length / 2)])
        return _hull(corners[(_directions() @ corners.T).argmax(1)] + _MARGIN * _directions()), one
    raise DeskError(
        f"a visual shape of Bullet's kind {kind} cannot be drawn; choose renderer pybullet_tiny or pybullet_gl"
    )


@cache
def load_mesh(file: str) -> Mesh:
    """A mesh from an OBJ file, with the texture that its material names, or from a binary STL file.

    Raises:
        DeskError: The file is of another kind, or cannot be read.
    """
    path = Path(file)
    if path.suffix.lower() == ".obj":
        return _load_obj(path)
    if path.suffix.lower() == ".stl":
        return _load_stl(path)
    raise DeskError(f"{file}: expected an .obj or .stl mesh; choose renderer pybullet_tiny or pybullet_gl for others")


class _Neighbours(trimesh.resolvers.FilePathResolver):
    """Reads the files that a mesh names relative to its folder, even those outside that folder."""

    def get(self, name: str) -> bytes:
        return (Path(self.parent) / name.strip()).read_bytes()


def _load_obj(path: Path) -> Mesh:
    try:
        with path.open() as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # about pieces without texture coordinates
            loaded = load_obj(file, resolver=_Neighbours(str(path)), group_material=False)
    except (OSError, ValueError, IndexError) as error:
        raise DeskError(f"{path} cannot be read as OBJ: {error}") from error
    # reversed into the file's order, which decides which one of two coinciding faces is seen
    pieces = list(loaded["geometry"].values())[::-1] if "geometry" in loaded else [loaded]
    pieces = [piece for piece in pieces if len(piece.get("faces", ()))]
    if not pieces:
        raise DeskError(f"{path} holds no faces; is it a Git LFS pointer instead of the file?")
    faces, points, normals, uvs, count = [], [], [], [], 0
    for piece in pieces:
        corners, vertices = np.asarray(piece["faces"]), np.asarray(piece["vertices"], np.float32)
        if "vertex_normals" in piece:
            normals.append(_unit(np.asarray(piece["vertex_normals"], np.float32)[corners]))
        else:
            normals.append(_flat(_face_normals(vertices, corners)))
        given = getattr(piece.get("visual"), "uv", None)
        uvs.append(given[corners] if given is not None else np.full((*corners.shape, 2), 0.5))
        points.append(vertices)
        faces.append(corners + count)
        count += len(vertices)
    vertices, places = _merged(np.concatenate(points), np.concatenate(faces))
    return Mesh(
        vertices,
        places,
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
        _texture(pieces),
    )


def _texture(pieces: Sequence[dict[str, Any]]) -> np.ndarray | None:
    """The image of the first material that has one; Bullet applies it to the whole mesh."""
    for piece in pieces:
        image = getattr(getattr(piece.get("visual"), "material", None), "image", None)
        if image is not None:
            return _shared(image.width, image.height, image.convert("RGB").tobytes())
    return None


@cache
def _shared(width: int, height: int, pixels: bytes) -> np.ndarray:
    """One array for all equal images."""
    return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)


def _load_stl(path: Path) -> Mesh:
    try:
        with path.open("rb") as file:
            loaded = load_stl_binary(file)
    except (OSError, HeaderError) as error:
        raise DeskError(f"{path} cannot be read as binary STL: {error}") from error
    if "faces" not in loaded:
        raise DeskError(f"{path} holds no faces")
    vertices, faces = _merged(loaded["vertices"], loaded["faces"])
    return Mesh(vertices, faces, _flat(_unit(loaded["face_normals"])), _no_uvs(faces))


@cache
def _box() -> Mesh:
    """A cube of side 1 around the origin."""
    box = trimesh.creation.box()
    faces = box.faces.astype(np.int32)
    return Mesh(box.vertices.astype(np.float32), faces, _flat(box.face_normals.astype(np.float32)), _no_uvs(faces))


@cache
def _directions() -> np.ndarray:
    """Directions (42, 3) in which Bullet looks for a round shape's corners: an icosahedron's corners and edges."""
    angles = np.arange(5) * 2 * np.pi / 5
    height, radius = 1 / np.sqrt(5), 2 / np.sqrt(5)
    ring = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(5, height)], 1)
    corners = np.concatenate([[[0, 0, 1]], ring, -ring, [[0, 0, -1]]])
    # an edge is 1.05 long
    edges = [a + b for i, a in enumerate(corners) for b in corners[:i] if np.linalg.norm(a - b) < 1.1]
    return _unit(np.concatenate([corners, edges]))


def _hull(points: np.ndarray) -> Mesh:
    """Convex hull of points around the origin, with normals that point away from it, as Bullet draws round shapes."""
    points = np.unique(points.astype(np.float32), axis=0)
    faces = ConvexHull(points).simplices.astype(np.int32)
    inward = (_face_normals(points, faces) * points[faces].mean(1)).sum(1) < 0
    faces[inward] = faces[inward, ::-1]
    return Mesh(points, faces, _unit(points)[faces], _no_uvs(faces))


def _merged(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merges equal points into one vertex; vertices come in the order in which faces use them, for cache locality."""
    vertices, first, places = np.unique(points[faces.ravel()], axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    order = np.argsort(first)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return vertices[order].astype(np.float32), rank[places.ravel()].reshape(-1, 3)


def _flat(normals: np.ndarray) -> np.ndarray:
    """A face's normal (F, 3) for each of its corners: (F, 3, 3)."""
    return np.repeat(normals[:, None], 3, axis=1)


def _no_uvs(faces: np.ndarray) -> np.ndarray:
    """Texture coordinates for faces without texture: (F, 3, 2) float32."""
    return np.full((len(faces), 3, 2), 0.5, np.float32)


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return _unit(np.cross(b - a, c - a))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors scaled to length 1 along the last axis; zero vectors stay."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)
