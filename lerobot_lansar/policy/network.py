"""The LanSAR network: tensors in, tensors out. Nothing here knows LeRobot, CLIP's weights or the simulator.

Letters used in the shape comments:

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

Windows are padded at their END only. The causal mask therefore already hides padding from every valid step:
no separate padding mask is needed, and no padded step ever enters an MLP (it would poison BatchNorm's
statistics).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn


@dataclass
class NetworkConfig:
    """Sizes and choices of the network; the defaults are Table 4.2 (6 decoder heads do not divide 512: 8).

    Attributes:
        state_dim: Numbers in the encoded robot state X.
        block_dim: Numbers per encoded block B.
        scene_dim: Numbers in the scene state S.
        clip_dim: D, size of the CLIP embeddings of command and images.
        mlp_norm: Normalisation inside the MLPs, "batch" (thesis) or "layer".
        use_images: Tokens I and G take part in the context.
        use_spatial_context: Tokens X, B (x3) and S take part in the context (the decoder's target keeps X
            anyway).
        command_in_context: The command is one more context token (section 6.5.1), and CLS asks with it: what E_t
            keeps of a timestep depends on the command already in the first context layer.
        command_prepended: C stands once at the front of memory and target instead of before every step (Table
            5.3).
        contrastive: `forward` also returns a contrastive loss between commands and windows (section 6.5.1).
    """

    state_dim: int = 15
    block_dim: int = 6
    scene_dim: int = 6
    clip_dim: int = 512
    hidden: int = 512
    context_layers: int = 6
    context_heads: int = 16
    decoder_layers: int = 6
    decoder_heads: int = 8
    feedforward: int = 2048
    dropout: float = 0.1
    window: int = 64
    mlp_norm: str = "batch"
    use_images: bool = True
    use_spatial_context: bool = True
    command_in_context: bool = False
    command_prepended: bool = False
    contrastive: bool = False


CONTRAST_TEMPERATURE = 0.07  # CLIP's initial one


class BatchNorm(nn.BatchNorm1d):
    """BatchNorm1d that uses its running statistics for a single row, which has no variance of its own.

    One window means one command row, and a training run's last batch of an epoch can be one window.
    """

    def forward(self, x: Tensor) -> Tensor:
        if self.training and x.shape[0] == 1:
            return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)
        return super().forward(x)


def make_norm(kind: str, features: int) -> nn.Module:
    return BatchNorm(features) if kind == "batch" else nn.LayerNorm(features)


def input_mlp(inputs: int, hidden: int, norm: str, dropout: float) -> nn.Sequential:
    """One modality to the hidden size: rows (N, inputs) -> (N, hidden)."""
    sizes = [inputs, hidden // 3, 2 * hidden // 3, hidden]
    layers: list[nn.Module] = []
    for i in range(3):
        layers += [nn.Linear(sizes[i], sizes[i + 1]), make_norm(norm, sizes[i + 1]), nn.LeakyReLU()]
        if i < 2:
            layers.append(nn.Dropout(dropout))
    return nn.Sequential(*layers)


def head_mlp(hidden: int, outputs: int, norm: str, dropout: float) -> nn.Sequential:
    """Decoder output to a prediction: rows (N, hidden) -> (N, outputs)."""
    first = max(hidden - 256, 64)
    second = max(first - 256, 64)
    layers: list[nn.Module] = []
    for a, b in ((hidden, first), (first, second)):
        layers += [nn.Linear(a, b), make_norm(norm, b), nn.Dropout(dropout), nn.LeakyReLU()]
    return nn.Sequential(*layers, nn.Linear(second, outputs))


class Attention(nn.Module):
    """Multi-head attention (Eq 2.4-2.8). Keys and values come from `memory`, queries from `x`."""

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
        past: "Past | None" = None,
        slot: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """x (B, t, h), memory (B, s, h) -> (B, t, h). With `past`, keys and values kept in its `slot` come
        before those of `memory`.
        """
        # (B, t, h) -> (B, heads, t, h/heads)
        q = self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        k = self.key(memory).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        v = self.value(memory).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        mask = None
        if past is not None:
            k, v = past.extend(slot, k, v)
            mask, causal = past.mask, False
        if self.weights is not None:
            self.weights.append(attention_weights(q, k, mask, causal))
        p = self.dropout if self.training else 0.0
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=p, is_causal=causal)
        return self.out(y.transpose(1, 2).flatten(2))


def attention_weights(q: Tensor, k: Tensor, mask: Tensor | None, causal: bool) -> Tensor:
    """The weights that scaled_dot_product_attention uses and does not return (Eq 2.4): (B, heads, t, s)."""
    scores = q @ k.transpose(-2, -1) / q.shape[-1] ** 0.5
    if causal:
        mask = torch.ones(scores.shape[-2:], dtype=torch.bool, device=q.device).tril()
    if mask is not None:
        scores = scores.masked_fill(~mask, -torch.inf)
    return scores.softmax(dim=-1)


@contextmanager
def recorded_attention(layers: nn.ModuleList) -> Iterator[dict[str, list[Tensor]]]:
    """Within it every call of `layers` also keeps its attention weights.

    Yields:
        {name of the Attention module inside `layers`: its weights (B, heads, t, s), one tensor per call}
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


class FeedForward(nn.Sequential):
    def __init__(self, hidden: int, feedforward: int, dropout: float) -> None:
        super().__init__(nn.Linear(hidden, feedforward), nn.ReLU(), nn.Dropout(dropout), nn.Linear(feedforward, hidden))


class EncoderLayer(nn.Module):
    """Post-norm encoder layer, the computation of torch.nn.TransformerEncoderLayer (Eq 2.9, 2.10)."""

    def __init__(self, hidden: int, heads: int, feedforward: int, dropout: float) -> None:
        super().__init__()
        self.attention = Attention(hidden, heads, dropout)
        self.feedforward = FeedForward(hidden, feedforward, dropout)
        self.norm1, self.norm2 = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, queries: int | None = None) -> Tensor:
        """x (N, k, h) -> (N, queries, h): only the first `queries` tokens are updated and returned."""
        q = x[:, :queries]
        q = self.norm1(q + self.dropout(self.attention(q, x)))
        return self.norm2(q + self.dropout(self.feedforward(q)))


class DecoderLayer(nn.Module):
    """Post-norm decoder layer, the computation of torch.nn.TransformerDecoderLayer (Eq 2.14-2.26), causal."""

    def __init__(self, hidden: int, heads: int, feedforward: int, dropout: float) -> None:
        super().__init__()
        self.self_attention = Attention(hidden, heads, dropout)
        self.cross_attention = Attention(hidden, heads, dropout)
        self.feedforward = FeedForward(hidden, feedforward, dropout)
        self.norm1, self.norm2, self.norm3 = nn.LayerNorm(hidden), nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, memory: Tensor, past: "Past | None" = None, layer: int = 0) -> Tensor:
        """x and memory (B, t, h) -> (B, t, h); `layer` is this layer's number in `past`."""
        attended = self.self_attention(x, x, causal=True, past=past, slot=(layer, 0))
        x = self.norm1(x + self.dropout(attended))
        attended = self.cross_attention(x, memory, causal=True, past=past, slot=(layer, 1))
        x = self.norm2(x + self.dropout(attended))
        return self.norm3(x + self.dropout(self.feedforward(x)))


class DecoderCache:
    """Keys and values of the decoder tokens of several environments (rows), so that a control step costs its own
    tokens only. A token's keys and values stay right as long as its position in the window does.

    Args:
        config: The network's.
        rows: How many environments.
        like: A parameter; the buffers get its dtype and device.

    Attributes:
        tokens: (layers, 2: self and cross, 2: keys and values, rows, heads, tokens of a full window, h / heads).
        steps: How many steps each row holds; setting one to 0 forgets that row.
    """

    def __init__(self, config: NetworkConfig, rows: int, like: Tensor) -> None:
        heads, width = config.decoder_heads, config.hidden // config.decoder_heads
        room = token_count(config, config.window)
        self.config = config
        self.tokens = like.new_zeros(config.decoder_layers, 2, 2, rows, heads, room, width)
        self.steps = [0] * rows

    def add(self, rows: list[int], steps: int) -> "Past":
        """Makes room for the next `steps` steps of each of `rows`, which are then decoded at once.

        Raises:
            ValueError: The window is full, or `rows` are at their first step and others are not, where the
                command stands once at the front.
        """
        held = [self.steps[row] for row in rows]
        if max(held) + steps > self.config.window:
            raise ValueError(f"the window of {self.config.window} steps is full")
        if self.config.command_prepended and len({n > 0 for n in held}) > 1:
            raise ValueError("rows at their first step have one token more than the others")
        first = [token_count(self.config, n) for n in held]
        count = token_count(self.config, held[0] + steps) - first[0]
        for row in rows:
            self.steps[row] += steps
        return Past(self.tokens, rows, first, count)


class Past:
    """What attention sees of a DecoderCache while the next tokens of some rows are decoded.

    Attributes:
        positions: (B, t) place in the window of each new token.
        mask: (B, 1, t, s) bool, True where a new token may look.
    """

    def __init__(self, tokens: Tensor, rows: list[int], first: list[int], count: int) -> None:
        self.tokens, self.end = tokens, max(first) + count
        device = tokens.device
        self.rows = torch.tensor(rows, device=device)
        in_line = rows == list(range(rows[0], rows[0] + len(rows)))
        self.view = slice(rows[0], rows[0] + len(rows)) if in_line else self.rows  # a slice copies nothing
        self.positions = torch.tensor(first, device=device)[:, None] + torch.arange(count, device=device)
        self.mask = (torch.arange(self.end, device=device) <= self.positions[..., None])[:, None]

    def extend(self, slot: tuple[int, int], keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Keeps new keys and values (B, heads, t, h/heads); returns all of the rows, (B, heads, s, h/heads)."""
        kept = self.tokens[slot]
        for buffer, new in zip(kept, (keys, values), strict=True):
            buffer[self.rows[:, None], :, self.positions] = new.transpose(1, 2)
        return kept[0, self.view, :, : self.end], kept[1, self.view, :, : self.end]


def token_count(config: NetworkConfig, steps: int) -> int:
    """Decoder tokens of a window of so many steps."""
    if config.command_prepended:
        return steps + (steps > 0)
    return 2 * steps


class LanSARNetwork(nn.Module):
    """Command, robot state, scene and pictures of a window in; motion and gripper of every step out."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = c = config
        h, norm, p = c.hidden, c.mlp_norm, c.dropout

        # Eq 3.5-3.12: one MLP per modality; the three blocks share one, their position tells them apart.
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

        # Eq 3.13-3.16. CLS is an embedding of one row, so that it is initialised like the positions.
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
        length = 1 + c.window if c.command_prepended else 2 * c.window
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

    @staticmethod
    def _initialise(module: nn.Module) -> None:
        """Xavier-uniform weights for linear layers and embeddings, zero biases (Eq 4.1, 4.2)."""
        if isinstance(module, nn.Linear | nn.Embedding):
            nn.init.xavier_uniform_(module.weight)
        if isinstance(module, nn.Linear):
            nn.init.zeros_(module.bias)

    def encode_command(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """CLIP text embeddings (B, D) -> C for the memory (and the context) and C for the target, (B, h)
        each."""
        return self.command_memory(command), self.command_target(command)

    def modalities(
        self,
        state: Tensor,
        blocks: Tensor,
        scene: Tensor,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
    ) -> Tensor:
        """What is perceived at N timesteps, one token per modality (Eq 3.6-3.12).

        Args:
            state: (N, state_dim) encoded and scaled robot state.
            blocks: (N, 3, block_dim), red, blue, pink.
            scene: (N, scene_dim).
            static, gripper: (N, D) CLIP embeddings of the two pictures; read only with `use_images`.

        Returns:
            (N, m, h), the m tokens that the configuration admits.
        """
        c = self.config
        tokens = []
        if c.use_spatial_context:
            blocks = self.block_context(blocks.flatten(0, 1)).unflatten(0, (-1, 3))
            tokens += [self.state_context(state)[:, None], blocks, self.scene_context(scene)[:, None]]
        if c.use_images:
            assert static is not None
            assert gripper is not None
            tokens += [self.static_context(static)[:, None], self.gripper_context(gripper)[:, None]]
        return torch.cat(tokens, dim=1)

    def encode_context(self, modalities: Tensor, command: Tensor) -> Tensor:
        """E_t of N timesteps, each on its own (Eq 3.13-3.16).

        Args:
            modalities: (N, m, h).
            command: (N, h) C of each timestep's window; read only with `command_in_context`.

        Returns:
            (N, h)
        """
        tokens = [self.cls.weight.expand(len(modalities), 1, -1), modalities]
        if self.config.command_in_context:
            # A token alone cannot change which of the others CLS attends to in a single layer; its query can.
            tokens[0] = tokens[0] + command[:, None]
            tokens.append(command[:, None])
        x = torch.cat(tokens, dim=1) + self.context_position.weight  # (N, k, h)
        for i, layer in enumerate(self.context_layers):
            # Only CLS is read at the end, so the last layer need not update the other tokens.
            x = layer(x, queries=1 if i == len(self.context_layers) - 1 else None)
        return x[:, 0]

    def decode(
        self, contexts: Tensor, states: Tensor, command: tuple[Tensor, Tensor], past: Past | None = None
    ) -> Tensor:
        """What the decoder says at every X_t (Eq 3.17-3.24).

        Args:
            contexts: E, (B, n, h); steps past a window's end may hold anything finite.
            states: X_target, (B, n, h); likewise.
            command: C for memory and target, (B, h) each, from `encode_command`.
            past: From `DecoderCache.add`, when the n steps are not the window's first ones: the result is then
                the same as that of the whole window, to rounding, at the cost of n steps.

        Returns:
            (B, n, h)
        """
        n = contexts.shape[1]
        memory = self._with_command(contexts, command[0])
        target = self._with_command(states, command[1])
        if past is None:
            positions: Tensor | slice = slice(target.shape[1])
        else:
            positions = past.positions
            memory, target = memory[:, -positions.shape[1] :], target[:, -positions.shape[1] :]
        memory = memory + self.memory_position.weight[positions]
        target = target + self.target_position.weight[positions]
        for i, layer in enumerate(self.decoder_layers):
            target = layer(target, memory, past, i)
        return target[:, -n:] if self.config.command_prepended else target[:, 1::2]

    def _with_command(self, steps: Tensor, command: Tensor) -> Tensor:
        """(B, n, h) and (B, h) -> C s C s C s ... (B, 2n, h), or prepended C s s s ... (B, 1 + n, h)."""
        if self.config.command_prepended:
            return torch.cat([command[:, None], steps], dim=1)
        return torch.stack([command[:, None].expand_as(steps), steps], dim=2).flatten(1, 2)

    def predict(self, decoded: Tensor) -> tuple[Tensor, Tensor]:
        """(N, h) -> scaled motion (N, 6): position then orientation, and gripper logits (N,): > 0 is open."""
        return self.motion_head(decoded), self.gripper_head(decoded)[:, 0]

    def forward(
        self,
        command: Tensor,
        state: Tensor,
        blocks: Tensor,
        scene: Tensor,
        rows: Tensor,
        static: Tensor | None = None,
        gripper: Tensor | None = None,
        group: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Predictions for every valid step of a batch of windows.

        Args:
            command: (B, D) CLIP text embeddings.
            state: (B, n, state_dim); blocks: (B, n, 3, block_dim); scene: (B, n, scene_dim), all scaled.
            rows: (N,) int64, places of the valid steps among the B * n, ascending. The valid steps of a window
                come first in it. Given as numbers and not as a mask, so that a GPU need not tell how many.
            static, gripper: (B, n, D) CLIP image embeddings, needed with `use_images`.
            group: (B, tasks) float, 1 for the tasks that a command asks for; needed with `contrastive`.

        Returns:
            Motion (N, 6) and gripper logits (N,), in the order of `rows`; the contrastive loss, None without
            `contrastive` or `group`.
        """
        batch, n = state.shape[:2]
        state, blocks, scene = (x.flatten(0, 1)[rows] for x in (state, blocks, scene))
        if static is not None and gripper is not None:
            static, gripper = static.flatten(0, 1)[rows], gripper.flatten(0, 1)[rows]
        commands = self.encode_command(command)
        modalities, target = self.modalities(state, blocks, scene, static, gripper), self.state_target(state)
        contexts, states = (
            steps.new_zeros(batch * n, steps.shape[-1]).index_copy(0, rows, steps).unflatten(0, (batch, n))
            for steps in (self.encode_context(modalities, commands[0][rows // n]), target)
        )
        motion, logit = self.predict(self.decode(contexts, states, commands).flatten(0, 1)[rows])
        contrast = None
        if self.config.contrastive and group is not None:
            seen = modalities.mean(dim=1) + target
            contrast = self._contrast(group, commands[0], seen, rows, batch, n)
        return motion, logit, contrast

    def _contrast(self, group: Tensor, projected: Tensor, seen: Tensor, rows: Tensor, batch: int, n: int) -> Tensor:
        """Pulls a command towards the windows that carry it out, away from the others (section 6.5.1).

        A window is described by what is seen in it on average and by how that changes from its first to its
        last step, before command and perception meet. Windows of the same task are not held against it.

        Args:
            group: (B, tasks) 1 for the tasks that a command asks for; projected: (B, h) the commands.
            seen: (N, h) what is perceived at each valid step; rows: (N,) their places; batch: B; n: steps.
        """
        bounds = torch.arange(batch + 1, device=rows.device) * n
        bounds = torch.searchsorted(rows, bounds)  # (B + 1,) where each window begins among the N
        sums = seen.new_zeros(batch, seen.shape[-1]).index_add(0, rows // n, seen)
        mean = sums / bounds.diff()[:, None]
        change = seen[bounds[1:] - 1] - seen[bounds[:-1]]
        windows = F.normalize(self.window_projection(torch.cat([mean, change], dim=1)), dim=1)
        commands = F.normalize(self.command_projection(projected), dim=1)
        logits = commands @ windows.T / CONTRAST_TEMPERATURE
        same = ((group @ group.T > 0) | torch.eye(batch, dtype=torch.bool, device=group.device)).float()
        goal = same / same.sum(dim=1, keepdim=True)
        return (F.cross_entropy(logits, goal) + F.cross_entropy(logits.T, goal)) / 2
