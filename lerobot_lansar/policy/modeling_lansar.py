"""LanSAR for LeRobot: the loss in training; at inference one action per step, with a history per environment."""

from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from huggingface_hub import ModelCard
from lerobot.configs import parser
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..calvin import ANGLE_UNIT, CONTROL_MODES, GRIPPER_ACTION, POSITION_UNIT, TCP_POSE
from ..clip.commands import CLIP_COMMAND
from ..clip.model import Clip, ImageEncoder
from ..clip.store import IMAGE_FEATURES
from ..trained_options import check_trained_options
from .card import card_text
from .configuration_lansar import LanSARConfig
from .losses import Losses
from .network import LanSARNetwork
from .optimizer import parameter_groups
from .processor_lansar import CLIP_IMAGE, COMMAND_TASKS, COUNTS, START, VALID_STEPS, picture_of
from .scaling import ENVIRONMENT_STATE_DIM, STATE_DIM, Scaler
from .windows import Windows, set_current


@dataclass
class History:
    """What happened in one environment since its history was last cleared.

    Attributes:
        command: The sentence being carried out.
        start: The environment state when it began, (24,); None before the first step.
        projections: C for the memory and for the target, (1, h) each; None before the first step.
        steps: Control steps so far; the window may hold fewer.
        contexts: E of the steps in the window, (length, h), each computed once.
        states: X for the target, (length, h), likewise.
    """

    command: str
    start: Tensor | None
    projections: tuple[Tensor, Tensor] | None
    steps: int
    contexts: Tensor
    states: Tensor


TRAINED_OPTIONS = (
    "hidden",
    "context_layers",
    "context_heads",
    "decoder_layers",
    "decoder_heads",
    "feedforward",
    "window",
    "mlp_norm",
    "use_images",
    "use_spatial_context",
    "command_in_context",
    "command_prepended",
    "orientation",
    "egocentric_blocks",
    "since_command",
    "target",
    "clip",
    "finetune_clip",
)
"""Options that must stay as a checkpoint was trained, because its weights or its scaling depend on them."""


class LanSARPolicy(PreTrainedPolicy):
    """Language-commanded Scene-aware Action Response.

    Args:
        config: All options.
        dataset_stats: Ignored: LanSAR scales with its own statistics.
        dataset_meta: Given in training only. The policy then computes its scaling statistics from all frames of the
            dataset (a checkpoint's replace them afterwards), gives the training windows to its preprocessor, and
            removes the videos from this object's features, so that LeRobot does not decode them.

    Raises:
        ValueError, FileNotFoundError: The dataset or the options cannot be used; the message says why.
    """

    config_class = LanSARConfig
    name = "lansar"
    config: LanSARConfig
    # From so many environments on, actions do not depend on their number, not even in rounding: for fewer rows, some
    # CPUs add up matrix products in another order.
    least_rows = 16
    # The units that FSDP shards: for Accelerate, and for LeRobot after 0.6.
    _no_split_modules = _fsdp_wrap_modules = ("EncoderLayer", "DecoderLayer")

    def __init__(
        self, config: LanSARConfig, dataset_stats: Any = None, dataset_meta: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        config.validate_features()
        self._losses: Losses | None = None  # in training only
        self.scaler = Scaler(config.orientation, config.egocentric_blocks, config.since_command)
        self.network = LanSARNetwork(config.network)
        if dataset_meta is not None:
            check_trained_options(config, TRAINED_OPTIONS)
        self.image_encoder: ImageEncoder | None = None
        if config.finetune_clip:
            # Only a new training starts from CLIP's weights; a checkpoint has its own.
            clip = Clip(config.clip, load=dataset_meta is not None and not config.pretrained_path)
            self.image_encoder = clip.images.requires_grad_(True)
            # safetensors saves no other format
            self.image_encoder.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        if dataset_meta is not None:
            root, features = dataset_meta.root, dataset_meta.features
            windows = Windows(root, features, dataset_meta.total_frames, config, self.image_encoder)
            _drop_videos(features)
            scene = windows.frames["environment_state"] if config.use_spatial_context else None
            start = scene[windows.frames["first"]] if scene is not None and config.since_command else None
            self.scaler.fit(
                torch.tensor(windows.frames["state"]),
                None if scene is None else torch.tensor(scene),
                torch.tensor(windows.targets[windows.has_target & windows.is_demonstrated, :6]),
                None if start is None else torch.tensor(start),
            )
            set_current(windows)
            if config.compile_model:
                self.network.compile_transformers()
            self._losses = Losses()
            if (parser.parse_arg("resume") or "").lower() == "true":
                self._losses.load(Path(str(config.pretrained_path)))
        self.reset()

    def get_optim_params(self) -> Any:
        parameters = list(self.network.parameters())
        groups: list[dict[str, Any]] = [{"params": parameters}]
        if self.config.optimizer == "muon":
            groups = parameter_groups(self.network)
        if self.image_encoder is not None:
            encoder = list(self.image_encoder.parameters())
            groups.append({"params": encoder, "lr": self.config.clip_learning_rate, "name": "image encoder"})
        if self.config.optimizer == "adamw" and parameters[0].is_cuda:
            groups = [group | {"fused": True} for group in groups]  # one kernel that reads and writes everything once
        return groups if len(groups) > 1 or parameters[0].is_cuda else parameters

    def train(self, mode: bool = True) -> "LanSARPolicy":
        """As usual; but under LoRA's adapters, which alone are saved, BatchNorm keeps the checkpoint's statistics."""
        super().train(mode)
        if self.config.use_peft:
            for module in self.modules():
                if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
                    module.eval()
        return self

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """What `--peft.method_type` adapts unless `--peft.target_modules` says otherwise."""
        return {"target_modules": "all-linear", "modules_to_save": []}

    def reset(self) -> None:
        """Clears all histories; LeRobot calls this before each batch of episodes."""
        self._histories: list[History] = []

    def reset_environments(self, environments: Iterable[int]) -> None:
        """Clears the histories of some environments of the batch; `lansar-eval` calls this where a command begins."""
        for i in environments:
            if i < len(self._histories):
                self._clear(i, "")

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of windows (Eq 4.3-4.6).

        Args:
            batch: From the preprocessor, see `processor_lansar.py`.
            reduction: "mean": the average over all valid steps in which the demonstrator acted. "none", for LeRobot's
                `--sample_weighting`: one loss per window, whose average is the loss with "mean". A window's steps are
                therefore summed and divided by the mean number of steps per window. The contrastive loss, which
                belongs to the whole batch, is added to each.

        Returns:
            The loss, () or (B,); its terms, averaged over the same steps.

        Raises:
            ValueError: The batch holds no windows, or `reduction` is neither.
        """
        if VALID_STEPS not in batch or CLIP_COMMAND not in batch:
            raise ValueError("LanSAR's forward needs windows: pass the batch through its preprocessor first.")
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction must be 'mean' or 'none', got {reduction!r}.")
        # LeRobot 0.6 enters this context too; later versions only with an option of their own.
        mixed = self.config.dtype == "bfloat16"
        with torch.autocast(batch[OBS_STATE].device.type, torch.bfloat16) if mixed else nullcontext():
            terms, contrast = self._loss_terms(batch)
        if COUNTS in batch:
            # What counts, in units of its mean: every mean below is then one over the steps that count.
            counts = batch[COUNTS].flatten()[batch[VALID_STEPS]]
            counts = counts * len(counts) / counts.sum().clamp(min=1)
            terms = {name: values * counts for name, values in terms.items()}
        steps = torch.stack(list(terms.values())).sum(dim=0)  # (N,)
        terms = {name: values.mean() for name, values in terms.items()}
        if reduction == "none":
            windows, length = batch[OBS_STATE].shape[:2]
            sums = steps.new_zeros(windows).index_add(0, batch[VALID_STEPS] // length, steps)
            loss = sums * windows / len(steps)
        else:
            loss = steps.mean()
        if contrast is not None:
            terms["contrastive_loss"] = contrast
            loss = loss + self.config.contrastive_weight * contrast
        values = torch.stack([loss.mean(), *terms.values()]).tolist()  # plain numbers for LeRobot; one wait for a GPU
        if self._losses is not None:
            self._losses.add(values[0], self.training)
        return loss, dict(zip(terms, values[1:], strict=True))

    def _loss_terms(self, batch: dict[str, Any]) -> tuple[dict[str, Tensor], Tensor | None]:
        """Every term's value at each valid step, (N,) float32; the batch's contrastive loss, if it is used."""
        valid_steps, state = batch[VALID_STEPS], batch[OBS_STATE]
        if self.training and self.config.state_noise:
            state = self._add_noise(state)
        inputs = self.scaler.encode(state, self._environment_state(batch), batch.get(START))
        pictures = self._embed_windows(batch) if self.image_encoder else [batch.get(k) for k in CLIP_IMAGE.values()]
        motion, logit, contrast = self.network(
            batch[CLIP_COMMAND], *inputs, valid_steps, *pictures, batch.get(COMMAND_TASKS)
        )
        target = batch[ACTION].flatten(0, 1)[valid_steps]  # (N, 7)
        delta = self.scaler.scale_delta(target[:, :6])
        error = F.smooth_l1_loss(motion.float(), delta, beta=self.config.smooth_l1_beta, reduction="none")
        terms = {
            "position_loss": error[:, :3].mean(dim=1),
            "orientation_loss": error[:, 3:].mean(dim=1),
            "gripper_loss": F.binary_cross_entropy_with_logits(logit.float(), target[:, 6], reduction="none"),
        }
        return terms, contrast

    def _embed_windows(self, batch: dict[str, Any]) -> list[Tensor]:
        """The embeddings of both cameras' pictures at all steps, (B, n, D) each, 0 where there is padding."""
        assert self.image_encoder is not None
        valid_steps, shape = batch[VALID_STEPS], batch[OBS_STATE].shape[:2]
        found = [embed_in_parts(self.image_encoder, batch[key]) for key in IMAGE_FEATURES.values()]  # (N, D)
        return [e.new_zeros(shape.numel(), e.shape[1]).index_copy(0, valid_steps, e).unflatten(0, shape) for e in found]

    def _add_noise(self, state: Tensor) -> Tensor:
        """(B, n, 15) -> the same with normal noise of `state_noise`. Angles are not wrapped: that could make a jump."""
        noise = self.config.state_noise * torch.randn_like(state)
        noise[..., GRIPPER_ACTION] = 0  # stays -1 or +1
        return state + noise

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        raise NotImplementedError("LanSAR predicts one action at a time, no action chunks: use select_action.")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One action per environment, in the control mode that the environment takes.

        Args:
            batch: A preprocessed observation: observation.state (B, 15), with `use_spatial_context`
                observation.environment_state (B, 24), observation.clip.* (B, D), with `finetune_clip`
                observation.images.* (B, 3, H, W) in [0, 1] instead of those of pictures, task (B sentences) and, if
                the environment provides it,
                observation.control_mode (B, 1): 0 for "rel", 1 for "abs". Without it, the option `control_mode` holds.

        Returns:
            (B, 7) float32. "abs": TCP xyz (m) and Euler xyz (rad, near the state's, whatever full turns that has) to
            go to, gripper -1/+1. "rel": differences to the current pose in units of (0.02 m, 0.05 rad) clipped to +-1,
            gripper -1/+1.

        Raises:
            ValueError: Wrong shapes or NaN.
        """
        if self.training:
            self.eval()
        state = batch[OBS_STATE].float()
        environment_state = self._environment_state(batch)
        self._check(batch, state, environment_state)
        inputs = [state, environment_state, batch[CLIP_COMMAND]]
        self._clear_old_histories(batch["task"])
        with torch.autocast(state.device.type, enabled=False):  # mixed precision does not speed up a single step
            if self.image_encoder is not None:
                inputs += [self.image_encoder(picture_of(batch, key)) for key in IMAGE_FEATURES.values()]
            elif self.config.use_images:
                inputs += [batch[key] for key in CLIP_IMAGE.values()]
            motion, logit = self._predict(*inputs)
            return self._to_action(state, motion, logit, batch.get("observation.control_mode"))

    def _environment_state(self, batch: dict[str, Any]) -> Tensor | None:
        """What the policy reads of the scene: (..., 24), or None with `use_spatial_context` off."""
        if not self.config.use_spatial_context:
            return None
        if OBS_ENV_STATE not in batch:
            raise ValueError(
                f"there is no {OBS_ENV_STATE}, which this policy reads (--policy.use_spatial_context=true): set "
                "--env.scene_state=true"
            )
        return batch[OBS_ENV_STATE].float()

    def _check(self, batch: dict[str, Any], state: Tensor, environment_state: Tensor | None) -> None:
        sizes = [(OBS_STATE, state, STATE_DIM)]
        if environment_state is not None:
            sizes.append((OBS_ENV_STATE, environment_state, ENVIRONMENT_STATE_DIM))
        for name, value, size in sizes:
            if value.ndim != 2 or value.shape[1] != size:
                hint = " LanSAR reads the command itself: --env.task_in_state=false." if name == OBS_ENV_STATE else ""
                raise ValueError(f"{name} must be (B, {size}), got {tuple(value.shape)}.{hint}")
            if not value.isfinite().all():
                rows = (~value.isfinite().all(dim=1)).nonzero().flatten().tolist()
                raise ValueError(f"{name} is NaN or infinite in environment {rows} of the batch.")
        if len(batch.get("task") or ()) != len(state):
            raise ValueError("LanSAR needs one command per environment in `task`.")

    def _clear_old_histories(self, commands: list[str]) -> None:
        """Clears the history of each environment whose command changed or that reached `history_clear_steps`."""
        if len(self._histories) != len(commands):
            self._histories = [self._empty_history("") for _ in commands]
            self._cache = self.network.new_cache(len(commands))
        for i, (history, command) in enumerate(zip(self._histories, commands, strict=True)):
            if history.command != command:
                self._clear(i, command)
            elif history.steps >= self.config.history_clear_steps:
                self._clear(i, command, history.start)

    def _clear(self, i: int, command: str, start: Tensor | None = None) -> None:
        self._histories[i] = self._empty_history(command, start)
        self._cache.clear(i)

    def _empty_history(self, command: str, start: Tensor | None = None) -> History:
        empty = self.network.cls.weight.new_zeros(0, self.config.hidden)
        return History(command, start, None, 0, empty, empty)

    def _predict(
        self,
        state: Tensor,
        environment_state: Tensor | None,
        command: Tensor,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Adds one step to the histories: (B, 15), (B, 24), (B, D)... -> scaled motion (B, 6), gripper logits (B,)."""
        start = None
        if environment_state is not None and self.config.since_command:
            start = self._starts(environment_state)
        x, blocks, scene = self.scaler.encode(state, environment_state, start)
        commands = self._encode_commands(command)
        modalities = self.network.encode_modalities(x, blocks, scene, static, gripper)
        contexts = self.network.encode_context(modalities, commands[0])  # (B, h)
        self._append(contexts, self.network.state_target(x))
        return self.network.predict(self._decode_newest(commands))

    def _starts(self, environment_state: Tensor) -> Tensor:
        """(B, 24) now -> the same when each environment's command began."""
        for history, now in zip(self._histories, environment_state, strict=True):
            if history.start is None:
                history.start = now
        return torch.stack([history.start for history in self._histories if history.start is not None])

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
        """The decoder's output at each environment's newest step, (B, h); steps in the cache are not decoded again.

        In a batch of at least `least_rows` an environment's output does not depend on the others, not even in rounding:
        groups with fewer new steps are filled up with copies, and all keys of the cache always take part. (Measured on
        two kinds of CPU with `hidden` 96 and 512. With layers of odd widths, such as `hidden` 32 has, it does.)
        """
        newest = torch.empty_like(commands[0])
        groups: dict[tuple[int, bool], list[int]] = {}  # environments with the same number of new steps
        for i, (history, held) in enumerate(zip(self._histories, self._cache.steps, strict=True)):
            groups.setdefault((len(history.contexts) - held, held == 0), []).append(i)
        for (new, _), members in groups.items():
            # A product has a row for each new step of each environment.
            least = min(len(self._histories), -(-self.least_rows // new))
            members = members + members[:1] * (least - len(members))
            cache = self._cache.add(members, new)
            histories = [self._histories[i] for i in members]
            contexts = torch.stack([history.contexts[-new:] for history in histories])
            states = torch.stack([history.states[-new:] for history in histories])
            command = commands[0][members], commands[1][members]
            newest[members] = self.network.decode(contexts, states, command, cache)[:, -1]
        return newest

    def _to_action(self, state: Tensor, motion: Tensor, logit: Tensor, mode: Tensor | None) -> Tensor:
        """Actions (B, 7).

        Args:
            state: Robot states (B, 15).
            motion: Scaled motions (B, 6).
            logit: Gripper logits (B,).
            mode: Each environment's place in `CONTROL_MODES`, (B, 1); None for the option `control_mode`.
        """
        config = self.config
        length = torch.tensor([len(history.contexts) for history in self._histories], device=state.device)
        delta = self.scaler.unscale_delta(motion)
        scale = config.position_scale_start - config.position_scale_slope * length / config.window  # Eq 4.8
        position = delta[:, :3] * scale[:, None]
        orientation = delta[:, 3:] * delta.new_tensor([1.0, 1.0, config.yaw_scale])
        gripper = torch.where(logit > 0, 1.0, -1.0)[:, None]
        absolute = state[:, TCP_POSE] + torch.cat([position, orientation], dim=1)
        relative = torch.cat([position / POSITION_UNIT, orientation / ANGLE_UNIT], dim=1).clamp(-1, 1)
        if mode is None:
            mode = torch.full_like(gripper, CONTROL_MODES.index(config.control_mode))
        is_absolute = mode == CONTROL_MODES.index("abs")
        return torch.cat([torch.where(is_absolute, absolute, relative), gripper], dim=1)

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:
        super()._save_pretrained(save_directory, **kwargs)
        if self._losses is not None:
            self._losses.save(save_directory)

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """The card of an uploaded policy: LeRobot's data for the hub's search, our text."""
        card = super().generate_model_card(*args, **kwargs)
        card.text = card_text(self.config, kwargs.get("cfg"))
        return card


def embed_in_parts(encoder: ImageEncoder, pictures: Tensor, size: int = 256) -> Tensor:
    """(N, H, W, 3) -> (N, D), a part at a time: the gradient recomputes a part's activations, since those of all
    pictures of a batch of windows would fill any GPU."""
    return torch.cat([checkpoint(encoder, part, use_reentrant=False) for part in pictures.split(size)])


def _drop_videos(features: dict[str, dict]) -> None:
    """Removes the videos from a dataset's features, in place.

    LeRobot decodes every video among them for each sample, but LanSAR reads embeddings, or pictures that were decoded
    before. The features are the
    dataset's own, looked at for each sample. What a checkpoint holds of them was taken before.
    """
    for name in [name for name, feature in features.items() if feature["dtype"] == "video"]:
        del features[name]
