"""The decoder's key-value cache: at inference, each control step computes only its new tokens."""

import torch
from torch import Tensor


def token_count(steps: int, prepended: bool) -> int:
    """Decoder tokens of a window of `steps` steps: C and the step itself each time, or C once at the front."""
    if prepended:
        return steps + (steps > 0)
    return 2 * steps


class KeyValueCache:
    """Keys and values of the decoder tokens of several environments, so each control step computes only its new
    tokens. Entries stay valid while positions do not change.

    Args:
        environments: How many environments there are.
        layers, heads, head_size: The decoder's.
        window: Steps that an environment can hold.
        prepended: The command stands once at the front, see `NetworkConfig.command_prepended`.
        like: A parameter of the network, whose dtype and device the cache gets.

    Attributes:
        entries: (layers, 2: self and cross, 2: keys and values, environments, heads, tokens, head_size).
        steps: How many steps each environment holds; set one to 0 to decode its whole window again.
    """

    def __init__(
        self, environments: int, layers: int, heads: int, head_size: int, window: int, prepended: bool, like: Tensor
    ) -> None:
        tokens = token_count(window, prepended)
        self.window, self.prepended = window, prepended
        self.entries = like.new_zeros(layers, 2, 2, environments, heads, tokens, head_size)
        self.steps = [0] * environments

    def clear(self, environment: int) -> None:
        """Forgets all steps of an environment, also what was not finite: masked keys and values still take part."""
        self.steps[environment] = 0
        self.entries[:, :, :, environment] = 0

    def add(self, environments: list[int], steps: int) -> "CacheView":
        """Makes room for the next `steps` steps of each of `environments`, which are then decoded at once.

        An environment may be named several times; it is then decoded as often, with the same result.

        Raises:
            ValueError: The window is full; or, with `prepended`, some of `environments` are empty and others are not.
        """
        held = [self.steps[environment] for environment in environments]
        if max(held) + steps > self.window:
            raise ValueError(f"the window of {self.window} steps is full")
        if self.prepended and len({n > 0 for n in held}) > 1:
            raise ValueError("environments at their first step have one token more than the others")
        first = [token_count(n, self.prepended) for n in held]
        count = token_count(held[0] + steps, self.prepended) - first[0]
        for environment in set(environments):
            self.steps[environment] += steps
        return CacheView(self.entries, environments, first, count)


class CacheView:
    """A `KeyValueCache` as the decoder sees it while it decodes the next t tokens of B environments.

    Args:
        entries: The cache's.
        environments: B indices into it.
        first: The position of the first new token of each of them.
        count: t.

    Attributes:
        positions: (B, t) position in the window of each new token.
        mask: (B, 1, t, s) bool, True where a new token may attend to one of the window's s tokens.
    """

    def __init__(self, entries: Tensor, environments: list[int], first: list[int], count: int) -> None:
        self._entries = entries
        device = entries.device
        self._environments = torch.tensor(environments, device=device)
        neighbours = slice(environments[0], environments[0] + len(environments))
        in_line = environments == list(range(neighbours.start, neighbours.stop))
        self._selection = neighbours if in_line else self._environments  # a slice copies nothing
        self.positions = torch.tensor(first, device=device)[:, None] + torch.arange(count, device=device)
        self.mask = (torch.arange(entries.shape[-2], device=device) <= self.positions[..., None])[:, None]

    def update(self, slot: tuple[int, int], keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Stores the new tokens' keys and values, (B, heads, t, head_size), and returns those of the whole window.

        Args:
            slot: Number of the decoder layer; 0 for its self-attention, 1 for its cross-attention.
            keys, values: Of the new tokens.

        Returns:
            Keys and values, (B, heads, s, head_size) each.
        """
        stored = self._entries[slot]
        for buffer, new in zip(stored, (keys, values), strict=True):
            buffer[self._environments[:, None], :, self.positions] = new.transpose(1, 2)
        return stored[0, self._selection], stored[1, self._selection]
