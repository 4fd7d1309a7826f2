"""The LanSAR network: tensors in, tensors out. It knows nothing of LeRobot, CLIP's weights or the simulator.

Letters in the shape comments:

    B  windows in the batch                     N  valid (not padded) steps of all windows together
    n  steps of the longest window              k  tokens of one timestep, CLS included
    h  hidden size                              D  size of a CLIP embedding

One timestep becomes ONE vector E_t, the context encoder's output at CLS:

    CLS  X  B_red  B_blue  B_pink  S  I  G  (C)      every token sees every other (one timestep at a time)

A window of timesteps becomes two sequences with the command C in front of every step (Eq 3.17, 3.18):

    memory  M = C  E_0  C  E_1  C  E_2 ...           target position i sees target and memory positions <= i:
    target  T = C  X_0  C  X_1  C  X_2 ...
                                                          C X0  C X1
    and the decoder's outputs at the X positions           1  .  .  .   C
    go to the motion head and the gripper head.            1  1  .  .   X_0
                                                           1  1  1  .   C
                                                           1  1  1  1   X_1

Windows are padded at their END only, so the causal mask already hides padding from every valid step and no padding
mask is needed. Padded steps never enter an MLP, where they would distort BatchNorm's statistics.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .cache import CacheView, KeyValueCache, token_count

PACKED = 8
"""Timesteps whose few tokens attend as one sequence on a GPU in training: its attention kernels work on tiles of 64."""
CONTRAST_TEMPERATURE = 0.07  # CLIP's initial temperature


@dataclass
class NetworkConfig:
    """Sizes and choices of the network, built by `LanSARConfig.network`; `LanSARConfig` explains the options."""

    state_dim: int  # numbers in the encoded robot state X
    block_dim: int  # numbers per encoded block B
    scene_dim: int  # numbers in the scene state S
    clip_dim: int  # D
    hidden: int  # h
    context_layers: int
    context_heads: int
    decoder_layers: int
    decoder_heads: int
    feedforward: int
    dropout: float
    window: int  # n at most
    mlp_norm: str  # "batch" or "layer"
    use_images: bool  # tokens I and G in the context
    use_spatial_context: bool  # tokens X, B (three of them) and S in the context
    command_in_context: bool  # token C in the context, and C added to CLS (section 6.5.1)
    command_prepended: bool  # C once at the front of memory and target (Table 5.3)
    contrastive: bool  # `forward` also returns a contrastive loss between commands and windows (section 6.5.1)


class BatchNorm(nn.BatchNorm1d):
    """BatchNorm1d that uses its running statistics for a single row, which has no variance.

    One window gives one row of commands, and an epoch's last batch may be one window.
    """

    def forward(self, x: Tensor) -> Tensor:
        if self.training and x.shape[0] == 1:
            return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)
        return super().forward(x)


def make_norm(kind: str, features: int) -> nn.Module:
    """BatchNorm for "batch", LayerNorm for "layer"."""
    return BatchNorm(features) if kind == "batch" else nn.LayerNorm(features)


def input_mlp(inputs: int, hidden: int, norm: str, dropout: float) -> nn.Sequential:
    """Projects one modality to the hidden size: (N, inputs) -> (N, hidden)."""
    sizes = [inputs, hidden // 3, 2 * hidden // 3, hidden]
    layers: list[nn.Module] = []
    for i in range(3):
        layers += [nn.Linear(sizes[i], sizes[i + 1]), make_norm(norm, sizes[i + 1]), nn.LeakyReLU()]
        if i < 2:
            layers.append(nn.Dropout(dropout))
    return nn.Sequential(*layers)


def head_mlp(hidden: int, outputs: int, norm: str, dropout: float) -> nn.Sequential:
    """Predicts from the decoder's output: (N, hidden) -> (N, outputs)."""
    first = max(hidden - 256, 64)
    second = max(first - 256, 64)
    layers: list[nn.Module] = []
    for a, b in ((hidden, first), (first, second)):
        layers += [nn.Linear(a, b), make_norm(norm, b), nn.Dropout(dropout), nn.LeakyReLU()]
    return nn.Sequential(*layers, nn.Linear(second, outputs))


class Attention(nn.Module):
    """Multi-head attention (Eq 2.4-2.8): queries from `x`, keys and values from `memory`."""

    def __init__(self, hidden: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.query = nn.Linear(hidden, hidden)
        self.key = nn.Linear(hidden, hidden)
        self.value = nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, hidden)

        self.weights: list[Tensor] | None = None  # see `recorded_attention`

    def forward(
        self,
        x: Tensor,
        memory: Tensor,
        causal: bool = False,
        cache: CacheView | None = None,
        slot: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """x (B, t, h), memory (B, s, h) -> (B, t, h). With `cache`, the keys and values in its `slot` precede those of
        `memory`, and its mask is used.
        """
        few = self.training and not causal and cache is None and self.weights is None
        if few and x.is_cuda and len(x) % PACKED == 0:
            return self._packed(x, memory)
        # (B, t, h) -> (B, heads, t, h / heads)
        q = self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        k = self.key(memory).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        v = self.value(memory).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        mask = None
        if cache is not None:
            k, v = cache.update(slot, k, v)
            mask, causal = cache.mask, False
        if self.weights is not None:
            self.weights.append(attention_weights(q, k, mask, causal))
        p = self.dropout if self.training else 0.0
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=p, is_causal=causal)
        return self.out(y.transpose(1, 2).flatten(2))

    def _packed(self, x: Tensor, memory: Tensor) -> Tensor:
        """What `forward` computes without causality, for `PACKED` sequences as if they were one, each seeing itself."""
        t, s = x.shape[1], memory.shape[1]
        q = self.query(x).reshape(-1, PACKED * t, self.heads, x.shape[-1] // self.heads).transpose(1, 2)
        k, v = (
            project(memory).reshape(-1, PACKED * s, self.heads, x.shape[-1] // self.heads).transpose(1, 2)
            for project in (self.key, self.value)
        )
        own = torch.eye(PACKED, dtype=torch.bool, device=x.device)
        mask = own.repeat_interleave(t, dim=0).repeat_interleave(s, dim=1)  # (PACKED * t, PACKED * s)
        p = self.dropout if self.training else 0.0
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=p)
        return self.out(y.transpose(1, 2).reshape(len(x), t, -1))


class FeedForward(nn.Sequential):
    """The MLP of a transformer layer: (..., h) -> (..., h)."""

    def __init__(self, hidden: int, feedforward: int, dropout: float) -> None:
        super().__init__(nn.Linear(hidden, feedforward), nn.ReLU(), nn.Dropout(dropout), nn.Linear(feedforward, hidden))


class EncoderLayer(nn.Module):
    """Post-norm encoder layer; computes what torch.nn.TransformerEncoderLayer does (Eq 2.9, 2.10)."""

    def __init__(self, hidden: int, heads: int, feedforward: int, dropout: float) -> None:
        super().__init__()
        self.attention = Attention(hidden, heads, dropout)
        self.feedforward = FeedForward(hidden, feedforward, dropout)
        self.norm1, self.norm2 = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, queries: int | None = None) -> Tensor:
        """x (N, k, h) -> (N, queries, h): only the first `queries` tokens are updated and returned; None is all."""
        q = x[:, :queries]
        q = self.norm1(q + self.dropout(self.attention(q, x)))
        return self.norm2(q + self.dropout(self.feedforward(q)))


class DecoderLayer(nn.Module):
    """Post-norm decoder layer, causal; computes what torch.nn.TransformerDecoderLayer does (Eq 2.14-2.26)."""

    def __init__(self, hidden: int, heads: int, feedforward: int, dropout: float) -> None:
        super().__init__()
        self.self_attention = Attention(hidden, heads, dropout)
        self.cross_attention = Attention(hidden, heads, dropout)
        self.feedforward = FeedForward(hidden, feedforward, dropout)
        self.norm1, self.norm2, self.norm3 = nn.LayerNorm(hidden), nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, memory: Tensor, cache: CacheView | None = None, layer: int = 0) -> Tensor:
        """x and memory (B, t, h) -> (B, t, h); `layer` is this layer's number in `cache`."""
        attended = self.self_attention(x, x, causal=True, cache=cache, slot=(layer, 0))
        x = self.norm1(x + self.dropout(attended))
        attended = self.cross_attention(x, memory, causal=True, cache=cache, slot=(layer, 1))
        x = self.norm2(x + self.dropout(attended))
        return self.norm3(x + self.dropout(self.feedforward(x)))


class LanSARNetwork(nn.Module):
    """Predicts motion and gripper at every step of a window from command, robot state, scene and pictures."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = c = config
        h, norm, p = c.hidden, c.mlp_norm, c.dropout

        # Eq 3.5-3.12: one MLP per modality. The three blocks share one; positions tell their tokens apart.
        self.command_memory = input_mlp(c.clip_dim, h, norm, p)
        self.command_target = input_mlp(c.clip_dim, h, norm, p)
        self.state_target = input_mlp(c.state_dim, h, norm, p)
        if c.use_spatial_context:
            self.state_context = input_mlp(c.state_dim, h, norm, p)
            self.block_context = input_mlp(c.block_dim, h, norm, p)
            self.scene_context = input_mlp(c.scene_dim, h, norm, p)
        if c.use_images:
            self.static_context = input_mlp(c.clip_dim, h, norm, p)
            self.gripper_context = input_mlp(c.clip_dim, h, norm, p)

        # Eq 3.13-3.16. CLS is an embedding with one row, so that it is initialised like the positions.
        self.context_tokens = ["CLS"]
        self.context_tokens += ["X", "B_red", "B_blue", "B_pink", "S"] if c.use_spatial_context else []
        self.context_tokens += ["I", "G"] if c.use_images else []
        self.context_tokens += ["C"] if c.command_in_context else []
        self.cls = nn.Embedding(1, h)
        self.context_position = nn.Embedding(len(self.context_tokens), h)
        self.context_layers = nn.ModuleList(
            EncoderLayer(h, c.context_heads, c.feedforward, p) for _ in range(c.context_layers)
        )

        # Eq 3.17-3.23
        length = token_count(c.window, c.command_prepended)
        self.memory_position = nn.Embedding(length, h)
        self.target_position = nn.Embedding(length, h)
        self.decoder_layers = nn.ModuleList(
            DecoderLayer(h, c.decoder_heads, c.feedforward, p) for _ in range(c.decoder_layers)
        )

        if c.contrastive:
            self.window_projection, self.command_projection = nn.Linear(2 * h, h), nn.Linear(h, h)
        # Eq 3.25, 3.26
        self.motion_head = head_mlp(h, 6, norm, p)
        self.gripper_head = head_mlp(h, 1, norm, p)
        self.apply(self._initialise)
        # `compile_transformers` replaces these.
        self._encode_context, self._decode, self._whole_windows = self.encode_context, self.decode, False

    def compile_transformers(self, **options: Any) -> None:
        """Makes `forward` run the two transformers through torch.compile; weights keep their names.

        Both then see whole windows, padding included, so that their shapes are always the same (as long as all batches
        are: `Windows` pads to the longest window there can be). On a GPU, their kernels are launched by CUDA graphs.
        Encoding and decoding of single steps (`encode_context`, `decode`) stay as they are.

        Args:
            options: Of torch.compile.
        """
        options = options or {"mode": "reduce-overhead"}
        self._encode_context = torch.compile(self.encode_context, dynamic=False, **options)
        self._decode = torch.compile(self.decode, dynamic=False, **options)
        self._whole_windows = True

    @staticmethod
    def _initialise(module: nn.Module) -> None:
        """Xavier-uniform weights for linear layers and embeddings, zero biases (Eq 4.1, 4.2)."""
        if isinstance(module, nn.Linear | nn.Embedding):
            nn.init.xavier_uniform_(module.weight)
        if isinstance(module, nn.Linear):
            nn.init.zeros_(module.bias)

    def forward(
        self,
        command: Tensor,
        state: Tensor,
        blocks: Tensor | None,
        scene: Tensor | None,
        valid_steps: Tensor,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
        command_tasks: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Predictions for every valid step of a batch of windows.

        Args:
            command: (B, D) CLIP text embeddings.
            state, blocks, scene: (B, n, state_dim), (B, n, 3, block_dim) and (B, n, scene_dim), all scaled; blocks
                and scene are needed with `use_spatial_context`.
            valid_steps: (N,) int64, which of the B * n steps are not padding, ascending; each window's come first in
                it. Indices, not a mask: no GPU sync to learn the count.
            static, gripper: (B, n, D) CLIP image embeddings, needed with `use_images`.
            command_tasks: (B, tasks) float, 1 for the tasks that each command can mean; needed with `contrastive`.

        Returns:
            Motion (N, 6) and gripper logits (N,) in the order of `valid_steps`; the contrastive loss, None without
            `contrastive` or `command_tasks`.
        """
        batch, n = state.shape[:2]
        state = state.flatten(0, 1)[valid_steps]
        if blocks is not None and scene is not None:
            blocks, scene = blocks.flatten(0, 1)[valid_steps], scene.flatten(0, 1)[valid_steps]
        if static is not None and gripper is not None:
            static, gripper = static.flatten(0, 1)[valid_steps], gripper.flatten(0, 1)[valid_steps]
        commands = self.encode_command(command)
        modalities = self.encode_modalities(state, blocks, scene, static, gripper)
        states = self.state_target(state)

        def pad(steps: Tensor) -> Tensor:
            """(N, ...) -> (B * n, ...), zeros where there is padding."""
            return steps.new_zeros(batch * n, *steps.shape[1:]).index_copy(0, valid_steps, steps)

        if self._whole_windows:
            contexts = self._encode_context(pad(modalities), commands[0].repeat_interleave(n, dim=0))
        else:
            contexts = pad(self._encode_context(modalities, commands[0][valid_steps // n]))
        decoded = self._decode(contexts.unflatten(0, (batch, n)), pad(states).unflatten(0, (batch, n)), commands)
        motion, logit = self.predict(decoded.flatten(0, 1)[valid_steps])
        contrast = None
        if self.config.contrastive and command_tasks is not None:
            seen = modalities.mean(dim=1) + states
            contrast = self.contrastive_loss(command_tasks, commands[0], seen, valid_steps, n)
        return motion, logit, contrast

    def encode_command(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """CLIP text embeddings (B, D) -> C for the memory (and the context), and C for the target: (B, h) each."""
        return self.command_memory(command), self.command_target(command)

    def encode_modalities(
        self,
        state: Tensor,
        blocks: Tensor | None,
        scene: Tensor | None,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
    ) -> Tensor:
        """One token per modality at each of N timesteps (Eq 3.6-3.12).

        Args:
            state, blocks, scene: (N, state_dim), (N, 3, block_dim) for red, blue and pink, and (N, scene_dim), all
                scaled; blocks and scene are read only with `use_spatial_context`.
            static, gripper: (N, D) CLIP embeddings of the two pictures; read only with `use_images`.

        Returns:
            (N, m, h), the m tokens that the configuration has besides CLS and C.
        """
        c = self.config
        tokens = []
        if c.use_spatial_context:
            assert blocks is not None
            assert scene is not None
            blocks = self.block_context(blocks.flatten(0, 1)).unflatten(0, (-1, 3))
            tokens += [self.state_context(state)[:, None], blocks, self.scene_context(scene)[:, None]]
        if c.use_images:
            assert static is not None
            assert gripper is not None
            tokens += [self.static_context(static)[:, None], self.gripper_context(gripper)[:, None]]
        return torch.cat(tokens, dim=1)

    def encode_context(self, modalities: Tensor, command: Tensor) -> Tensor:
        """E_t of N timesteps, each encoded by itself (Eq 3.13-3.16).

        Args:
            modalities: (N, m, h).
            command: (N, h), C of each timestep's window; read only with `command_in_context`.

        Returns:
            (N, h)
        """
        tokens = [self.cls.weight.expand(len(modalities), 1, -1), modalities]
        if self.config.command_in_context:
            # A single layer with C as a token only cannot change what CLS attends to; C in CLS's query can.
            tokens[0] = tokens[0] + command[:, None]
            tokens.append(command[:, None])
        x = torch.cat(tokens, dim=1) + self.context_position.weight  # (N, k, h)
        for i, layer in enumerate(self.context_layers):
            # Only CLS is read at the end, so the last layer need not update the other tokens.
            x = layer(x, queries=1 if i == len(self.context_layers) - 1 else None)
        return x[:, 0]

    def decode(
        self, contexts: Tensor, states: Tensor, command: tuple[Tensor, Tensor], cache: CacheView | None = None
    ) -> Tensor:
        """The decoder's output at every X_t (Eq 3.17-3.24).

        Args:
            contexts: E, (B, n, h); padding may hold anything finite.
            states: X for the target, (B, n, h); likewise.
            command: C for memory and target, (B, h) each, from `encode_command`.
            cache: From `KeyValueCache.add`. The n steps then follow those in the cache; up to rounding, the result is
                the same as when the whole window is decoded.

        Returns:
            (B, n, h)
        """
        n = contexts.shape[1]
        memory = self._add_command(contexts, command[0])
        target = self._add_command(states, command[1])
        if cache is None:
            positions: Tensor | slice = slice(target.shape[1])
        else:
            positions = cache.positions
            # A prepended C is a new token at the first step only.
            memory, target = memory[:, -positions.shape[1] :], target[:, -positions.shape[1] :]
        memory = memory + self.memory_position.weight[positions]
        target = target + self.target_position.weight[positions]
        for i, layer in enumerate(self.decoder_layers):
            target = layer(target, memory, cache, i)
        return target[:, -n:] if self.config.command_prepended else target[:, 1::2]

    def _add_command(self, steps: Tensor, command: Tensor) -> Tensor:
        """(B, n, h) and (B, h) -> C s C s C s ... (B, 2n, h), or prepended C s s s ... (B, 1 + n, h)."""
        if self.config.command_prepended:
            return torch.cat([command[:, None], steps], dim=1)
        return torch.stack([command[:, None].expand_as(steps), steps], dim=2).flatten(1, 2)

    def predict(self, decoded: Tensor) -> tuple[Tensor, Tensor]:
        """(N, h) -> scaled motion (N, 6), position then orientation, and gripper logits (N,), above 0 for open."""
        return self.motion_head(decoded), self.gripper_head(decoded)[:, 0]

    def contrastive_loss(
        self, command_tasks: Tensor, commands: Tensor, seen: Tensor, valid_steps: Tensor, n: int
    ) -> Tensor:
        """Pulls each command towards the windows that carry it out and pushes it from the others (section 6.5.1).

        A window is described by the mean of what is seen in it and by how that changes from its first to its last
        step, before command and perception meet. Windows of the same task are no negatives.

        Args:
            command_tasks: (B, tasks), 1 for the tasks that each command can mean.
            commands: (B, h), C for the memory.
            seen: (N, h), what is seen at each valid step.
            valid_steps: (N,), which of the B * n steps are not padding.
            n: Steps of the longest window.
        """
        batch = len(commands)
        bounds = torch.arange(batch + 1, device=valid_steps.device) * n
        bounds = torch.searchsorted(valid_steps, bounds)  # (B + 1,) where each window begins among the N
        sums = seen.new_zeros(batch, seen.shape[-1]).index_add(0, valid_steps // n, seen)
        mean = sums / bounds.diff()[:, None]
        change = seen[bounds[1:] - 1] - seen[bounds[:-1]]
        windows = F.normalize(self.window_projection(torch.cat([mean, change], dim=1)), dim=1)
        commands = F.normalize(self.command_projection(commands), dim=1)
        logits = commands @ windows.T / CONTRAST_TEMPERATURE
        itself = torch.eye(batch, dtype=torch.bool, device=command_tasks.device)
        matches = ((command_tasks @ command_tasks.T > 0) | itself).float()
        labels = matches / matches.sum(dim=1, keepdim=True)  # (B, B), each row adds up to 1
        return (F.cross_entropy(logits, labels) + F.cross_entropy(logits.T, labels)) / 2

    def new_cache(self, environments: int) -> KeyValueCache:
        """An empty key-value cache for the decoder."""
        c = self.config
        head_size = c.hidden // c.decoder_heads
        return KeyValueCache(
            environments,
            c.decoder_layers,
            c.decoder_heads,
            head_size,
            c.window,
            c.command_prepended,
            like=self.cls.weight,
        )


def attention_weights(q: Tensor, k: Tensor, mask: Tensor | None, causal: bool) -> Tensor:
    """The weights that scaled_dot_product_attention uses but does not return (Eq 2.4): (B, heads, t, s).

    With a mask, s ends with the last token that anything attends to.
    """
    scores = q @ k.transpose(-2, -1) / q.shape[-1] ** 0.5
    if causal:
        mask = torch.ones(scores.shape[-2:], dtype=torch.bool, device=q.device).tril()
    if mask is not None:
        scores = scores.masked_fill(~mask, -torch.inf)[..., : int(mask.sum(dim=-1).max())]
    return scores.softmax(dim=-1)


@contextmanager
def recorded_attention(layers: nn.ModuleList) -> Iterator[dict[str, list[Tensor]]]:
    """Within this context, every call of `layers` also records its attention weights.

    Yields:
        {Name of the Attention module inside `layers`: its weights (B, heads, t, s), one tensor per call}.
    """
    modules = {name: module for name, module in layers.named_modules() if isinstance(module, Attention)}
    records: dict[str, list[Tensor]] = {name: [] for name in modules}
    for name, module in modules.items():
        module.weights = records[name]
    try:
        yield records
    finally:
        for module in modules.values():
            module.weights = None
