"""GR-1 for LeRobot: the loss of windows; at inference one action per step from a history per environment."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors.torch import load_file
from torch import Tensor

from ...clip.commands import CLIP_COMMAND
from ...clip.store import IMAGE_FEATURES
from ...datasets import NO_COMMAND
from ...trained_options import check_trained_options
from ..inputs import check_actions, check_control_mode, command_ends, pictures_of, resize, shift
from .configuration_gr1 import GR1Config
from .network import GR1Network, Seen

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's, by which pictures are normalised."""


TRAINED_OPTIONS = (
    "image_encoder",
    "image_encoder_layers",
    "image_encoder_weights",
    "image_size",
    "hidden",
    "layers",
    "heads",
    "window",
    "patch_tokens",
    "resampler_layers",
    "resampler_heads",
    "resampler_head_size",
    "picture_layers",
    "picture_heads",
    "clip",
)
"""Options that must stay as a checkpoint was trained, because its weights depend on them."""


@dataclass
class History:
    """The last steps of one environment under one command: tokens (T, n, h)."""

    command: str
    tokens: Tensor


class GR1Policy(PreTrainedPolicy):
    """GR-1.

    Args:
        config: All options.
        dataset_meta: Given in training; its actions must be relative.

    Raises:
        ValueError, FileNotFoundError: The dataset or the options cannot be used; the message says why.
    """

    config_class = GR1Config
    name = "gr1"
    config: GR1Config

    def __init__(self, config: GR1Config, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self._command_ends: Tensor | None = None  # in training only
        if dataset_meta is not None:
            check_trained_options(config, TRAINED_OPTIONS)
        if dataset_meta is not None and not config.video_only:
            check_actions(dataset_meta.features, config.control_mode)
            self._command_ends = torch.from_numpy(command_ends(dataset_meta.root))
        self.network = GR1Network(config.network)
        if config.image_encoder_weights:
            if dataset_meta is not None and not config.pretrained_path:  # a checkpoint has its own
                load_image_encoder(self.network.image_encoder, config.image_encoder_weights)
            self.network.image_encoder.requires_grad_(False)
        self.register_buffer("_mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("_std", torch.tensor(STD).view(3, 1, 1), persistent=False)
        self.reset()

    def get_optim_params(self) -> Any:
        return [weight for weight in self.parameters() if weight.requires_grad]

    def reset(self) -> None:
        """Forgets all histories."""
        self._histories: list[History] = []

    # ---- training

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The loss of a batch of windows.

        Args:
            batch: Preprocessed: observation.images.* (B, T + later, 3, H, W) in [0, 1], observation.*_is_pad (B, T +
                later), observation.clip.command (B, D); unless `video_only` also observation.state (B, T + later, 15),
                action (B, T, 7), action_is_pad (B, T), task (B sentences) and index (B,).

        Returns:
            The loss, (); its terms.
        """
        config, steps = self.config, self.config.window
        cameras = {"static": config.video_camera} if config.video_only else IMAGE_FEATURES
        pictures = {name: self._prepare(batch[key], name) for name, key in cameras.items()}
        tokens = [self._see(window[:, :steps], name) for name, window in pictures.items()]
        if not config.video_only:
            tokens.insert(0, self.network.read_state(batch[OBS_STATE][:, :steps])[:, :, None])
        questions = (() if config.video_only else ("action",)) + (tuple(pictures) if config.picture_weight else ())
        command = self.network.read_command(batch[CLIP_COMMAND])
        answers = self.network(Seen(command, torch.cat(tokens, dim=2)), questions)
        losses, terms = [], {}
        commanded = self._commanded(batch, command.device)
        if not config.video_only:
            told = torch.tensor([task != NO_COMMAND for task in batch["task"]], device=commanded.device)
            valid, target = ~batch["action_is_pad"] & commanded[:, :steps] & told[:, None], batch[ACTION]
            arm, gripper = self.network.actions(answers["action"])
            opens = (target[..., 6][valid] > 0).float()
            count = max(1, int(valid.sum()))  # of play, a batch may hold no command
            terms["arm_loss"] = F.smooth_l1_loss(arm[valid], target[..., :6][valid], reduction="sum") / (6 * count)
            gripper_loss = F.binary_cross_entropy_with_logits(gripper[valid], opens, reduction="sum")
            terms["gripper_loss"] = gripper_loss / count
            losses += [terms["arm_loss"], config.gripper_weight * terms["gripper_loss"]]
        for name in pictures if config.picture_weight else ():
            # LeRobot's names of these flags follow the dataset's names of the cameras; all of them are the same.
            ended = next(v for k, v in batch.items() if k.startswith("observation.") and k.endswith("_is_pad"))
            valid = ~ended[:, config.later :] & commanded[:, config.later :]
            drawn = self.network.draw(answers[name][valid])
            error = (drawn - self.network.cut(pictures[name][:, config.later :][valid])) ** 2
            # Every process of a training reports the same terms, also where no window reaches so far.
            terms[f"{name}_picture_loss"] = error.sum() / max(1, error.numel())
            losses.append(config.picture_weight * terms[f"{name}_picture_loss"])
        return torch.stack(losses).sum(), {name: term.item() for name, term in terms.items()}

    def _commanded(self, batch: dict[str, Any], device: torch.device) -> Tensor:
        """Which steps of a window are still of its first frame's command, (B, T + later)."""
        steps = torch.arange(self.config.window + self.config.later, device=device)
        if self._command_ends is None:
            return (steps >= 0).expand(len(batch[CLIP_COMMAND]), -1)
        index = batch["index"].flatten().cpu()
        return steps < (self._command_ends[index] - index).to(device)[:, None]

    def _prepare(self, window: Tensor, camera: str) -> Tensor:
        """(B, T, 3, H, W) in [0, 1] -> (B, T, 3, S, S) as the image encoder reads them, in training moved."""
        by = {"static": self.config.static_shift, "gripper": self.config.gripper_shift}[camera]
        pictures = window.flatten(0, 1)
        if self.training:
            pictures = shift(pictures, by, group=window.shape[1])
        pictures = resize(pictures, self.config.image_size, "bicubic")
        return ((pictures - self._mean) / self._std).unflatten(0, window.shape[:2])

    def _see(self, window: Tensor, camera: str) -> Tensor:
        """(B, T, 3, S, S) -> (B, T, tokens, h)."""
        return self.network.see(window.flatten(0, 1), camera).unflatten(0, window.shape[:2])

    # ---- inference

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        raise NotImplementedError("GR-1 predicts one action at a time, no action chunks: use select_action.")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One action per environment.

        Args:
            batch: A preprocessed observation: observation.images.* (B, 3, H, W) in [0, 1], observation.state (B, 15),
                observation.clip.command (B, D), task (B sentences).

        Returns:
            (B, 7): differences in units of (0.02 m, 0.05 rad), and the gripper's command, -1 or +1.

        Raises:
            ValueError: The policy was trained on videos only, or the environment takes absolute actions.
        """
        if self.config.video_only:
            raise ValueError("This GR-1 has learned to predict pictures only: train it with --policy.video_only=false.")
        if self.training:
            self.eval()
        check_control_mode(batch, self.config.control_mode)
        seen = [
            self._see(self._prepare(picture[:, None], camera), camera)
            for camera, picture in zip(IMAGE_FEATURES, pictures_of(batch), strict=True)
        ]
        tokens = torch.cat([self.network.read_state(batch[OBS_STATE])[:, None, None], *seen], dim=2)
        self._remember(tokens, batch["task"])
        commands = self.network.read_command(batch[CLIP_COMMAND])
        actions = torch.empty(len(tokens), 7, device=tokens.device)
        lengths = [len(history.tokens) for history in self._histories]
        for length in set(lengths):  # environments with histories of one length at once
            rows = [i for i, own in enumerate(lengths) if own == length]
            window = torch.stack([self._histories[i].tokens for i in rows])
            answer = self.network(Seen(commands[rows], window), ("action",))["action"]
            arm, gripper = self.network.actions(answer[:, -1:])
            actions[rows] = torch.cat([arm[:, 0].float(), torch.where(gripper > 0, 1.0, -1.0)], dim=1)
        return actions

    def _remember(self, tokens: Tensor, commands: list[str]) -> None:
        """Adds one step (B, 1, n, h) to the histories; a new command begins a new one."""
        if len(self._histories) != len(commands):
            self._histories = [History("", tokens.new_empty(0, *tokens.shape[2:])) for _ in commands]
        for history, command, step in zip(self._histories, commands, tokens, strict=True):
            if history.command != command:
                history.command, history.tokens = command, history.tokens[:0]
            history.tokens = torch.cat([history.tokens, step])[-self.config.window :]


def load_image_encoder(encoder: torch.nn.Module, file: str) -> None:
    """Loads weights of a vision transformer, in timm's format or MAE's.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds other weights.
    """
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"--policy.image_encoder_weights={file}: there is no such file.")
    weights: dict[str, Any] = (
        load_file(path) if path.suffix == ".safetensors" else torch.load(path, "cpu", weights_only=True)
    )
    weights = weights.get("model", weights)
    wanted = encoder.state_dict()
    wrong = [name for name, value in wanted.items() if name not in weights or weights[name].shape != value.shape]
    if wrong:
        raise ValueError(
            f"--policy.image_encoder_weights={file} does not fit --policy.image_encoder: {len(wrong)} of "
            f"{len(wanted)} arrays are missing or of another shape, the first is {wrong[0]}."
        )
    encoder.load_state_dict({name: weights[name] for name in wanted})
