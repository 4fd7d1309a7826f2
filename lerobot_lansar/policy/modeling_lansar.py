"""LanSAR for LeRobot: the loss in training; at inference one action per step, a history per environment."""

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
from .network import DecoderCache, LanSARNetwork
from .processor_lansar import CLIP_COMMAND, CLIP_IMAGE, COMMAND_GROUP, VALID_STEPS
from .scaling import SCENE_DIM, STATE_DIM, Scaler
from .windows import Windows, set_current


@dataclass
class History:
    """What one environment's episode has been since its history was last cleared.

    Attributes:
        command: The sentence being carried out.
        projections: C for the memory and for the target, (1, h) each; None before the first step.
        steps: Control steps since then; the window below may be shorter.
        contexts: E of the last steps, (length, h); each is computed once and kept.
        states: X_target of the last steps, (length, h).
    """

    command: str
    projections: tuple[Tensor, Tensor] | None
    steps: int
    contexts: Tensor
    states: Tensor


class LossParts:
    """Loss terms by name that become numbers when they are read, as LeRobot's metrics do after the update: reading
    them in `forward` would make a GPU wait. No Mapping, which Accelerate would take apart in mixed precision.
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
        dataset_stats: Ignored, LanSAR scales with statistics of its own.
        dataset_meta: Given in training only. The policy then computes its scaling statistics from all the
            dataset's frames (a checkpoint's own replace them afterwards) and makes the training windows
            available to its preprocessor.

    Raises:
        ValueError, FileNotFoundError: The dataset lacks something; the message says what.
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
                    "train on a copy without them (lansar-convert --images=none, with "
                    "--embed=true for a policy that looks at pictures)."
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
        """Weights that go on being trained must mean what they meant. Other options change a shape and fail by it."""
        if not self.config.pretrained_path:
            return
        trained = PreTrainedConfig.from_pretrained(self.config.pretrained_path)
        assert isinstance(trained, LanSARConfig)
        for name in ("target", "mlp_norm", "context_heads", "decoder_heads", "command_prepended"):
            asked, made_for = getattr(self.config, name), getattr(trained, name)
            if asked != made_for:
                raise ValueError(
                    f"--policy.{name}={asked}: {self.config.pretrained_path} was trained with {name}={made_for}, for "
                    "which its weights and scaling are made. Leave the option out, or train anew."
                )

    def get_optim_params(self) -> Any:
        return list(self.parameters())

    def reset(self) -> None:
        """Forget every environment's history; LeRobot calls this when a batch of episodes begins."""
        self._histories: list[History] = []

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, LossParts]:
        """Loss of a batch of windows, averaged over their valid steps (Eq 4.3-4.6).

        Args:
            batch: What the preprocessor makes of sampled frames, see `processor_lansar.py`.

        Returns:
            The scalar loss, and its parts.
        """
        if VALID_STEPS not in batch or CLIP_COMMAND not in batch:
            raise ValueError("LanSAR's forward needs windows: pass the batch through its preprocessor first.")
        rows = batch[VALID_STEPS]
        state = batch[OBS_STATE]
        if self.training and self.config.state_noise:
            noise = self.config.state_noise * torch.randn_like(state)
            noise[..., -1] = 0  # the gripper action stays -1 or +1
            state = state + noise
            state = torch.cat([state[..., :3], wrap_angle(state[..., 3:6]), state[..., 6:]], dim=-1)
        state, blocks, scene = self.scaler.encode(state, batch[OBS_ENV_STATE])
        static, gripper = (batch.get(key) for key in CLIP_IMAGE.values())
        command, same = batch[CLIP_COMMAND], batch.get(COMMAND_GROUP)
        motion, logit, contrast = self.network(command, state, blocks, scene, rows, static, gripper, same)
        goal = batch[ACTION].flatten(0, 1)[rows]  # (N, 7)
        delta = self.scaler.scale_delta(goal[:, :6])
        beta = self.config.smooth_l1_beta
        position = F.smooth_l1_loss(motion[:, :3], delta[:, :3], beta=beta)
        orientation = F.smooth_l1_loss(motion[:, 3:], delta[:, 3:], beta=beta)
        open_close = F.binary_cross_entropy_with_logits(logit, goal[:, 6])
        parts = {"position_loss": position, "orientation_loss": orientation, "gripper_loss": open_close}
        loss = position + orientation + open_close
        if contrast is not None:
            parts["contrastive_loss"] = contrast
            loss = loss + self.config.contrastive_weight * contrast
        return loss, LossParts(parts)

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        raise NotImplementedError("LanSAR decides one action at a time: use select_action.")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One action per environment.

        Args:
            batch: A preprocessed env observation: observation.state (B, 15), observation.environment_state
                (B, 24), observation.clip.* (B, D), task: B sentences, and, if the env says so,
                observation.control_mode (B, 1).

        Returns:
            (B, 7) float32. "abs": TCP target xyz (m), euler xyz (rad), gripper -1/+1. "rel": differences in
            units of (0.02 m, 0.05 rad) clipped to +-1, gripper -1/+1.

        Raises:
            ValueError: Wrong shapes, NaN, or an env in the other control mode.
        """
        if self.training:
            self.eval()
        state, environment_state = batch[OBS_STATE].float(), batch[OBS_ENV_STATE].float()
        self._check(batch, state, environment_state)
        inputs = [state, environment_state, batch[CLIP_COMMAND]]
        inputs += [batch[key] for key in CLIP_IMAGE.values()] if self.config.use_images else []
        self._recall(batch["task"])
        with torch.autocast(state.device.type, enabled=False):  # one step is too little work to gain from it
            return self._act(*inputs)

    def _check(self, batch: dict[str, Any], state: Tensor, environment_state: Tensor) -> None:
        sizes = ((OBS_STATE, state, STATE_DIM), (OBS_ENV_STATE, environment_state, SCENE_DIM + 18))
        for name, value, size in sizes:
            if value.ndim != 2 or value.shape[1] != size:
                told = " LanSAR reads the command itself: --env.task_in_state=false." if name == OBS_ENV_STATE else ""
                raise ValueError(f"{name} must be (B, {size}), got {tuple(value.shape)}.{told}")
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
                        f"The environment takes {env} actions (--env.control_mode={env}), this policy "
                        f"returns {mine} ones (--policy.control_mode={mine}). "
                        f"Set --env.control_mode={mine} or --policy.control_mode={env}."
                    )

    def _recall(self, tasks: list[str]) -> None:
        """Keep each environment's history, empty where its command changed or the time to forget has come."""
        if len(self._histories) != len(tasks):
            parameter = self.network.cls.weight
            self._histories = [self._blank("") for _ in tasks]
            self._cache = DecoderCache(self.network.config, len(tasks), parameter)
        for i, (history, command) in enumerate(zip(self._histories, tasks, strict=True)):
            if history.command != command or history.steps >= self.config.history_clear_steps:
                self._histories[i] = self._blank(command)
                self._cache.steps[i] = 0

    def _blank(self, command: str) -> History:
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
        """Take one step into the histories and decide: (B, 15), (B, 24), (B, D)... -> (B, 7)."""
        config, network, histories = self.config, self.network, self._histories
        x, blocks, scene = self.scaler.encode(state, environment_state)
        for i, history in enumerate(histories):
            if history.projections is None:
                history.projections = network.encode_command(command[i : i + 1])
        projections = [h.projections for h in histories if h.projections is not None]
        commands = torch.cat([c for c, _ in projections]), torch.cat([c for _, c in projections])
        modalities = network.modalities(x, blocks, scene, static, gripper)
        contexts = network.encode_context(modalities, commands[0])  # (B, h)
        states = network.state_target(x)
        for i, history in enumerate(histories):
            if len(history.contexts) == config.window:  # forget the oldest steps, move the others up
                history.contexts = history.contexts[config.window_slide :]
                history.states = history.states[config.window_slide :]
                self._cache.steps[i] = 0
            history.steps += 1
            history.contexts = torch.cat([history.contexts, contexts[i : i + 1]])
            history.states = torch.cat([history.states, states[i : i + 1]])
        last = self._decode(commands)
        length = torch.tensor([len(history.contexts) for history in histories], device=state.device)
        motion, logit = network.predict(last)
        delta = self.scaler.unscale_delta(motion)
        scale = config.position_scale_start - config.position_scale_slope * length / config.window  # Eq 4.8
        position = delta[:, :3] * scale[:, None]
        orientation = delta[:, 3:] * delta.new_tensor([1.0, 1.0, config.yaw_scale])
        grip = torch.where(logit > 0, 1.0, -1.0)[:, None]
        if config.control_mode == "abs":
            return torch.cat([state[:, :3] + position, wrap_angle(state[:, 3:6] + orientation), grip], dim=1)
        relative = torch.cat([position / POSITION_UNIT, orientation / ANGLE_UNIT], dim=1)
        return torch.cat([relative.clamp(-1, 1), grip], dim=1)

    def _decode(self, commands: tuple[Tensor, Tensor]) -> Tensor:
        """The decoder's output at every row's newest step, (B, h); only steps that are not in the cache cost
        anything.
        """
        last = torch.empty_like(commands[0])
        groups: dict[tuple[int, bool], list[int]] = {}  # rows that need the same number of new steps
        for row, (history, held) in enumerate(zip(self._histories, self._cache.steps, strict=True)):
            groups.setdefault((len(history.contexts) - held, held == 0), []).append(row)
        for (new, _), members in groups.items():
            past = self._cache.add(members, new)
            histories = [self._histories[row] for row in members]
            contexts = torch.stack([history.contexts[-new:] for history in histories])
            states = torch.stack([history.states[-new:] for history in histories])
            command = commands[0][members], commands[1][members]
            decoded = self.network.decode(contexts, states, command, past)
            last[members] = decoded[:, -1]
        return last
