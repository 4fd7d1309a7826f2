"""Where the cameras of a converted dataset must be: what `lansar-verify` compares its matrices with.

It is worked out here in another way than by the converter, which would hide its own errors: the hand's links one after
the other, and for the static camera from where it is, what it looks at and what is up.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from dataset_convert.verify_claims import Dataset
from lerobot_lansar.cameras import FIELD_OF_VIEW, STATIC_EYE, STATIC_TARGET, STATIC_UP


def camera_matrices(dataset: Dataset, robot_obs: np.ndarray) -> dict[str, np.ndarray]:
    """The poses (n, 4, 4) and intrinsics (n, 3, 3) that a dataset's columns must hold, for n frames."""
    sizes = dataset.camera_sizes()
    if not sizes:
        return {}
    poses = {"static": np.repeat(static_pose()[None], len(robot_obs), axis=0), "gripper": gripper_poses(robot_obs)}
    found = {"calvin.gripper_camera_pose": poses["gripper"]}
    if dataset.manifest["request"].get("camera_poses"):
        for camera, size in sizes.items():
            found[f"observation.camera_pose.{camera}"] = poses[camera]
            matrix = camera_intrinsics(camera, size)[None]
            found[f"observation.camera_intrinsics.{camera}"] = np.repeat(matrix, len(robot_obs), axis=0)
    return found


def camera_intrinsics(camera: str, size: int) -> np.ndarray:
    """(3, 3): what lies at half the field of view falls on the picture's edge, half a pixel beyond the last centre."""
    edge = np.tan(np.radians(FIELD_OF_VIEW[camera] / 2))
    scale = (size / 2) / edge
    return np.array([[scale, 0, size / 2 - 0.5], [0, scale, size / 2 - 0.5], [0, 0, 1]])


def static_pose() -> np.ndarray:
    """(4, 4) of the static camera: its z axis towards the target, its y axis as far down as it gets."""
    forward = np.subtract(STATIC_TARGET, STATIC_EYE)
    rotation, _ = Rotation.align_vectors([forward, -np.array(STATIC_UP)], [[0, 0, 1], [0, 1, 0]], weights=[np.inf, 1])
    return _pose(rotation.as_matrix(), np.array(STATIC_EYE))


def gripper_poses(robot_obs: np.ndarray) -> np.ndarray:
    """(n, 4, 4) of the gripper camera: from the TCP back to the hand, on to the camera's link, into OpenCV's axes."""
    tcp = _pose(Rotation.from_euler("xyz", robot_obs[:, 3:6]).as_matrix(), robot_obs[:, :3])
    tcp_on_hand = _pose(np.eye(3), np.array([0, 0, 0.14]))
    link_on_hand = _pose(Rotation.from_euler("xyz", [1.3, 0, -1.57]).as_matrix(), np.array([-0.1, 0, 0]))
    axes = _pose(np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]), np.zeros(3))  # right -x, down z, forward y of the link
    return tcp @ np.linalg.inv(tcp_on_hand) @ link_on_hand @ axes


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    pose = np.zeros((*position.shape[:-1], 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, position, 1
    return pose


def check_cameras(dataset: Dataset) -> str | None:
    """How the manifest's cameras differ from what they must be, in words; None if they do not."""
    told, sizes = dict(dataset.manifest["cameras"]), dataset.camera_sizes()
    told.pop("convention", None)
    if set(told) != set(sizes):
        return f"cameras {sorted(told)}, expected {sorted(sizes)}"
    for camera, size in sizes.items():
        pose = static_pose() if camera == "static" else None
        of = told[camera]
        is_pose = of["pose"] == "calvin.gripper_camera_pose" if pose is None else np.allclose(of["pose"], pose)
        if of["size"] != size or not np.allclose(of["intrinsics"], camera_intrinsics(camera, size)) or not is_pose:
            return f"cameras: {camera} is {of}"
    return None
