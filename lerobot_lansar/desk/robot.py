"""The Panda arm: loading, CALVIN's inverse kinematics and position control, and the 15 numbers of `robot_obs`."""

from typing import Any

import numpy as np
import pybullet as p

from ..calvin import ANGLE_UNIT, ARM_JOINTS, GRIPPER_ACTION, GRIPPER_WIDTH, POSITION_UNIT
from .assets import Assets

BASE_POSITION = (-0.34, -0.46, 0.24)
HOME_JOINTS = (-1.21779206, 1.03987646, 2.11978261, -2.34205014, -0.87015947, 1.64119353, 0.55344866)
ARM = tuple(range(7))
FINGERS = (9, 11)
TCP_LINK = 15
CAMERA_LINK = 14
"""Bullet's joint and link indices, the same with both kinds of assets."""
FINGER_OPEN = 0.04
"""Joint value of each finger when the hand is open (m)."""
ARM_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
ARM_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""The arm's joint limits (rad)."""

_IK = {
    "lowerLimits": [-7.0] * 9,
    "upperLimits": [7.0] * 9,
    "jointRanges": [7.0] * 9,
    "restPoses": [*HOME_JOINTS, FINGER_OPEN, FINGER_OPEN],
}


class Robot:
    """The arm in one Bullet client.

    Attributes:
        body: Bullet body id.
        gripper_action: The last gripper command, -1 (close) or +1 (open).
    """

    def __init__(self, client: int, assets: Assets):
        self.client = client
        self.body = p.loadURDF(
            str(assets.robot), BASE_POSITION, (0, 0, 0, 1), useFixedBase=True, physicsClientId=client
        )
        gear = p.createConstraint(
            self.body,
            FINGERS[0],
            self.body,
            FINGERS[1],
            jointType=p.JOINT_GEAR,
            jointAxis=[1, 0, 0],
            parentFramePosition=[0, 0, 0],
            childFramePosition=[0, 0, 0],
            physicsClientId=client,
        )
        p.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=50, physicsClientId=client)
        x, y, height = BASE_POSITION
        pedestal = p.createVisualShape(
            p.GEOM_CYLINDER, radius=0.13, length=height, rgbaColor=(1, 1, 1, 1), physicsClientId=client
        )
        p.createMultiBody(
            baseVisualShapeIndex=pedestal,
            basePosition=(x - 0.05, y, height / 2),
            physicsClientId=client,
        )
        self.gripper_action = 1.0
        self._target_position: np.ndarray = np.zeros(3)
        self._target_euler: np.ndarray = np.zeros(3)

    def reset(self, robot_obs: np.ndarray | None) -> None:
        """Sets the arm's joints and half the opening width for each finger; the TCP part of `robot_obs` is ignored.

        The target that relative actions move starts at the resulting TCP pose.
        """
        joints = HOME_JOINTS if robot_obs is None else robot_obs[ARM_JOINTS]
        finger = FINGER_OPEN if robot_obs is None else robot_obs[GRIPPER_WIDTH] / 2
        self.gripper_action = 1.0 if robot_obs is None or robot_obs[GRIPPER_ACTION] > 0 else -1.0
        for joint, value in zip(ARM, joints, strict=True):
            p.resetJointState(self.body, joint, value, physicsClientId=self.client)
            self._drive(joint, value, force=200, max_velocity=2)
        for joint in FINGERS:
            p.resetJointState(self.body, joint, finger, physicsClientId=self.client)
            self._drive(joint, finger, force=200, max_velocity=1)
        position, orientation = self.tcp_pose()
        self._target_position = np.array(position)
        self._target_euler = np.array(p.getEulerFromQuaternion(orientation))

    def command(self, action: np.ndarray, relative: bool) -> None:
        """Sets the motors' targets from an action (7,).

        A relative action moves a target pose that is kept from step to step and never set back to the arm's pose.
        """
        if relative:
            self._target_position += action[:3] * POSITION_UNIT
            self._target_euler += action[3:6] * ANGLE_UNIT
            pose = self._target_position, self._target_euler
        else:
            pose = action[:3], action[3:6]
        self.gripper_action = 1.0 if action[6] > 0 else -1.0
        for joint, value in zip(ARM, self.joints_for(*pose), strict=True):
            self._drive(joint, value, force=200, max_velocity=2)
        opening = self.gripper_action > 0
        for joint in FINGERS:
            self._drive(joint, FINGER_OPEN if opening else 0.0, force=2 if opening else 200, max_velocity=1)

    def joints_for(self, position: np.ndarray, euler: np.ndarray) -> np.ndarray:
        """Arm joints (7,) rad for a TCP pose: one call of Bullet's null-space IK, clipped to the joint limits."""
        solution = p.calculateInverseKinematics(
            self.body,
            TCP_LINK,
            position,
            p.getQuaternionFromEuler(euler),
            physicsClientId=self.client,
            **_IK,
        )
        return np.clip(solution[: len(ARM)], ARM_LOWER, ARM_UPPER)

    def _drive(self, joint: int, target: float, force: float, max_velocity: float) -> None:
        p.setJointMotorControl2(
            bodyIndex=self.body,
            jointIndex=joint,
            controlMode=p.POSITION_CONTROL,
            force=force,
            targetPosition=target,
            maxVelocity=max_velocity,
            physicsClientId=self.client,
        )

    def tcp_pose(self) -> tuple[Any, Any]:
        """TCP position (3,) m and quaternion xyzw (4,); in motion one simulation step old, as in CALVIN."""
        return p.getLinkState(self.body, TCP_LINK, physicsClientId=self.client)[:2]

    def camera_pose(self) -> tuple[Any, Any]:
        """Position (3,) m and quaternion xyzw (4,) of the gripper camera's link, as old as `tcp_pose`."""
        return p.getLinkState(self.body, CAMERA_LINK, physicsClientId=self.client)[:2]

    def observe(self) -> np.ndarray:
        """`robot_obs`: TCP xyz, TCP euler, opening width, seven arm joints, last gripper action; (15,) float64."""
        position, orientation = self.tcp_pose()
        states = p.getJointStates(self.body, ARM + FINGERS, physicsClientId=self.client)
        *arm, left, right = (state[0] for state in states)
        euler = p.getEulerFromQuaternion(orientation)
        return np.array([*position, *euler, left + right, *arm, self.gripper_action])
