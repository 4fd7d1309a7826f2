"""CALVIN's two cameras as the renderers need them. `lerobot_lansar.cameras` says where they are."""

from dataclasses import dataclass

import numpy as np
import pybullet as p

from ..cameras import FIELD_OF_VIEW, STATIC_EYE, STATIC_TARGET, STATIC_UP


@dataclass(frozen=True)
class Intrinsics:
    """How a camera sees.

    Attributes:
        fov: Vertical field of view, degrees.
        near, far: Clip planes: what is nearer or farther is not drawn, m.
    """

    fov: float
    near: float
    far: float


INTRINSICS = {
    "static": Intrinsics(fov=FIELD_OF_VIEW["static"], near=0.01, far=10.0),
    "gripper": Intrinsics(fov=FIELD_OF_VIEW["gripper"], near=0.01, far=2.0),
}


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
