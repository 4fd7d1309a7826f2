"""Mixtures of discretised logistic distributions: what MCIL and HULC predict of an action.

An action's number in [-1, 1] falls into one of `bins` bins; the probability of a bin is what the mixture has between
its edges, and the outermost bins reach to infinity (Salimans et al. 2017, PixelCNN++).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

NARROWEST = -7.0
"""Logarithm of the smallest scale of a component."""
AT_THE_EDGE = 1e-3
"""Numbers this near to -1 or 1 are in the outermost bin."""


@dataclass
class LogisticMixture:
    """One mixture for each number of each action.

    Attributes:
        logits, means, log_scales: (..., A, K) for A numbers and K components.
        bins: Bins in [-1, 1].
    """

    logits: Tensor
    means: Tensor
    log_scales: Tensor
    bins: int

    def log_prob(self, actions: Tensor) -> Tensor:
        """Logarithm of the probability of the bins that `actions` (..., A) fall into, (...), summed over A."""
        numbers = actions[..., None]
        scaled = torch.exp(-self.log_scales)
        half = 1.0 / (self.bins - 1)
        above, below = (scaled * (numbers - self.means + side) for side in (half, -half))
        inside = torch.sigmoid(above) - torch.sigmoid(below)
        middle = scaled * (numbers - self.means)
        density = middle - self.log_scales - 2 * F.softplus(middle)  # where a bin's share is too small to subtract
        log_share = torch.where(inside > 1e-5, inside.clamp(min=1e-12).log(), density - math.log((self.bins - 1) / 2))
        log_share = torch.where(numbers > 1 - AT_THE_EDGE, -F.softplus(below), log_share)
        log_share = torch.where(numbers < -1 + AT_THE_EDGE, above - F.softplus(above), log_share)
        return torch.logsumexp(log_share + F.log_softmax(self.logits, dim=-1), dim=-1).sum(dim=-1)

    def sample(self) -> Tensor:
        """Random actions, (..., A); they may lie beyond [-1, 1]."""
        chosen = torch.distributions.Categorical(logits=self.logits).sample()[..., None]
        means, log_scales = (part.gather(-1, chosen)[..., 0] for part in (self.means, self.log_scales))
        share = torch.rand_like(means).clamp(1e-5, 1 - 1e-5)
        return means + torch.exp(log_scales) * torch.logit(share)
