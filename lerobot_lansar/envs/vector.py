"""Vector environments as LeRobot's evaluation needs them: finished episodes freeze, workers start at first use.

LeRobot has helpers for both, under private names that change between its versions; these are our own. From LeRobot they
need nothing, and it finds in them what it looks for: `call`, `envs`, `unwrapped.metadata` and `_ensure`.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
from gymnasium.vector.utils import batch_space

NEW_EPISODE = "lerobot_lansar_new_episode"
"""Option with which our vector environments reset: it tells their resets from gymnasium's automatic ones."""


class FreezeAtEnd(gym.Wrapper):
    """Repeats the end of an episode, with reward 0, until the vector environment is reset.

    LeRobot steps all environments of a batch until the last episode is over. Gymnasium meanwhile resets those that
    finished earlier and runs them on, in episodes that LeRobot throws away. Here they cost nothing.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self._end: tuple[Any, float, bool, bool, dict[str, Any]] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode, or repeats the end of the last one if this is gymnasium's automatic reset."""
        if self._end is not None and NEW_EPISODE not in (options or {}):
            observation, *_, info = self._end
            return observation, info
        self._end = None
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One step, or the end of the episode again if it is over."""
        if self._end is not None:
            return self._end
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self._end = (observation, 0.0, terminated, truncated, info)
        return observation, reward, terminated, truncated, info


class SerialVectorEnv(gym.vector.SyncVectorEnv):
    """Environments stepped one after the other in this process; finished episodes freeze.

    Args:
        makers: One function per environment, which makes it.
    """

    def __init__(self, makers: Sequence[Callable[[], gym.Env]]):
        super().__init__(_freezing(makers))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode in every environment."""
        return super().reset(seed=seed, options=_new_episode(options))


class ForkedVectorEnv(gym.vector.VectorEnv):
    """Environments in worker processes, forked at first use; finished episodes freeze.

    Forked, because a fresh interpreter would import all of LeRobot: 20 s and 0.9 GB in each worker. At first use,
    because LeRobot evaluates tasks one after the other, so only one task's workers need to exist at a time. After
    `close`, the next use forks new ones.

    Args:
        makers: One function per environment, which makes it. The first is called here too, for the spaces.
    """

    def __init__(self, makers: Sequence[Callable[[], gym.Env]]):
        self._makers = _freezing(makers)
        self._workers: gym.vector.AsyncVectorEnv | None = None
        self.num_envs = len(makers)
        with closing(makers[0]()) as env:
            self.metadata, self.render_mode = dict(env.metadata), env.render_mode
            self.single_observation_space, self.single_action_space = env.observation_space, env.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def _ensure(self) -> gym.vector.AsyncVectorEnv:
        """Forks the workers if there are none. LeRobot calls it by this name to start the next task's early."""
        if self._workers is None:
            self._workers = gym.vector.AsyncVectorEnv(self._makers, context="fork")
        return self._workers

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode in every environment."""
        return self._ensure().reset(seed=seed, options=_new_episode(options))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step in every environment."""
        return self._ensure().step(actions)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What each environment's method returns, or its attribute."""
        return self._ensure().call(name, *args, **kwargs)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Each environment's attribute."""
        return self.call(name)

    def close(self, **kwargs: Any) -> None:
        """Ends the workers."""
        if self._workers is not None:
            self._workers.close(**kwargs)
            self._workers = None


def _new_episode(options: dict[str, Any] | None) -> dict[str, Any]:
    return {**(options or {}), NEW_EPISODE: True}


def _freezing(makers: Sequence[Callable[[], gym.Env]]) -> list[Callable[[], gym.Env]]:
    return [lambda make=make: FreezeAtEnd(make()) for make in makers]  # type: ignore[misc]
