"""Where the links of a body are, from its joints alone.

Asking Bullet for up-to-date link poses would change the TCP pose that it reports to `robot_obs`, which must be one
simulation step old, as in CALVIN. So the renderer computes them itself.
"""

from collections.abc import Sequence

import numpy as np
import pybullet as p
from numba import njit

from .visuals import transform


class Links:
    """The joints of one body as fixed transforms.

    Attributes:
        moving: Joints that move, in the order in which `poses` takes their positions.
    """

    def __init__(self, client: int, body: int):
        count = p.getNumJoints(body, physicsClientId=client)
        infos = [p.getJointInfo(body, joint, physicsClientId=client) for joint in range(count)]
        kinds = {p.JOINT_REVOLUTE: 1, p.JOINT_PRISMATIC: 2}
        self._kinds = np.array([kinds.get(info[2], 0) for info in infos], np.int64)
        self._axes = np.array([info[13] for info in infos], np.float64).reshape(-1, 3)
        self._parents = np.array([info[16] for info in infos], np.int64)
        inertial = [self._inertial(client, body, link) for link in range(-1, count)]
        # Bullet gives a joint's frame relative to its parent's inertial frame, with the rotation inverted
        self._joints = np.array(
            [inertial[info[16] + 1] @ transform(info[14], p.invertTransform((0, 0, 0), info[15])[1]) for info in infos]
        ).reshape(-1, 4, 4)
        base = transform(*p.getBasePositionAndOrientation(body, physicsClientId=client))
        self._base = base @ np.linalg.inv(inertial[0])
        self.moving = [joint for joint in range(count) if self._kinds[joint]]

    def moves(self, link: int) -> bool:
        """Whether any joint between the base and `link` can move."""
        while link >= 0:
            if self._kinds[link]:
                return True
            link = int(self._parents[link])
        return False

    @staticmethod
    def _inertial(client: int, body: int, link: int) -> np.ndarray:
        info = p.getDynamicsInfo(body, link, physicsClientId=client)
        return transform(info[3], info[4])

    def poses(self, positions: Sequence[float]) -> np.ndarray:
        """URDF frames of the base and of every link in world coordinates.

        Args:
            positions: One number (rad or m) per joint in `moving`.

        Returns:
            (1 + links, 4, 4) float64; row 0 is the base.
        """
        values = np.zeros(len(self._kinds))
        values[self.moving] = positions
        return _forward(self._base, self._joints, self._parents, self._kinds, self._axes, values)


@njit(cache=True)
def _forward(base, joints, parents, kinds, axes, values):  # type: ignore[no-untyped-def]
    poses = np.empty((len(parents) + 1, 4, 4))
    poses[0] = base
    for link in range(len(parents)):
        motion = np.eye(4)
        x, y, z = axes[link]
        q = values[link]
        if kinds[link] == 1:
            c, s = np.cos(q), np.sin(q)
            d = 1 - c
            motion[0, :3] = c + d * x * x, d * x * y - s * z, d * x * z + s * y
            motion[1, :3] = d * x * y + s * z, c + d * y * y, d * y * z - s * x
            motion[2, :3] = d * x * z - s * y, d * y * z + s * x, c + d * z * z
        elif kinds[link] == 2:
            motion[:3, 3] = x * q, y * q, z * q
        poses[link + 1] = poses[parents[link] + 1] @ joints[link] @ motion
    return poses
