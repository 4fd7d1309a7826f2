"""lansar-desk's image encoder: convolutions, and where in the picture each of their features is found.

The places are those of a spatial softmax (Levine et al. 2016, equation 3), as in the encoders of CALVIN's baselines.
They are exact to a part of a cell, of which a picture of 112 pixels has 28 x 28; CLIP's residual network keeps 4 x 4.
timm knows the encoder by its name, from where open_clip takes it (`timm_model_name`).
"""

import torch
from timm.models import register_model
from torch import Tensor, nn

WIDTH = 48
"""Channels of the convolutions."""
POINTS = 64
"""Features whose place is looked for."""
THINGS = 4
"""The first features are the red, the blue and the pink block and the TCP: training says so."""


class Residual(nn.Module):
    """Adds what two convolutions make of (B, C, H, W), at first nothing.

    Nothing is normalised: statistics of a batch would be those of two cameras, mixed.
    """

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        near = nn.Conv2d(channels, channels, 3, padding=1)
        far = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
        nn.init.zeros_(far.weight)
        self.change = nn.Sequential(nn.ReLU(), near, nn.ReLU(), far)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        changed: Tensor = x + self.change(x)
        return changed


class Keypoints(nn.Module):
    """Normalised pictures (B, 3, S, S) -> (B, D).

    Args:
        embed_dim: D, more than 44.

    Attributes:
        maps: The convolution that scores each of the features in each cell, (B, POINTS, S / 4, S / 4).
        sharpness: What scores are multiplied by before the softmax over the cells, (POINTS,).
        gain: The size in the embedding of the things' coordinates and of their products, (44,).
    """

    pairs: Tensor

    def __init__(self, embed_dim: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, WIDTH // 2, 5, 2, padding=2),
            nn.ReLU(),
            nn.Conv2d(WIDTH // 2, WIDTH, 3, 2, padding=1),
            Residual(WIDTH, 2),
            Residual(WIDTH, 4),
            nn.ReLU(),
        )
        self.maps = nn.Conv2d(WIDTH, POINTS, 1)
        self.sharpness = nn.Parameter(torch.full((POINTS,), 5.0))
        pairs = torch.triu_indices(2 * THINGS, 2 * THINGS)
        self.register_buffer("pairs", pairs, persistent=False)
        self.gain = nn.Parameter(torch.ones(2 * THINGS + pairs.shape[1]))
        self.mix = nn.Sequential(
            nn.Linear(3 * POINTS + WIDTH, 2 * embed_dim),
            nn.ReLU(),
            nn.Linear(2 * embed_dim, embed_dim - len(self.gain)),
        )

    def forward(self, x: Tensor) -> Tensor:
        """The things' rows and columns and all products of two of them, then what is mixed of everything.

        A place on the table is nearly a quadratic function of its row and column. Layers that learn it from all
        features learn the places by heart that they are shown.
        """
        x = self.convolutions(x)
        height, width = x.shape[-2:]
        scores = self.maps(x).float()
        shares = self.log_shares(scores).exp().unflatten(-1, (height, width))
        rows, columns = (torch.linspace(-1, 1, n, device=x.device) for n in (height, width))
        row, column = shares.sum(3) @ rows, shares.sum(2) @ columns
        found = torch.cat([row, column, scores.amax(dim=(2, 3)), x.float().mean(dim=(2, 3))], dim=1)
        things = torch.cat([row[:, :THINGS], column[:, :THINGS]], dim=1)
        products = things[:, self.pairs[0]] * things[:, self.pairs[1]]
        return torch.cat([torch.cat([things, products], dim=1) * self.gain, self.mix(found)], dim=1)

    def log_shares(self, scores: Tensor) -> Tensor:
        """What `maps` gave -> log of how much of each feature is in each cell, (B, POINTS, H * W)."""
        return (scores.flatten(2) * self.sharpness[:, None]).log_softmax(dim=-1)


@register_model
def lansar_keypoints(
    pretrained: bool = False, num_classes: int = 256, global_pool: str = "", **options: object
) -> Keypoints:
    """As timm and open_clip build models: `num_classes` is the embedding's size, the rest has no meaning here."""
    return Keypoints(num_classes)
