"""A policy that is reset in each environment where a command begins, as CALVIN's benchmark does."""

import copy
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from ..command import CommandError
from .stream import Episode


class Stream(Protocol):
    """An environment of the batch: an `EpisodeStream`, or a session of `lansar-record --mode=takeovers`.

    Attributes:
        episode: The one being played, or None when there is none left.
        commands: How many commands have begun, in all episodes.
    """

    episode: Episode | None
    commands: int


class ResetAtCommands(nn.Module):
    """A policy in LeRobot's `rollout`, which itself resets a policy once per batch of episodes.

    LanSAR keeps a history for each environment and can clear one of them (`reset_environments`). It computes the same
    for each in any batch of at least `least_rows` that is a multiple of 4 (the last rows of others can differ in
    rounding), so others are filled up with copies. Other policies keep one queue of predicted actions for the whole
    batch: each environment gets a copy of its own, which shares the weights, and a random generator of its own, so that
    what a copy does depends on its episode alone.

    Args:
        policy: In evaluation mode.
        streams: The environments of the batch, in order.
    """

    def __init__(self, policy: PreTrainedPolicy, streams: Sequence[Stream]):
        super().__init__()
        policy.reset()
        self._policy, self._streams = policy, streams
        self._begun = [0] * len(streams)
        self._in_batch = hasattr(policy, "reset_environments")
        self._copies = [] if self._in_batch else [_Copy(policy) for _ in streams]

    def reset(self) -> None:
        """Called by `rollout` at its beginning, which is not that of an episode: nothing is forgotten."""

    def select_action(self, batch: dict[str, Any]) -> Tensor:
        """(B, 7) actions; see the policy's own.

        Raises:
            CommandError: The policy needs a copy for each environment, but its batch cannot be divided.
        """
        environments = len(self._streams)
        new = [i for i, stream in enumerate(self._streams) if stream.commands != self._begun[i]]
        self._begun = [stream.commands for stream in self._streams]
        if self._in_batch:
            wanted = max(self._policy.least_rows, environments + -environments % 4)  # type: ignore[call-overload]
            rows = [*range(environments), *[0] * (wanted - environments)]
            self._policy.reset_environments(k for k, i in enumerate(rows) if i in new)  # type: ignore[operator]
            return self._policy.select_action(_rows(batch, rows, environments))[:environments]
        for i in new:
            self._copies[i].begin(self._streams[i])
        actions = [each.select_action(_rows(batch, [i], environments)) for i, each in enumerate(self._copies)]
        return torch.cat(actions)


class _Copy:
    """A policy for one environment."""

    def __init__(self, policy: PreTrainedPolicy):
        shared = {id(parameter): parameter for parameter in policy.parameters()}
        self._policy = copy.deepcopy(policy, shared)
        device = torch.device(policy.config.device or "cpu")
        self._devices = [device] if device.type == "cuda" else []
        self._playing: Any = None
        self._stream: Stream | None = None
        self._random: list[Tensor] = []
        self._last: Tensor | None = None

    def begin(self, stream: Stream) -> None:
        """Begins a command, which may be an episode's first."""
        self._policy.reset()
        self._stream = stream
        if stream.episode is not None and stream.episode is not self._playing:
            self._playing = stream.episode
            with torch.random.fork_rng(self._devices):
                torch.manual_seed(stream.episode.seed)
                self._random = self._states()

    def select_action(self, batch: dict[str, Any]) -> Tensor:
        """(1, 7) the action; the last one again when there is no episode left."""
        assert self._stream is not None
        if self._stream.episode is None and self._last is not None:
            return self._last
        with torch.random.fork_rng(self._devices):
            torch.set_rng_state(self._random[0])
            for device, state in zip(self._devices, self._random[1:], strict=True):
                torch.cuda.set_rng_state(state, device)
            self._last = self._policy.select_action(batch)
            self._random = self._states()
        return self._last

    def _states(self) -> list[Tensor]:
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state(device) for device in self._devices)]


def _rows(batch: dict[str, Any], rows: list[int], environments: int) -> dict[str, Any]:
    """Some environments' part of a batch."""
    if rows == list(range(environments)):
        return batch
    chosen: dict[str, Any] = {}
    for key, value in batch.items():
        if isinstance(value, Tensor) and value.ndim:
            if len(value) != environments:
                raise CommandError(
                    f"the policy's {key} is {tuple(value.shape)} for {environments} environments and cannot be divided "
                    "among them: give --eval.batch_size=1 (lansar-record: --batch_size=1)"
                )
            chosen[key] = value[rows]
        elif isinstance(value, list) and len(value) == environments:
            chosen[key] = [value[row] for row in rows]
        else:
            chosen[key] = value
    return chosen
