"""CALVIN's two cameras; eye, target and field of view are those of calvin_env's configuration."""

from dataclasses import dataclass

import numpy as np
import pybullet as p

from ..calvin import CAMERAS


@dataclass(frozen=True)
class Intrinsics:
    """How a camera sees.

    Attributes:
        size: Width and height of its pictures, pixels.
        fov: Vertical field of view, degrees.
        near, far: Clip planes: what is nearer or farther is not drawn, m.
    """

    size: int
    fov: float
    near: float
    far: float


INTRINSICS = {
    "static": Intrinsics(size=CAMERAS["static"], fov=10.0, near=0.01, far=10.0),
    "gripper": Intrinsics(size=CAMERAS["gripper"], fov=75.0, near=0.01, far=2.0),
}

STATIC_EYE = (2.871459009488717, -2.166602199425597, 2.555159848480571)
STATIC_TARGET = (-0.026242351159453392, -0.0302329882979393, 0.3920000493526459)
STATIC_UP = (0.4041403970338857, 0.22629790978217404, 0.8862616969685161)


def static_view() -> np.ndarray:
    """World to eye of the static camera, (4, 4)."""
    return _look(STATIC_EYE, STATIC_TARGET, STATIC_UP)


def gripper_view(position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """World to eye of the gripper camera, (4, 4), from its link's pose; it looks along the link's +y with -z up.

    Args:
        position: (3,) m, world frame.
        orientation: (4,) quaternion xyzw.
    """
    rotation = np.array(p.getMatrixFromQuaternion(orientation)).reshape(3, 3)
    eye = np.asarray(position)
    return _look(eye, eye + rotation[:, 1], -rotation[:, 2])


def _look(eye: object, target: object, up: object) -> np.ndarray:
    return np.array(p.computeViewMatrix(eye, target, up)).reshape(4, 4).T
