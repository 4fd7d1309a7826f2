"""CALVIN's two cameras: what they see and where they are. Needs numpy only.

Conventions are OpenCV's. A camera looks along its z axis; x points to the right in the picture and y down. The centre
of the upper left pixel is (0, 0). Depth is the distance along z (m). A pose takes a camera's coordinates to the world's
(m).
"""

from dataclasses import dataclass

import numpy as np

from .calvin import CAMERAS, TCP_POSE

FIELD_OF_VIEW = {"static": 10.0, "gripper": 75.0}
"""Camera to its field of view, degrees, the same in both directions; calvin_env's configuration."""

STATIC_EYE = (2.871459009488717, -2.166602199425597, 2.555159848480571)
STATIC_TARGET = (-0.026242351159453392, -0.0302329882979393, 0.3920000493526459)
STATIC_UP = (0.4041403970338857, 0.22629790978217404, 0.8862616969685161)
"""Where the static camera is, what it looks at (m), and its upward direction; calvin_env's configuration."""

# Both links sit on the hand: joints tcp_joint and camera_joint of calvin_env's panda_longer_finger.urdf.
_TCP_ON_HAND = (0.0, 0.0, 0.14)
_CAMERA_ON_HAND = (-0.1, 0.0, 0.0)
_CAMERA_ROTATION = (1.3, 0.0, -1.57)
# calvin_env's gripper camera looks along its link's y axis, with -z up: x to the right, down and forward, in columns.
_LINK_TO_OPENCV = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Camera:
    """What one camera sees, and from where.

    Attributes:
        name: `"static"` or `"gripper"`.
        size: Width and height of the picture, pixels.
        intrinsics: (3, 3) camera coordinates to homogeneous pixels, (column * z, row * z, z).
        pose: (4, 4) camera coordinates to the world's, m.
    """

    name: str
    size: int
    intrinsics: np.ndarray
    pose: np.ndarray

    def points(self, depth: np.ndarray) -> np.ndarray:
        """What each pixel shows, in world coordinates.

        Args:
            depth: (size, size) m.

        Returns:
            (size, size, 3) float64, m.
        """
        rows, columns = np.indices(depth.shape)
        pixels = np.stack([columns, rows, np.ones(depth.shape)], axis=-1)
        seen = pixels @ np.linalg.inv(self.intrinsics).T * np.asarray(depth, np.float64)[..., None]
        return seen @ self.pose[:3, :3].T + self.pose[:3, 3]


def intrinsics(name: str, size: int | None = None) -> np.ndarray:
    """(3, 3) camera coordinates to homogeneous pixels, of pictures of `size` pixels; the camera's own by default."""
    size = CAMERAS[name] if size is None else size
    focal = size / 2 / np.tan(np.radians(FIELD_OF_VIEW[name]) / 2)
    middle = (size - 1) / 2
    return np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])


def static_camera_pose() -> np.ndarray:
    """(4, 4) the static camera's coordinates to the world's."""
    eye, target, up = (np.array(v) for v in (STATIC_EYE, STATIC_TARGET, STATIC_UP))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return pose


def gripper_camera_pose(robot_obs: np.ndarray) -> np.ndarray:
    """The gripper camera's coordinates to the world's, from states in CALVIN's data or in a dataset.

    The camera sits on the hand as the TCP does, so its pose follows from the TCP's. Forward kinematics from the joints
    would be up to 3 mm off while the arm moves: in CALVIN, pictures and TCP are one simulation step older than joints.

    Args:
        robot_obs: (..., 15).

    Returns:
        (..., 4, 4) float64.
    """
    robot_obs = np.asarray(robot_obs, np.float64)
    hand = _rotation(robot_obs[..., TCP_POSE][..., 3:])
    pose = np.zeros((*robot_obs.shape[:-1], 4, 4))
    pose[..., :3, :3] = hand @ _rotation(np.array(_CAMERA_ROTATION)) @ _LINK_TO_OPENCV
    pose[..., :3, 3] = robot_obs[..., :3] + hand @ np.subtract(_CAMERA_ON_HAND, _TCP_ON_HAND)
    pose[..., 3, 3] = 1.0
    return pose


def _rotation(euler: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of euler angles (..., 3): first about x, then about the fixed y, then z."""
    (a, b, c), (i, j, k) = np.moveaxis(np.cos(euler), -1, 0), np.moveaxis(np.sin(euler), -1, 0)
    rows = [
        [c * b, c * j * i - k * a, c * j * a + k * i],
        [k * b, k * j * i + c * a, k * j * a - c * i],
        [-j, b * i, b * a],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
