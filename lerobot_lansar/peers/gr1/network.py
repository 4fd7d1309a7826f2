"""GR-1's network: a causal transformer over commands, states and pictures that asks for actions and later pictures.

    each step: command, state, static patches and picture, gripper patches and picture, [ACT], [OBS], [OBS of gripper]

No token attends to [ACT] and [OBS]; they attend to all else up to their step. So what they are asked does not change
the rest, and an evaluation asks for [ACT] only.
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CAMERAS = ("static", "gripper")
ARM = 6
"""Numbers of the arm's pose, in states and actions."""


@dataclass
class NetworkConfig:
    """Sizes; `GR1Config` explains them."""

    image_encoder: str
    image_encoder_layers: int
    image_size: int
    command_features: int
    hidden: int
    layers: int
    heads: int
    dropout: float
    window: int
    patch_tokens: int
    resampler_layers: int
    resampler_heads: int
    resampler_head_size: int
    picture_layers: int
    picture_heads: int


@dataclass
class Seen:
    """What is known of each step before anything is asked.

    Attributes:
        command: (B, h).
        tokens: (B, T, n, h), all others.
    """

    command: Tensor
    tokens: Tensor


class Resampler(nn.Module):
    """Few tokens from many (Alayrac et al. 2022): patches (N, P, D) -> (N, count, D)."""

    def __init__(self, count: int, size: int, layers: int, heads: int, head_size: int) -> None:
        super().__init__()
        self.latents = nn.Parameter(torch.randn(count, size))
        self.media = nn.Parameter(torch.randn(1, 1, size))
        self.attentions = nn.ModuleList(ResamplerAttention(size, heads, head_size) for _ in range(layers))
        self.mlps = nn.ModuleList(resampler_mlp(size) for _ in range(layers))
        self.norm = nn.LayerNorm(size)

    def forward(self, patches: Tensor) -> Tensor:
        patches = patches + self.media
        latents = self.latents.expand(len(patches), -1, -1)
        for attention, mlp in zip(self.attentions, self.mlps, strict=True):
            latents = latents + attention(patches, latents)
            latents = latents + mlp(latents)
        return self.norm(latents)


class ResamplerAttention(nn.Module):
    """Latents attend to patches and to themselves."""

    def __init__(self, size: int, heads: int, head_size: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_patches, self.norm_latents = nn.LayerNorm(size), nn.LayerNorm(size)
        self.queries = nn.Linear(size, heads * head_size, bias=False)
        self.keys_values = nn.Linear(size, 2 * heads * head_size, bias=False)
        self.out = nn.Linear(heads * head_size, size, bias=False)

    def forward(self, patches: Tensor, latents: Tensor) -> Tensor:
        latents = self.norm_latents(latents)
        every = torch.cat([self.norm_patches(patches), latents], dim=1)
        parts = (self.queries(latents), *self.keys_values(every).chunk(2, dim=-1))
        queries, keys, values = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        found = F.scaled_dot_product_attention(queries, keys, values)
        return self.out(found.transpose(1, 2).flatten(2))


def resampler_mlp(size: int) -> nn.Sequential:
    """The feed-forward part of a resampler's layer."""
    return nn.Sequential(
        nn.LayerNorm(size), nn.Linear(size, 4 * size, bias=False), nn.GELU(), nn.Linear(4 * size, size, bias=False)
    )


class GR1Network(nn.Module):
    """All of it.

    Attributes:
        image_encoder: timm's vision transformer, whose first token is the picture's and whose others are patches'.
        patch: Height and width of a patch, pixels.
        side: Patches in a row of a picture.
    """

    image_encoder: Any
    places: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        import timm  # takes a second, and every command of LeRobot imports the plugin
        from timm.models.vision_transformer import Block

        self.config = config
        hidden = config.hidden
        sizes: dict[str, Any] = {"img_size": config.image_size}
        if config.image_encoder_layers:
            sizes["depth"] = config.image_encoder_layers
        self.image_encoder = timm.create_model(config.image_encoder, pretrained=False, num_classes=0, **sizes)
        size = int(self.image_encoder.num_features)
        self.patch = int(self.image_encoder.patch_embed.patch_size[0])
        self.side = config.image_size // self.patch
        if config.image_size % self.patch:
            raise ValueError(
                f"--policy.image_size={config.image_size} must be a multiple of the {self.patch} pixels of a patch of "
                f"--policy.image_encoder={config.image_encoder}."
            )
        self.resampler = Resampler(
            config.patch_tokens,
            size,
            config.resampler_layers,
            config.resampler_heads,
            config.resampler_head_size,
        )
        self.arm, self.fingers = nn.Linear(ARM, hidden), nn.Linear(2, hidden)
        self.state = nn.Linear(2 * hidden, hidden)
        self.command = nn.Linear(config.command_features, hidden)
        self.pictures = nn.ModuleDict({camera: nn.Linear(size, hidden) for camera in CAMERAS})
        self.patches = nn.ModuleDict({camera: nn.Linear(size, hidden) for camera in CAMERAS})
        self.steps = nn.Embedding(config.window, hidden)
        self.norm_tokens = nn.LayerNorm(hidden)
        self.ask_action = nn.Parameter(torch.randn(1, hidden))
        self.ask_pictures = nn.ParameterDict(
            {camera: nn.Parameter(torch.randn(config.patch_tokens + 1, hidden)) for camera in CAMERAS}
        )
        layer = nn.TransformerEncoderLayer(
            hidden, config.heads, 4 * hidden, config.dropout, "relu", batch_first=True, norm_first=True
        )
        layer.dropout = nn.Dropout(0.0)  # GPT-2 has none between its two linear layers
        self.dropout = nn.Dropout(config.dropout)
        self.transformer = nn.TransformerEncoder(
            layer, config.layers, norm=nn.LayerNorm(hidden), enable_nested_tensor=False
        )
        for layer in self.transformer.layers:  # as GPT-2 begins; torch would make all layers alike
            for weight in layer.parameters():
                if weight.ndim == 2:
                    nn.init.normal_(weight, std=0.02)
            nn.init.zeros_(layer.linear1.bias)
            nn.init.zeros_(layer.linear2.bias)
        # Two linear layers without anything between them, as published.
        self.action_head = nn.Sequential(nn.Linear(hidden, hidden // 2), nn.Linear(hidden // 2, hidden // 2))
        self.arm_action, self.gripper_action = nn.Linear(hidden // 2, ARM), nn.Linear(hidden // 2, 1)
        self.widen = nn.Linear(hidden, hidden)
        self.mask_token = nn.Parameter(torch.zeros(hidden))
        self.register_buffer("places", grid_places(hidden, self.side), persistent=False)
        self.picture_layers = nn.Sequential(
            *(
                Block(hidden, config.picture_heads, 4, qkv_bias=True, norm_layer=nn.LayerNorm)
                for _ in range(config.picture_layers)
            ),
            nn.LayerNorm(hidden),
        )
        self.pixels = nn.Linear(hidden, 3 * self.patch**2)

    def see(self, pictures: Tensor, camera: str) -> Tensor:
        """Pictures of one camera as tokens: (N, 3, S, S), normalised -> (N, 1 + patch_tokens, h)."""
        trained = any(weight.requires_grad for weight in self.image_encoder.parameters())
        with torch.set_grad_enabled(trained and torch.is_grad_enabled()):
            found = self.image_encoder.forward_features(pictures)
        patches = self.patches[camera](self.resampler(found[:, 1:]))
        return torch.cat([patches, self.pictures[camera](found[:, :1])], dim=1)

    def read_state(self, state: Tensor) -> Tensor:
        """robot_obs (..., 15) -> (..., h): the hand's pose, and whether the gripper was told to close or open."""
        is_open = (state[..., -1:] > 0).to(state.dtype)
        return self.state(
            torch.cat([self.arm(state[..., :ARM]), self.fingers(torch.cat([1 - is_open, is_open], -1))], -1)
        )

    def read_command(self, command: Tensor) -> Tensor:
        """(B, D) -> (B, h)."""
        return self.command(command / (command.norm(dim=-1, keepdim=True) + 1e-6))

    def forward(self, seen: Seen, questions: tuple[str, ...]) -> dict[str, Tensor]:
        """What the questions' tokens become.

        Args:
            seen: Of at most `window` steps.
            questions: Among "action", "static" and "gripper".

        Returns:
            Question to (B, T, tokens, h).
        """
        batch, steps, known = seen.tokens.shape[:3]
        time = self.steps.weight[:steps, None]  # (T, 1, h)
        told = torch.cat([seen.command[:, None, None].expand(-1, steps, -1, -1), seen.tokens], dim=2) + time
        asked = {name: self.ask_action if name == "action" else self.ask_pictures[name] for name in questions}
        tokens = torch.cat([told, *(a.expand(batch, steps, -1, -1) for a in asked.values())], dim=2)
        x = self.dropout(self.norm_tokens(tokens.flatten(1, 2)))
        is_question = torch.arange(tokens.shape[2], device=x.device).repeat(steps) > known
        count = len(is_question)
        hidden = torch.ones(count, count, dtype=torch.bool, device=x.device).triu(1) | is_question
        x = self.transformer(x, mask=hidden).unflatten(1, (steps, -1))
        sizes = [known + 1, *(len(a) for a in asked.values())]
        return dict(zip(("", *asked), x.split(sizes, dim=2), strict=True))

    def actions(self, answer: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, 1, h) -> arm (B, T, 6) and the logits of opening the gripper (B, T)."""
        x = self.action_head(answer[:, :, 0])
        return self.arm_action(x), self.gripper_action(x)[..., 0]

    def draw(self, answer: Tensor) -> Tensor:
        """(N, tokens, h) -> patches of a picture, (N, P, pixels), each normalised to mean 0 and deviation 1."""
        blanks = (self.mask_token + self.places).expand(len(answer), -1, -1)
        x = self.picture_layers(torch.cat([self.widen(answer), blanks], dim=1))
        return self.pixels(x[:, answer.shape[1] :])

    def cut(self, pictures: Tensor) -> Tensor:
        """What `draw` should give for pictures (N, 3, S, S): (N, P, pixels)."""
        cells = pictures.unflatten(3, (self.side, self.patch)).unflatten(2, (self.side, self.patch))
        patches = cells.permute(0, 2, 4, 3, 5, 1).flatten(3).flatten(1, 2)
        return (patches - patches.mean(-1, keepdim=True)) / (patches.std(-1, keepdim=True) + 1e-6)


def grid_places(size: int, side: int) -> Tensor:
    """Sines and cosines of each cell of a grid, (side * side, size): half of them for its column, half for its row."""
    rates = 10000.0 ** (-torch.arange(size // 4, dtype=torch.float64) / (size / 4))
    angles = torch.arange(side, dtype=torch.float64)[:, None] * rates
    line = torch.cat([angles.sin(), angles.cos()], dim=1)  # (side, size / 2)
    columns, rows = line.expand(side, -1, -1), line[:, None].expand(-1, side, -1)
    return torch.cat([columns, rows], dim=2).flatten(0, 1).float()
