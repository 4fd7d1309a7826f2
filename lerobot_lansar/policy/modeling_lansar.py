"""LanSAR for LeRobot: the loss in training; at inference one action per step, with a history per environment."""

import logging
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from ..calvin import ANGLE_UNIT, CONTROL_MODES, POSITION_UNIT, wrap_angle
from .configuration_lansar import LanSARConfig
from .network import LanSARNetwork
from .processor_lansar import CLIP_COMMAND, CLIP_IMAGE, COMMAND_TASKS, VALID_STEPS
from .scaling import ENVIRONMENT_STATE_DIM, STATE_DIM, Scaler
from .windows import Windows, set_current


@dataclass
class History:
    """What happened in one environment since its history was last cleared.

    Attributes:
        command: The sentence being carried out.
        projections: C for the memory and for the target, (1, h) each; None before the first step.
        steps: Control steps so far; the window may hold fewer.
        contexts: E of the steps in the window, (length, h), each computed once.
        states: X for the target, (length, h), likewise.
    """

    command: str
    projections: tuple[Tensor, Tensor] | None
    steps: int
    contexts: Tensor
    states: Tensor


class LossParts:
    """Loss terms converted to floats only when read, so `forward` never synchronises the GPU.

    Not a Mapping: Accelerate would recurse into it.
    """

    def __init__(self, terms: dict[str, Tensor]) -> None:
        self._terms = {name: value.detach() for name, value in terms.items()}

    def items(self) -> list[tuple[str, float]]:
        return [(name, value.item()) for name, value in self._terms.items()]

    def __len__(self) -> int:
        return len(self._terms)


class LanSARPolicy(PreTrainedPolicy):
    """Language-commanded Scene-aware Action Response.

    Args:
        config: All options.
        dataset_stats: Ignored: LanSAR scales with its own statistics.
        dataset_meta: Given in training only. The policy then computes its scaling statistics from all frames of the
            dataset (a checkpoint's replace them afterwards) and gives the training windows to its preprocessor.

    Raises:
        ValueError, FileNotFoundError: The dataset or the options cannot be used; the message says why.
    """

    config_class = LanSARConfig
    name = "lansar"
    config: LanSARConfig
    _no_split_modules = ("EncoderLayer", "DecoderLayer")  # the units that FSDP shards

    def __init__(
        self, config: LanSARConfig, dataset_stats: Any = None, dataset_meta: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        config.validate_features()
        self.scaler = Scaler(config.orientation, config.egocentric_blocks)
        self.network = LanSARNetwork(config.network)
        if dataset_meta is not None:
            self._check_pretrained()
            if any(feature["dtype"] == "video" for feature in dataset_meta.features.values()):
                logging.warning(
                    "LanSAR does not read this dataset's videos, but LeRobot decodes them for every sample: "
                    "train on a copy without them (lansar-convert --images=none, with --embed=true for a policy that "
                    "reads pictures)."
                )
            windows = Windows(dataset_meta.root, dataset_meta.features, dataset_meta.total_frames, config)
            self.scaler.fit(
                torch.tensor(windows.frames["state"]),
                torch.tensor(windows.frames["environment_state"]),
                torch.tensor(windows.targets[windows.has_target, :6]),
            )
            set_current(windows)
        self.reset()

    def _check_pretrained(self) -> None:
        """Rejects options that would silently change what pretrained weights mean; others fail by shape."""
        if not self.config.pretrained_path:
            return
        trained = PreTrainedConfig.from_pretrained(self.config.pretrained_path)
        assert isinstance(trained, LanSARConfig)
        for name in ("target", "mlp_norm", "context_heads", "decoder_heads", "command_prepended"):
            given, expected = getattr(self.config, name), getattr(trained, name)
            if given != expected:
                raise ValueError(
                    f"--policy.{name}={given}: {self.config.pretrained_path} was trained with {name}={expected}, on "
                    "which its weights and scaling depend. Omit the option, or train a new policy."
                )

    def get_optim_params(self) -> Any:
        return list(self.parameters())

    def reset(self) -> None:
        """Clears all histories; LeRobot calls this before each batch of episodes."""
        self._histories: list[History] = []

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, LossParts]:
        """Loss of a batch of windows, averaged over their valid steps (Eq 4.3-4.6).

        Args:
            batch: From the preprocessor, see `processor_lansar.py`.

        Returns:
            The scalar loss, and its terms.

        Raises:
            ValueError: The batch holds no windows.
        """
        if VALID_STEPS not in batch or CLIP_COMMAND not in batch:
            raise ValueError("LanSAR's forward needs windows: pass the batch through its preprocessor first.")
        valid_steps, state = batch[VALID_STEPS], batch[OBS_STATE]
        if self.training and self.config.state_noise:
            state = self._add_noise(state)
        inputs = self.scaler.encode(state, batch[OBS_ENV_STATE])
        pictures = (batch.get(key) for key in CLIP_IMAGE.values())
        motion, logit, contrast = self.network(
            batch[CLIP_COMMAND], *inputs, valid_steps, *pictures, batch.get(COMMAND_TASKS)
        )
        target = batch[ACTION].flatten(0, 1)[valid_steps]  # (N, 7)
        delta = self.scaler.scale_delta(target[:, :6])
        beta = self.config.smooth_l1_beta
        position = F.smooth_l1_loss(motion[:, :3], delta[:, :3], beta=beta)
        orientation = F.smooth_l1_loss(motion[:, 3:], delta[:, 3:], beta=beta)
        open_close = F.binary_cross_entropy_with_logits(logit, target[:, 6])
        parts = {"position_loss": position, "orientation_loss": orientation, "gripper_loss": open_close}
        loss = position + orientation + open_close
        if contrast is not None:
            parts["contrastive_loss"] = contrast
            loss = loss + self.config.contrastive_weight * contrast
        return loss, LossParts(parts)

    def _add_noise(self, state: Tensor) -> Tensor:
        """(B, n, 15) -> the same with normal noise of `state_noise`."""
        noise = self.config.state_noise * torch.randn_like(state)
        noise[..., -1] = 0  # the gripper action stays -1 or +1
        state = state + noise
        return torch.cat([state[..., :3], wrap_angle(state[..., 3:6]), state[..., 6:]], dim=-1)

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        raise NotImplementedError("LanSAR predicts one action at a time, no action chunks: use select_action.")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One action per environment.

        Args:
            batch: A preprocessed observation: observation.state (B, 15), observation.environment_state (B, 24),
                observation.clip.* (B, D), task (B sentences) and, if the environment provides it,
                observation.control_mode (B, 1).

        Returns:
            (B, 7) float32. "abs": TCP xyz (m) and Euler xyz (rad) to go to, gripper -1/+1. "rel": differences to the
            current pose in units of (0.02 m, 0.05 rad) clipped to +-1, gripper -1/+1.

        Raises:
            ValueError: Wrong shapes, NaN, or an environment with the other control mode.
        """
        if self.training:
            self.eval()
        state, environment_state = batch[OBS_STATE].float(), batch[OBS_ENV_STATE].float()
        self._check(batch, state, environment_state)
        inputs = [state, environment_state, batch[CLIP_COMMAND]]
        inputs += [batch[key] for key in CLIP_IMAGE.values()] if self.config.use_images else []
        self._clear_old_histories(batch["task"])
        with torch.autocast(state.device.type, enabled=False):  # mixed precision does not speed up a single step
            return self._act(*inputs)

    def _check(self, batch: dict[str, Any], state: Tensor, environment_state: Tensor) -> None:
        sizes = ((OBS_STATE, state, STATE_DIM), (OBS_ENV_STATE, environment_state, ENVIRONMENT_STATE_DIM))
        for name, value, size in sizes:
            if value.ndim != 2 or value.shape[1] != size:
                hint = " LanSAR reads the command itself: --env.task_in_state=false." if name == OBS_ENV_STATE else ""
                raise ValueError(f"{name} must be (B, {size}), got {tuple(value.shape)}.{hint}")
            if not value.isfinite().all():
                rows = (~value.isfinite().all(dim=1)).nonzero().flatten().tolist()
                raise ValueError(f"{name} is NaN or infinite in environment {rows} of the batch.")
        if len(batch.get("task") or ()) != len(state):
            raise ValueError("LanSAR needs one command per environment in `task`.")
        mode = batch.get("observation.control_mode")
        if mode is not None:
            for value in mode.flatten().tolist():
                env, mine = CONTROL_MODES[int(value)], self.config.control_mode
                if env != mine:
                    raise ValueError(
                        f"The environment expects {env} actions (--env.control_mode={env}), but this policy returns "
                        f"{mine} actions (--policy.control_mode={mine}). "
                        f"Set --env.control_mode={mine} or --policy.control_mode={env}."
                    )

    def _clear_old_histories(self, commands: list[str]) -> None:
        """Clears the history of each environment whose command changed or that reached `history_clear_steps`."""
        if len(self._histories) != len(commands):
            self._histories = [self._empty_history("") for _ in commands]
            self._cache = self.network.new_cache(len(commands))
        for i, (history, command) in enumerate(zip(self._histories, commands, strict=True)):
            if history.command != command or history.steps >= self.config.history_clear_steps:
                self._histories[i] = self._empty_history(command)
                self._cache.steps[i] = 0

    def _empty_history(self, command: str) -> History:
        empty = self.network.cls.weight.new_zeros(0, self.config.hidden)
        return History(command, None, 0, empty, empty)

    def _act(
        self,
        state: Tensor,
        environment_state: Tensor,
        command: Tensor,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
    ) -> Tensor:
        """Appends one step to the histories and predicts: (B, 15), (B, 24), (B, D)... -> actions (B, 7)."""
        x, blocks, scene = self.scaler.encode(state, environment_state)
        commands = self._encode_commands(command)
        modalities = self.network.encode_modalities(x, blocks, scene, static, gripper)
        contexts = self.network.encode_context(modalities, commands[0])  # (B, h)
        self._append(contexts, self.network.state_target(x))
        motion, logit = self.network.predict(self._decode_newest(commands))
        return self._to_action(state, motion, logit)

    def _encode_commands(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """(B, D) -> C for memory and target, (B, h) each, computed once per history."""
        projections = []
        for i, history in enumerate(self._histories):
            if history.projections is None:
                history.projections = self.network.encode_command(command[i : i + 1])
            projections.append(history.projections)
        return torch.cat([memory for memory, _ in projections]), torch.cat([target for _, target in projections])

    def _append(self, contexts: Tensor, states: Tensor) -> None:
        """Adds one step, (B, h) each, to the histories; a full window first drops its oldest steps."""
        for i, history in enumerate(self._histories):
            if len(history.contexts) == self.config.window:
                history.contexts = history.contexts[self.config.window_slide :]
                history.states = history.states[self.config.window_slide :]
                self._cache.steps[i] = 0  # all positions have changed
            history.steps += 1
            history.contexts = torch.cat([history.contexts, contexts[i : i + 1]])
            history.states = torch.cat([history.states, states[i : i + 1]])

    def _decode_newest(self, commands: tuple[Tensor, Tensor]) -> Tensor:
        """The decoder's output at each environment's newest step, (B, h); steps in the cache are not decoded again."""
        newest = torch.empty_like(commands[0])
        groups: dict[tuple[int, bool], list[int]] = {}  # environments with the same number of new steps
        for i, (history, held) in enumerate(zip(self._histories, self._cache.steps, strict=True)):
            groups.setdefault((len(history.contexts) - held, held == 0), []).append(i)
        for (new, _), members in groups.items():
            cache = self._cache.add(members, new)
            histories = [self._histories[i] for i in members]
            contexts = torch.stack([history.contexts[-new:] for history in histories])
            states = torch.stack([history.states[-new:] for history in histories])
            command = commands[0][members], commands[1][members]
            newest[members] = self.network.decode(contexts, states, command, cache)[:, -1]
        return newest

    def _to_action(self, state: Tensor, motion: Tensor, logit: Tensor) -> Tensor:
        """Robot state (B, 15), scaled motion (B, 6) and gripper logits (B,) -> actions (B, 7) in the control mode."""
        config = self.config
        length = torch.tensor([len(history.contexts) for history in self._histories], device=state.device)
        delta = self.scaler.unscale_delta(motion)
        scale = config.position_scale_start - config.position_scale_slope * length / config.window  # Eq 4.8
        position = delta[:, :3] * scale[:, None]
        orientation = delta[:, 3:] * delta.new_tensor([1.0, 1.0, config.yaw_scale])
        gripper = torch.where(logit > 0, 1.0, -1.0)[:, None]
        if config.control_mode == "abs":
            return torch.cat([state[:, :3] + position, wrap_angle(state[:, 3:6] + orientation), gripper], dim=1)
        relative = torch.cat([position / POSITION_UNIT, orientation / ANGLE_UNIT], dim=1)
        return torch.cat([relative.clamp(-1, 1), gripper], dim=1)
