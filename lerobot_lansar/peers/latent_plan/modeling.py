"""MCIL and HULC for LeRobot: the loss of windows; at inference a plan for a second at a time, and its steps."""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from ...clip.commands import CLIP_COMMAND
from ...clip.store import IMAGE_FEATURES
from ...datasets import NO_COMMAND
from ...trained_options import check_trained_options
from ..inputs import check_actions, check_control_mode, command_ends, pictures_of, resize, shift
from .configuration import LatentPlanConfig
from .hand_frame import to_hand, to_world
from .mixture import LogisticMixture
from .network import LatentPlanNetwork

MEAN = STD = 0.5
"""Pictures are fed to the network as (picture - MEAN) / STD."""


TRAINED_OPTIONS = (
    "static_size",
    "gripper_size",
    "visual_features",
    "goal_features",
    "hidden",
    "plan",
    "plan_size",
    "plan_classes",
    "recognition",
    "recognition_layers",
    "recognition_heads",
    "recognition_features",
    "window",
    "mixtures",
    "bins",
    "action_frame",
    "decoder_sees",
    "control_mode",
    "clip",
)
"""Options that must stay as a checkpoint was trained, because its weights depend on them."""


@dataclass
class Rollout:
    """What the environments of a batch are doing.

    Attributes:
        commands: Each environment's sentence.
        steps: Control steps since each one's command began.
        plan, goal: (B, plan) and (B, G).
        memory: The decoder's state, (2, B, hidden).
    """

    commands: list[str | None]
    steps: list[int]
    plan: Tensor
    goal: Tensor
    memory: Tensor


class LatentPlanPolicy(PreTrainedPolicy):
    """A policy that draws a plan from what it sees and its goal, and acts on the plan.

    Args:
        config: All options.
        dataset_meta: Given in training. Its actions' names must be those of `control_mode`; its commands end where its
            frames say.

    Raises:
        ValueError: The dataset or the options cannot be used; the message says why.
    """

    config_class = LatentPlanConfig
    name = "latent_plan"
    config: LatentPlanConfig

    def __init__(self, config: LatentPlanConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self._command_ends: Tensor | None = None  # in training only
        if dataset_meta is not None:
            check_trained_options(config, TRAINED_OPTIONS, ("gripper_weight", "contrastive_weight"))
            check_actions(dataset_meta.features, config.control_mode)
            self._command_ends = torch.from_numpy(command_ends(dataset_meta.root))
        self.network = LatentPlanNetwork(config.network)
        self.reset()

    def get_optim_params(self) -> Any:
        return self.parameters()

    def reset(self) -> None:
        """Forgets all plans."""
        self._rollout: Rollout | None = None

    # ---- training

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The loss of a batch of windows.

        Args:
            batch: Preprocessed: observation.images.* (B, T, 3, H, W) in [0, 1], action (B, T, 7), action_is_pad (B, T),
                observation.clip.command (B, D), task (B sentences), index (B,); for the frame of the hand also
                observation.state (B, T, 15).

        Returns:
            The loss, (); its terms.
        """
        config, network = self.config, self.network
        left, told, command_left = self._frames_left(batch)
        lengths = self._draw_lengths(torch.where(told, torch.minimum(left, command_left), left))
        seen = self._see_windows(batch, lengths)
        actions = self._padded_actions(batch, lengths)
        recognition = network.recognition(seen)
        parameters = network.recognized(recognition)
        goals = {"command": (told, network.command_goal(batch[CLIP_COMMAND]))}
        if config.picture_goals:
            goals["picture"] = (torch.ones_like(told), network.picture_goal(seen[:, -1]))
        # Every process of a training reports the same terms, whatever its batch holds.
        nothing = parameters.sum() * 0
        terms: dict[str, Tensor] = {}
        losses: list[Tensor] = []
        for name, (rows, goal) in goals.items():
            action_loss = divergence = nothing
            if rows.any():
                plan = network.draw(parameters[rows])
                action_loss = self._action_loss(plan, seen[rows], goal[rows], actions[rows])
                proposed = network.propose(seen[rows, 0], goal[rows])
                divergence = network.divergence(proposed, parameters[rows], config.kl_balance)
                losses.append(action_loss + config.kl_weight * divergence)
            terms |= {f"{name}_action_loss": action_loss, f"{name}_kl": divergence}
        loss = torch.stack(losses).mean() if losses else nothing
        if config.contrastive_weight:
            ending = told & (command_left < config.min_window + config.contrastive_starts)
            contrast = network.contrast(recognition[ending], goals["command"][1][ending]) if ending.any() else nothing
            loss = loss + config.contrastive_weight * contrast
            terms["contrastive_loss"] = contrast
        return loss, {name: term.item() for name, term in terms.items()}

    def _frames_left(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
        """What follows each window's first frame, (B,) each: frames to the recording's end, at most T; whether there is
        a command for long enough to learn it; frames to that command's end."""
        left = (~batch["action_is_pad"]).sum(dim=1)
        command_left = left
        if self._command_ends is not None:
            index = batch["index"].flatten().cpu()
            command_left = (self._command_ends[index] - index).to(left.device)
        told = torch.tensor([task != NO_COMMAND for task in batch["task"]], device=left.device)
        return left, told & (command_left >= self.config.min_window), command_left

    def _draw_lengths(self, left: Tensor) -> Tensor:
        """Each window's frames: random in training, as many as there are otherwise."""
        if not torch.is_grad_enabled():
            return left
        span = (left - self.config.min_window + 1).clamp(min=1)
        return torch.minimum(left, self.config.min_window + (torch.rand(len(left), device=left.device) * span).long())

    def _see_windows(self, batch: dict[str, Any], lengths: Tensor) -> Tensor:
        """What is seen at every step of the windows, (B, T, F); after a window's end, what was seen last."""
        steps = torch.arange(self.config.window, device=lengths.device)
        used = steps < lengths[:, None]  # (B, T)
        found = self._see(*(batch[key][used] for key in IMAGE_FEATURES.values()))
        places = (lengths.cumsum(0) - lengths)[:, None] + torch.minimum(steps, lengths[:, None] - 1)
        return found[places]

    def _see(self, static: Tensor, gripper: Tensor) -> Tensor:
        """Pictures (N, 3, H, W) in [0, 1] -> (N, F)."""
        config = self.config
        shifts = (config.static_shift, config.gripper_shift) if self.training else (0, 0)
        sizes = (config.static_size, config.gripper_size)
        shown = [
            (shift(resize(pictures, size), by) - MEAN) / STD
            for pictures, size, by in zip((static, gripper), sizes, shifts, strict=True)
        ]
        return self.network.see(*shown)

    def _padded_actions(self, batch: dict[str, Any], lengths: Tensor) -> Tensor:
        """Actions as they are learned, (B, T, 7): after a window's end the hand stays where it is."""
        actions = batch[ACTION]
        if self.config.action_frame == "hand":
            actions = to_hand(actions, batch[OBS_STATE])
        steps = torch.arange(self.config.window, device=lengths.device)
        last = torch.minimum(steps, lengths[:, None] - 1)
        padded = actions.gather(1, last[..., None].expand(-1, -1, 7))
        if self.config.control_mode == "rel":
            padded = torch.cat([padded[..., :6] * (steps < lengths[:, None])[..., None], padded[..., 6:]], dim=-1)
        return padded

    def _action_loss(self, plan: Tensor, seen: Tensor, goal: Tensor, actions: Tensor) -> Tensor:
        mixture, logits, _ = self.network.act(plan, seen, goal)
        if logits is None:
            return -mixture.log_prob(actions).mean()
        gripper = F.cross_entropy(logits.flatten(0, 1), (actions[..., 6] > 0).long().flatten())
        return -mixture.log_prob(actions[..., :6]).mean() + self.config.gripper_weight * gripper

    # ---- inference

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        raise NotImplementedError("this policy predicts one action at a time, no action chunks: use select_action.")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One random action per environment, as published.

        Args:
            batch: A preprocessed observation: observation.images.* (B, 3, H, W) in [0, 1], observation.clip.command
                (B, D), task (B sentences); for the frame of the hand also observation.state (B, 15).

        Returns:
            (B, 7), still to be postprocessed; the gripper's command is -1 or +1.

        Raises:
            ValueError: The environment takes actions of the other control mode.
        """
        if self.training:
            self.eval()
        check_control_mode(batch, self.config.control_mode)
        seen = self._see(*pictures_of(batch))
        rollout = self._with_plans(seen, batch[CLIP_COMMAND], batch["task"])
        mixture, logits, rollout.memory = self.network.act(rollout.plan, seen[:, None], rollout.goal, rollout.memory)
        return self._to_action(mixture, logits, batch.get(OBS_STATE))

    def _with_plans(self, seen: Tensor, commands: Tensor, sentences: list[str]) -> Rollout:
        """The rollout with a new plan wherever a command has changed or the plan is old."""
        network, count = self.network, len(sentences)
        if self._rollout is None or len(self._rollout.commands) != count:
            plan, goal = (seen.new_zeros(count, size) for size in (network.plans.size, self.config.goal_features))
            self._rollout = Rollout(
                [None] * count, [0] * count, plan, goal, seen.new_zeros(2, count, self.config.hidden)
            )
        rollout = self._rollout
        new = []
        for i, sentence in enumerate(sentences):
            rollout.steps[i] = rollout.steps[i] + 1 if rollout.commands[i] == sentence else 0
            rollout.commands[i] = sentence
            if rollout.steps[i] % self.config.replan_steps == 0:
                new.append(i)
        if new:
            rollout.goal[new] = network.command_goal(commands[new])
            rollout.plan[new] = network.draw(network.propose(seen[new], rollout.goal[new]))
            rollout.memory[:, new] = 0
        return rollout

    def _to_action(self, mixture: LogisticMixture, logits: Tensor | None, state: Tensor | None) -> Tensor:
        numbers = mixture.sample()[:, 0]
        gripper = numbers[:, 6] if logits is None else logits[:, 0, 1] - logits[:, 0, 0]
        action = torch.cat([numbers[:, :6], torch.where(gripper > 0, 1.0, -1.0)[:, None]], dim=1)
        if self.config.action_frame == "hand":
            assert state is not None
            action = to_world(action, state)
        return action
