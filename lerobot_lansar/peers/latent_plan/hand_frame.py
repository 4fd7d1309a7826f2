"""HULC's actions in the frame of the hand: relative actions turned into it for the loss, and back for the robot.

The angles are read as the original does, as rotations about the moving axes x, y, z. CALVIN's are rotations about fixed
axes, so with the hand pointing down this frame is turned by the yaw in the other direction than the hand is. It is a
frame all the same: one turns into the other and back, which the tests check.
"""

import torch
from torch import Tensor

from ...calvin import wrap_angle

SMALL = 0.01
"""Turns are made so much smaller before they are carried from one frame to the other, since only small ones add up."""


def rotation(euler: Tensor) -> Tensor:
    """Rotations about moving axes x, y, z: (..., 3) rad -> (..., 3, 3)."""
    (sx, sy, sz), (cx, cy, cz) = (f(euler).unbind(-1) for f in (torch.sin, torch.cos))
    rows = [
        torch.stack([cy * cz, -cy * sz, sy], dim=-1),
        torch.stack([cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy], dim=-1),
        torch.stack([sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def angles(rotations: Tensor) -> Tensor:
    """The inverse of `rotation`: (..., 3, 3) -> (..., 3) rad, the second in [-pi/2, pi/2]."""
    r = rotations
    x = torch.atan2(-r[..., 1, 2], r[..., 2, 2])
    y = torch.asin(r[..., 0, 2].clamp(-1, 1))
    z = torch.atan2(-r[..., 0, 1], r[..., 0, 0])
    return torch.stack([x, y, z], dim=-1)


def to_hand(actions: Tensor, state: Tensor) -> Tensor:
    """Relative actions (..., 7) of the world in the frame of the hand.

    Args:
        actions: In units of (0.02 m, 0.05 rad); the gripper's command stays.
        state: robot_obs, (..., 15).
    """
    actions, euler = actions.float(), state[..., 3:6].float()
    with torch.autocast(actions.device.type, enabled=False):  # a hundredth of a turn is lost in bfloat16
        hand = rotation(euler)
        position = (hand.mT @ actions[..., :3, None])[..., 0]
        turn = angles(rotation(euler + SMALL * actions[..., 3:6]).mT @ hand)
    return torch.cat([position, wrap_angle(turn) / SMALL, actions[..., 6:]], dim=-1)


def to_world(actions: Tensor, state: Tensor) -> Tensor:
    """The inverse of `to_hand`."""
    actions, euler = actions.float(), state[..., 3:6].float()
    with torch.autocast(actions.device.type, enabled=False):
        hand = rotation(euler)
        position = (hand @ actions[..., :3, None])[..., 0]
        turned = angles(hand @ rotation(SMALL * actions[..., 3:6]).mT)
    return torch.cat([position, wrap_angle(turned - euler) / SMALL, actions[..., 6:]], dim=-1)
