"""What the network reads and predicts, in numbers of order one: orientation encoding and standard scaling (Eq
4.7)."""

import torch
from torch import Tensor, nn

STATE_DIM = 15  # robot_obs: TCP xyz, TCP euler xyz, gripper width, 7 arm joints, last gripper action -1/+1
SCENE_DIM = 6  # scene_obs 0-5: slider, drawer, button, switch joints; bulb, LED 0/1
BLOCKS = 3  # scene_obs 6-23: red, blue, pink; xyz and euler xyz each
DELTA_DIM = 6  # position (m) and orientation (rad) difference

# A column that hardly moves in the data (a button nobody pressed) is divided by this instead of its sigma, in
# its own unit (m or rad): dividing by the sigma of noise would blow up the first real movement at inference.
INPUT_FLOOR = 1e-2
NEAR = 0.05  # m; within this distance of the TCP a block's relative position is given in finer steps
DELTA_FLOOR = 1e-3


def encoded_sizes(orientation: str, egocentric_blocks: bool) -> tuple[int, int, int]:
    """Numbers per robot state, block and scene after `Scaler.encode`."""
    extra = 3 if orientation == "sincos" else 0
    return STATE_DIM + extra, 6 + extra + (6 if egocentric_blocks else 0), SCENE_DIM


class Scaler(nn.Module):
    """Mean and sigma of everything that is scaled, kept as buffers: they travel in the checkpoint.

    Binary values (gripper action, lights) keep mean 0 and sigma 1. Until `fit` is called nothing is scaled.
    """

    state_mean: Tensor
    state_std: Tensor
    blocks_mean: Tensor
    blocks_std: Tensor
    scene_mean: Tensor
    scene_std: Tensor
    delta_mean: Tensor
    delta_std: Tensor

    def __init__(self, orientation: str, egocentric_blocks: bool) -> None:
        super().__init__()
        self.orientation = orientation
        self.egocentric_blocks = egocentric_blocks
        state, block, scene = encoded_sizes(orientation, egocentric_blocks)
        sizes = {"state": state, "blocks": BLOCKS * block, "scene": scene, "delta": DELTA_DIM}
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def _angles(self, pose: Tensor) -> Tensor:
        """(..., 6) xyz and euler -> (..., 6), or (..., 9): xyz, sines, cosines, continuous where euler
        jumps."""
        if self.orientation == "euler":
            return pose
        position, euler = pose.split(3, dim=-1)
        return torch.cat([position, euler.sin(), euler.cos()], dim=-1)

    def _encode(self, state: Tensor, environment_state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = torch.cat([self._angles(state[..., :6]), state[..., 6:]], dim=-1)
        pose = environment_state[..., SCENE_DIM:].unflatten(-1, (BLOCKS, 6))
        blocks = self._angles(pose)
        if self.egocentric_blocks:
            offset = pose[..., :3] - state[..., None, :3]  # from the TCP, (..., 3, 3)
            blocks = torch.cat([blocks, offset, (offset / NEAR).tanh()], dim=-1)
        return x, blocks.flatten(-2), environment_state[..., :SCENE_DIM]

    def encode(self, state: Tensor, environment_state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """CALVIN's (..., 15) and (..., 24) -> scaled X (..., 15 or 18), B (..., 3, 6 to 15), S (..., 6)."""
        x, blocks, scene = self._encode(state, environment_state)
        x = (x - self.state_mean) / self.state_std
        blocks = (blocks - self.blocks_mean) / self.blocks_std
        scene = (scene - self.scene_mean) / self.scene_std
        return x, blocks.unflatten(-1, (BLOCKS, -1)), scene

    def scale_delta(self, delta: Tensor) -> Tensor:
        """(..., 6) in m and rad -> scaled."""
        return (delta - self.delta_mean) / self.delta_std

    def unscale_delta(self, delta: Tensor) -> Tensor:
        """(..., 6) scaled -> m and rad."""
        return delta * self.delta_std + self.delta_mean

    @torch.no_grad()
    def fit(self, state: Tensor, environment_state: Tensor, delta: Tensor) -> None:
        """Set the statistics from all frames of a dataset.

        Args:
            state: (T, 15); environment_state: (T, 24); delta: (M, 6) the motion targets in m and rad.
        """
        x, blocks, scene = self._encode(state, environment_state)
        for name, values, floor in (
            ("state", x, INPUT_FLOOR),
            ("blocks", blocks, INPUT_FLOOR),
            ("scene", scene, INPUT_FLOOR),
            ("delta", delta, DELTA_FLOOR),
        ):
            values = values.double()
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0, correction=0).clamp(min=floor))
        for name, first in (("state", -1), ("scene", -2)):  # the gripper action; the two lights
            getattr(self, f"{name}_mean")[first:] = 0
            getattr(self, f"{name}_std")[first:] = 1
