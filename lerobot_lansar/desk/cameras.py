"""CALVIN's two cameras and the pictures they take (``spec``: eye, target, field of view of calvin_env's config)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet as p

from .errors import DeskError


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera: picture size (pixels, square), vertical field of view (degrees), clip planes (m)."""

    size: int
    fov: float
    near: float
    far: float


CAMERAS = {
    "static": Camera(size=200, fov=10.0, near=0.01, far=10.0),
    "gripper": Camera(size=84, fov=75.0, near=0.01, far=2.0),
}

STATIC_EYE = (2.871459009488717, -2.166602199425597, 2.555159848480571)
STATIC_TARGET = (-0.026242351159453392, -0.0302329882979393, 0.3920000493526459)
STATIC_UP = (0.4041403970338857, 0.22629790978217404, 0.8862616969685161)


def static_view() -> tuple[float, ...]:
    """View matrix of the static camera, column-major, 16 numbers."""
    return tuple(p.computeViewMatrix(STATIC_EYE, STATIC_TARGET, STATIC_UP))


def gripper_view(position: np.ndarray, orientation: np.ndarray) -> tuple[float, ...]:
    """View matrix of the gripper camera from its link's pose: it looks along the link's +y axis with -z up.

    Args:
        position: (3,) m, world frame.
        orientation: (4,) quaternion xyzw.
    """
    rotation = np.array(p.getMatrixFromQuaternion(orientation)).reshape(3, 3)
    eye = np.asarray(position)
    return tuple(p.computeViewMatrix(eye, eye + rotation[:, 1], -rotation[:, 2]))


def take_picture(client: int, camera: Camera, view: tuple[float, ...], size: int | None = None) -> np.ndarray:
    """An RGB picture by TinyRenderer: (size, size, 3) uint8."""
    size = size or camera.size
    return _render(client, camera, view, size)[..., :3]


def _render(client: int, camera: Camera, view: tuple[float, ...], size: int) -> np.ndarray:
    if not p.isNumpyEnabled():
        raise DeskError(
            "this pybullet was built without numpy, so its cameras return Python tuples and are many times slower. "
            "Reinstall it with numpy present: `make install` in this package's checkout, or "
            "`pip install numpy setuptools wheel && pip install --no-build-isolation --no-binary pybullet "
            "--force-reinstall --no-cache-dir pybullet==3.2.7`"
        )
    projection = p.computeProjectionMatrixFOV(camera.fov, 1.0, camera.near, camera.far)
    image: Any = p.getCameraImage(
        size, size, view, projection, renderer=p.ER_TINY_RENDERER, physicsClientId=client
    )
    return np.asarray(image[2], dtype=np.uint8).reshape(size, size, 4)
