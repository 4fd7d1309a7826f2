"""Where the cameras of a dataset are, and what they see: columns of its frames, and an entry of its manifest.

Conventions are those of `lerobot_lansar.cameras`, OpenCV's. Matrices in columns are written row by row.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from lerobot_lansar.cameras import gripper_camera_pose, intrinsics, static_camera_pose

GRIPPER_POSE = "calvin.gripper_camera_pose"
"""The column with the gripper camera's pose, a 4x4 matrix."""

_CONVENTION = (
    "OpenCV: x to the right in the picture, y down, z forward; the centre of the upper left pixel is (0, 0); a pose "
    "takes camera coordinates to the world's (m); matrices in columns row by row"
)


def pose_columns(robot_obs: np.ndarray, sizes: dict[str, int], as_observations: bool) -> dict[str, np.ndarray]:
    """The columns that say where the cameras are.

    Args:
        robot_obs: (n, 15).
        sizes: Camera to the width and height of its pictures in the dataset.
        as_observations: Add what the environment observes with `--env.camera_poses=true`, under the same names.

    Returns:
        Column to (n, 16) poses or (n, 9) intrinsics; none for a dataset without pictures.
    """
    if not sizes:
        return {}
    poses = {"static": np.broadcast_to(static_camera_pose(), (len(robot_obs), 4, 4))}
    poses["gripper"] = gripper_camera_pose(robot_obs)
    columns = {GRIPPER_POSE: poses["gripper"]}
    if as_observations:
        for camera, size in sizes.items():
            columns[f"observation.camera_pose.{camera}"] = poses[camera]
            columns[f"observation.camera_intrinsics.{camera}"] = np.broadcast_to(
                intrinsics(camera, size), (len(robot_obs), 3, 3)
            )
    return {key: matrices.reshape(len(robot_obs), -1) for key, matrices in columns.items()}


def pose_features(cameras: Iterable[str], as_observations: bool) -> dict[str, int]:
    """The names of these columns, and how many numbers they have."""
    sizes = dict.fromkeys(cameras, 1)
    return {key: rows.shape[1] for key, rows in pose_columns(np.zeros((1, 15)), sizes, as_observations).items()}


def describe_cameras(sizes: dict[str, int]) -> dict[str, Any]:
    """What the manifest says of the cameras.

    Args:
        sizes: Camera to the width and height of its pictures in the dataset.
    """
    if not sizes:
        return {}
    poses: dict[str, Any] = {"static": static_camera_pose().tolist(), "gripper": GRIPPER_POSE}
    cameras = {
        camera: {"size": size, "intrinsics": intrinsics(camera, size).tolist(), "pose": poses[camera]}
        for camera, size in sizes.items()
    }
    return {"convention": _CONVENTION, **cameras}
