"""The part of an observation that comes from cameras: pictures, depth, and where the cameras are."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from ..calvin import CAMERAS
from ..cameras import gripper_camera_pose, intrinsics, static_camera_pose
from ..desk import DeskError, Observation
from ..pictures import check_size, resize

DEPTH_UNITS = {"m": np.float32(1), "mm": np.float32(1000)}
"""Unit of depth in LeRobot's terms to how many make a metre."""


def depth_key(camera: str) -> str:
    """The observation's name for a camera's depth; LeRobot puts `observation.` before it."""
    return f"images.{camera}_depth"


def camera_keys(camera: str) -> dict[str, int]:
    """The observation's names for a camera's pose and intrinsics, and how many numbers they have."""
    return {f"camera_pose.{camera}": 16, f"camera_intrinsics.{camera}": 9}


@dataclass(frozen=True)
class Pictures:
    """Which pictures an observation holds, and in which form. `CalvinEnv` explains the fields.

    Raises:
        DeskError: A camera or a unit is unknown, or depth or poses are wanted of no camera.
        ValueError: The size is out of range.
    """

    cameras: tuple[str, ...]
    image_size: int = 0
    depth: bool = False
    depth_unit: str = "m"
    camera_poses: bool = False

    def __post_init__(self) -> None:
        for camera in self.cameras:
            if camera not in CAMERAS:
                raise DeskError(f"camera {camera!r} is unknown; choose among {', '.join(CAMERAS)}")
        if (self.depth or self.camera_poses) and not self.cameras:
            wanted = "depth" if self.depth else "camera_poses"
            raise DeskError(f"{wanted} needs cameras, of which there are none: name them, or leave {wanted} out")
        check_size("image_size", self.image_size)
        if self.depth_unit not in DEPTH_UNITS:
            raise DeskError(f"depth_unit {self.depth_unit!r} is unknown; it is 'm' or 'mm'")

    def size(self, camera: str) -> int:
        """Width and height of a camera's pictures, pixels."""
        return self.image_size or CAMERAS[camera]

    def spaces(self) -> dict[str, spaces.Space]:
        """The spaces of what `observe` returns, by name."""
        found: dict[str, spaces.Space] = {}
        sizes = {camera: self.size(camera) for camera in self.cameras}
        if sizes:
            found["pixels"] = spaces.Dict({c: spaces.Box(0, 255, (n, n, 3), np.uint8) for c, n in sizes.items()})
        if self.depth:
            found |= {depth_key(c): spaces.Box(0, np.inf, (1, n, n), np.float32) for c, n in sizes.items()}
        if self.camera_poses:
            numbers = (item for camera in self.cameras for item in camera_keys(camera).items())
            found |= {key: spaces.Box(-np.inf, np.inf, (count,), np.float32) for key, count in numbers}
        return found

    def observe(self, obs: Observation) -> dict[str, Any]:
        """The pictures of one of the desk's observations, which has the cameras' own sizes and depth in metres."""
        found: dict[str, Any] = {}
        if self.cameras:
            found["pixels"] = {camera: resize(obs[f"rgb_{camera}"], self.size(camera)) for camera in self.cameras}
        for camera in self.cameras:
            if self.depth:
                depth = resize(obs[f"depth_{camera}"], self.size(camera))
                found[depth_key(camera)] = depth[None] * DEPTH_UNITS[self.depth_unit]
            if self.camera_poses:
                pose = static_camera_pose() if camera == "static" else gripper_camera_pose(obs["robot_obs"])
                matrices = pose, intrinsics(camera, self.size(camera))
                found |= {
                    key: matrix.ravel().astype(np.float32)
                    for key, matrix in zip(camera_keys(camera), matrices, strict=True)
                }
        return found
