"""Scales what the network reads and predicts to order one (Eq 4.7), after encoding orientations."""

import torch
from torch import Tensor, nn

from ..calvin import BLOCKS, COLORS, FURNITURE, FURNITURE_NAMES, ROBOT_OBS_NAMES, SCENE_OBS_NAMES, TCP_POSE

STATE_DIM = len(ROBOT_OBS_NAMES)
"""Numbers in CALVIN's `robot_obs`."""
ENVIRONMENT_STATE_DIM = len(SCENE_OBS_NAMES)
"""Numbers in CALVIN's `scene_obs`: furniture, then blocks."""
SCENE_DIM = len(FURNITURE_NAMES)
DELTA_DIM = 6
"""Numbers in a motion: position (m) and orientation (rad) difference."""

INPUT_FLOOR = 1e-2
"""Smallest standard deviation of an input, in its own unit (m or rad). A column that hardly moves in the data (a button
that nobody pressed) would otherwise be divided by that of noise, and its first real movement would be huge."""
DELTA_FLOOR = 1e-3
"""The same for motions."""
NEAR = 0.05
"""Distance from the TCP (m) within which a block's relative position is also given with finer resolution."""


def encoded_sizes(orientation: str, egocentric_blocks: bool, since_command: bool) -> tuple[int, int, int]:
    """How many numbers a robot state, a block and the scene have after `Scaler.encode`."""
    extra = 3 if orientation == "sincos" else 0
    block = 6 + extra + (6 if egocentric_blocks else 0) + (9 if since_command else 0)
    return STATE_DIM + extra, block, SCENE_DIM * (2 if since_command else 1)


class Scaler(nn.Module):
    """Means and standard deviations of everything that is scaled; buffers, so the checkpoint holds them.

    Binary values (gripper action, lights) keep mean 0 and standard deviation 1. Before `fit`, nothing is scaled.
    """

    state_mean: Tensor
    state_std: Tensor
    blocks_mean: Tensor
    blocks_std: Tensor
    scene_mean: Tensor
    scene_std: Tensor
    delta_mean: Tensor
    delta_std: Tensor

    def __init__(self, orientation: str, egocentric_blocks: bool, since_command: bool = False) -> None:
        super().__init__()
        self.orientation = orientation
        self.egocentric_blocks = egocentric_blocks
        self.since_command = since_command
        state, block, scene = encoded_sizes(orientation, egocentric_blocks, since_command)
        sizes = {"state": state, "blocks": len(COLORS) * block, "scene": scene, "delta": DELTA_DIM}
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def _encode_pose(self, pose: Tensor) -> Tensor:
        """(..., 6) xyz and Euler angles -> the same; or (..., 9) xyz, sines, cosines, which never jump."""
        if self.orientation == "euler":
            return pose
        position, euler = pose.split(3, dim=-1)
        return torch.cat([position, euler.sin(), euler.cos()], dim=-1)

    def _encode_robot(self, state: Tensor) -> Tensor:
        """(..., 15) -> robot state, not scaled."""
        return torch.cat([self._encode_pose(state[..., TCP_POSE]), state[..., TCP_POSE.stop :]], dim=-1)

    def _encode_scene(self, state: Tensor, environment_state: Tensor, start: Tensor | None) -> tuple[Tensor, Tensor]:
        """(..., 15), (..., 24) and (..., 24) -> flat blocks and scene, not scaled."""
        poses = environment_state[..., BLOCKS].unflatten(-1, (len(COLORS), 6))
        blocks = self._encode_pose(poses)
        if self.egocentric_blocks:
            offset = poses[..., :3] - state[..., None, :3]  # from the TCP, (..., 3, 3)
            blocks = torch.cat([blocks, offset, (offset / NEAR).tanh()], dim=-1)
        scene = environment_state[..., FURNITURE]
        if self.since_command:
            assert start is not None
            change = environment_state - start
            moved, turned = change[..., BLOCKS].unflatten(-1, (len(COLORS), 6)).split(3, dim=-1)
            blocks = torch.cat([blocks, moved, turned.sin(), turned.cos()], dim=-1)
            scene = torch.cat([change[..., FURNITURE], scene], dim=-1)
        return blocks.flatten(-2), scene

    def encode(
        self, state: Tensor, environment_state: Tensor | None, start: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """CALVIN's (..., 15) and (..., 24) -> scaled X (..., 15 or 18), B (..., 3, 6 to 24), S (..., 6 or 12).

        Without an environment state there are no B and S. `start`, the environment state when the command began,
        (..., 24), is needed with `since_command` only.
        """
        x = (self._encode_robot(state) - self.state_mean) / self.state_std
        if environment_state is None:
            return x, None, None
        blocks, scene = self._encode_scene(state, environment_state, start)
        blocks = (blocks - self.blocks_mean) / self.blocks_std
        scene = (scene - self.scene_mean) / self.scene_std
        return x, blocks.unflatten(-1, (len(COLORS), -1)), scene

    def scale_delta(self, delta: Tensor) -> Tensor:
        """(..., 6) in m and rad -> scaled."""
        return (delta - self.delta_mean) / self.delta_std

    def unscale_delta(self, delta: Tensor) -> Tensor:
        """(..., 6) scaled -> m and rad."""
        return delta * self.delta_std + self.delta_mean

    @torch.no_grad()
    def fit(self, state: Tensor, environment_state: Tensor | None, delta: Tensor, start: Tensor | None = None) -> None:
        """Sets the statistics from all frames of a dataset.

        Args:
            state: (T, 15).
            environment_state: (T, 24), or None where nothing is encoded of it.
            delta: (M, 6) target motions in m and rad.
            start: (T, 24), the environment state when each frame's command began; needed with `since_command` only.
        """
        columns = [("state", self._encode_robot(state), INPUT_FLOOR), ("delta", delta, DELTA_FLOOR)]
        if environment_state is not None:
            blocks, scene = self._encode_scene(state, environment_state, start)
            columns += [("blocks", blocks, INPUT_FLOOR), ("scene", scene, INPUT_FLOOR)]
        for name, values, floor in columns:
            values = values.double()
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0, correction=0).clamp(min=floor))
        for name, first in (("state", -1), ("scene", -2)):  # the gripper action; the two lights
            getattr(self, f"{name}_mean")[first:] = 0
            getattr(self, f"{name}_std")[first:] = 1
