"""The networks of MCIL and HULC: picture encoders, goals, plans, and the decoder that acts.

    pictures of a window -> what was seen (B, T, F)
      first step + goal  -> proposal:    distribution of plans, from which a rollout draws
      all steps          -> recognition: distribution of plans, from which training draws
      plan + every step + goal -> decoder: distribution of actions

A goal is the embedding of a command, or the last picture of the window.
"""

import itertools
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal, OneHotCategoricalStraightThrough, kl_divergence

from .mixture import NARROWEST, LogisticMixture


@dataclass
class NetworkConfig:
    """Sizes and kinds; `LatentPlanConfig` explains them."""

    gripper_size: int
    visual_features: int
    command_features: int
    goal_features: int
    hidden: int
    discrete_plan: bool
    plan_size: int
    plan_classes: int
    recognition: str
    recognition_features: int
    recognition_layers: int
    recognition_heads: int
    recognition_dropout: float
    window: int
    mixtures: int
    bins: int
    separate_gripper: bool
    decoder_sees: str
    contrastive: bool


def convolutions() -> nn.Sequential:
    """The three layers that both encoders have (Mnih et al. 2015)."""
    return nn.Sequential(
        *(nn.Conv2d(3, 32, 8, stride=4), nn.ReLU()),
        *(nn.Conv2d(32, 64, 4, stride=2), nn.ReLU()),
        *(nn.Conv2d(64, 64, 3), nn.ReLU()),
    )


def convolved(size: int) -> int:
    """Height and width of what `convolutions` makes of a picture of `size` pixels."""
    for kernel, stride in ((8, 4), (4, 2), (3, 1)):
        size = (size - kernel) // stride + 1
    return size


class StaticEncoder(nn.Module):
    """The static picture as the mean places of 64 kinds of things: (N, 3, H, W) in [-1, 1] -> (N, features)."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.convolutions = convolutions()
        self.head = nn.Sequential(nn.Linear(128, 512), nn.ReLU(), nn.Linear(512, features), nn.LayerNorm(features))

    def forward(self, pictures: Tensor) -> Tensor:
        found = self.convolutions(pictures)
        height, width = found.shape[2:]
        share = found.flatten(2).softmax(dim=-1).unflatten(2, (height, width))
        rows, columns = (torch.linspace(-1, 1, size, device=found.device) for size in (height, width))
        places = torch.stack([share.sum(3) @ rows, share.sum(2) @ columns], dim=-1)  # (N, 64, 2)
        return self.head(places.flatten(1))


class GripperEncoder(nn.Module):
    """(N, 3, H, W) in [-1, 1] -> (N, features)."""

    def __init__(self, size: int, features: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            convolutions(), nn.Flatten(), nn.Linear(64 * convolved(size) ** 2, 128), nn.ReLU()
        )
        self.head = nn.Sequential(nn.Linear(128, 512), nn.ReLU(), nn.Linear(512, features), nn.LayerNorm(features))

    def forward(self, pictures: Tensor) -> Tensor:
        return self.head(self.convolutions(pictures))


class DiscretePlans(nn.Module):
    """Plans are `count` choices among `classes` (HULC, after DreamerV2). `size` numbers, all 0 or 1."""

    def __init__(self, count: int, classes: int) -> None:
        super().__init__()
        self.count, self.classes = count, classes
        self.size = self.parameters_size = count * classes

    def distribution(self, parameters: Tensor) -> Distribution:
        logits = parameters.unflatten(-1, (self.count, self.classes))
        return Independent(OneHotCategoricalStraightThrough(logits=logits), 1)


class ContinuousPlans(nn.Module):
    """Plans are `size` numbers, each from a normal distribution (MCIL)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size, self.parameters_size = size, 2 * size

    def distribution(self, parameters: Tensor) -> Distribution:
        mean, spread = parameters.chunk(2, dim=-1)
        return Independent(Normal(mean, F.softplus(spread) + 1e-4), 1)


class RecurrentRecognition(nn.Module):
    """Plans from a whole window by a recurrent network in both directions (MCIL)."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.rnn = nn.RNN(features, hidden, num_layers=2, bidirectional=True, batch_first=True)
        self.size = 2 * hidden

    def forward(self, seen: Tensor) -> Tensor:
        """(B, T, F) -> (B, size), the last step's output in both directions."""
        return self.rnn(seen)[0][:, -1]


class TransformerRecognition(nn.Module):
    """Plans from a whole window by a transformer (HULC)."""

    def __init__(self, features: int, config: NetworkConfig) -> None:
        super().__init__()
        self.positions = nn.Embedding(config.window, features)
        self.dropout = nn.Dropout(config.recognition_dropout)
        layer = nn.TransformerEncoderLayer(
            features, config.recognition_heads, config.hidden, config.recognition_dropout, batch_first=True
        )
        self.layers = nn.TransformerEncoder(layer, config.recognition_layers, enable_nested_tensor=False)
        self.size = config.recognition_features
        self.widen = nn.Linear(features, self.size)

    def forward(self, seen: Tensor) -> Tensor:
        """(B, T, F) -> (B, size), the mean over the steps."""
        x = self.dropout(seen + self.positions.weight[: seen.shape[1]])
        return self.widen(self.layers(x)).mean(dim=1)


def mlp(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Decoder(nn.Module):
    """Actions from a plan, what is seen at each step, and a goal."""

    def __init__(self, inputs: int, config: NetworkConfig) -> None:
        super().__init__()
        self.rnn = nn.RNN(inputs, config.hidden, num_layers=2, nonlinearity="relu", batch_first=True)
        self.numbers = 6 if config.separate_gripper else 7
        self.components, self.bins = config.mixtures, config.bins
        self.logits, self.means, self.log_scales = (
            nn.Linear(config.hidden, self.numbers * config.mixtures) for _ in range(3)
        )
        self.gripper = nn.Linear(config.hidden, 2) if config.separate_gripper else None

    def forward(self, inputs: Tensor, memory: Tensor | None = None) -> tuple[LogisticMixture, Tensor | None, Tensor]:
        """Distributions of actions.

        Args:
            inputs: (B, T, inputs).
            memory: The recurrent network's state, (2, B, hidden); None at the beginning.

        Returns:
            The mixture of the pose, or of all 7 numbers; logits (B, T, 2) of closing and opening the gripper, if it is
            separate; the new state.
        """
        x, memory = self.rnn(inputs, memory)
        shape = (self.numbers, self.components)
        logits, means, log_scales = (f(x).unflatten(-1, shape) for f in (self.logits, self.means, self.log_scales))
        mixture = LogisticMixture(logits, means, log_scales.clamp(min=NARROWEST), self.bins)
        return mixture, self.gripper(x) if self.gripper is not None else None, memory


class LatentPlanNetwork(nn.Module):
    """All of it; the policy decides what is fed to what."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        features, hidden, goal = 2 * config.visual_features, config.hidden, config.goal_features
        self.static = StaticEncoder(config.visual_features)
        self.gripper = GripperEncoder(config.gripper_size, config.visual_features)
        self.command_goal = nn.Sequential(mlp(config.command_features, hidden, hidden, goal), nn.LayerNorm(goal))
        self.picture_goal = nn.Sequential(mlp(features, hidden, hidden, goal), nn.LayerNorm(goal))
        self.plans = (
            DiscretePlans(config.plan_size, config.plan_classes)
            if config.discrete_plan
            else ContinuousPlans(config.plan_size)
        )
        parameters = self.plans.parameters_size
        self.proposal = nn.Sequential(
            mlp(features + goal, hidden, hidden, hidden, hidden), nn.ReLU(), nn.Linear(hidden, parameters)
        )
        self.recognition: RecurrentRecognition | TransformerRecognition = (
            RecurrentRecognition(features, hidden)
            if config.recognition == "rnn"
            else TransformerRecognition(features, config)
        )
        self.recognized = nn.Linear(self.recognition.size, parameters)
        shown = config.visual_features if config.decoder_sees == "gripper" else features
        self.decoder = Decoder(self.plans.size + shown + goal, config)
        if config.contrastive:  # HULC
            self.match_window = mlp(self.recognition.size, 128, goal)
            self.match_command = mlp(goal, 128, goal)
            self.match_scale = nn.Parameter(torch.tensor(1 / 0.07).log())

    def see(self, static: Tensor, gripper: Tensor) -> Tensor:
        """Pictures of N moments, (N, 3, H, W) each in [-1, 1] -> (N, F)."""
        return torch.cat([self.static(static), self.gripper(gripper)], dim=-1)

    def propose(self, seen: Tensor, goal: Tensor) -> Tensor:
        """Parameters of the plans that suit a goal: what is seen at the beginning (B, F), goal (B, G) -> (B, P)."""
        return self.proposal(torch.cat([seen, goal], dim=-1))

    def draw(self, parameters: Tensor) -> Tensor:
        """A random plan: (B, P) -> (B, plan), with gradients."""
        return self.plans.distribution(parameters).rsample().flatten(1)

    def act(
        self, plan: Tensor, seen: Tensor, goal: Tensor, memory: Tensor | None = None
    ) -> tuple[LogisticMixture, Tensor | None, Tensor]:
        """Actions at each step: plan (B, plan), seen (B, T, F), goal (B, G), memory as `Decoder` has it."""
        if self.config.decoder_sees == "gripper":
            seen = seen[..., self.config.visual_features :]
        steps = seen.shape[1]
        inputs = [plan[:, None].expand(-1, steps, -1), seen, goal[:, None].expand(-1, steps, -1)]
        return self.decoder(torch.cat(inputs, dim=-1), memory)

    def divergence(self, proposed: Tensor, recognized: Tensor, balance: float) -> Tensor:
        """How far proposal and recognition are apart, (): the proposal learns with `balance`, recognition with the
        rest (Hafner et al. 2021, KL balancing)."""
        of = self.plans.distribution
        learn_proposal = kl_divergence(of(recognized.detach()), of(proposed)).mean()
        learn_recognition = kl_divergence(of(recognized), of(proposed.detach())).mean()
        return balance * learn_proposal + (1 - balance) * learn_recognition

    def contrast(self, recognition: Tensor, goal: Tensor) -> Tensor:
        """Loss, (), of telling which window (N, size) belongs to which command's goal (N, G)."""
        windows = F.normalize(self.match_window(recognition), dim=-1)
        commands = F.normalize(self.match_command(goal), dim=-1)
        scores = self.match_scale.exp() * windows @ commands.T
        own = torch.arange(len(scores), device=scores.device)
        return (F.cross_entropy(scores, own) + F.cross_entropy(scores.T, own)) / 2
