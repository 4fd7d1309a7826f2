"""Episodes played one after the other by one environment, without waiting for the others of its batch."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.utils.io_utils import write_video

from ..calvin import CONTROL_HZ
from ..envs import CalvinEnv
from ..envs.episodes import append_episode

STEPS = 300
"""Steps of one call of `rollout`."""


@dataclass(frozen=True)
class Episode:
    """An episode to be played.

    Attributes:
        task: A task, or the benchmark.
        seed: Its reset seed.
        video: The file that is to show it, if any.
    """

    task: str
    seed: int
    video: Path | None = None


class EpisodeStream(gym.Wrapper):
    """Plays episodes until there is none left, to LeRobot's `rollout` as one long episode.

    LeRobot plays a batch of episodes at a time and waits for the longest one, which takes about twice as many steps as
    the mean. Here an environment begins the next episode at once. `rollout` is called again and again for `STEPS`
    steps each, since its bookkeeping looks at all steps so far in every step; a reset goes on with what is under way.

    Args:
        env: Without `results_dir`.
        episodes: Shared by all environments of the batch: each takes the next one. There is at least one for each.
        results_dir: Each episode gets a line in `episodes.jsonl` there, when its video is written.
        render_fps: About how many pictures per second a video has.

    Attributes:
        episode: The one being played, or None when there is none left.
        commands: How many commands have begun, in all episodes.
    """

    def __init__(self, env: CalvinEnv, episodes: Iterator[Episode], results_dir: Path, render_fps: int):
        super().__init__(env)
        self.episode: Episode | None = None
        self.commands = 0
        self._episodes, self._results_dir = episodes, results_dir
        self._max_episode_steps = STEPS  # LeRobot asks for it by this name
        self._current: tuple[Any, dict[str, Any]] | None = None  # observation and info
        self._film_every = max(1, round(CONTROL_HZ / render_fps))
        self._frames: list[np.ndarray] = []
        self._steps = 0

    @property
    def is_over(self) -> bool:
        """Whether all episodes that this environment took are played, and there was no other."""
        return self._current is not None and self.episode is None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins the first episode, or goes on with the one under way; `seed` is ignored: each episode has its own."""
        if self._current is None:
            self._current = self._begin()
        assert self._current is not None, "there are no more environments than episodes"
        return self._current

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step. Where an episode ends, the observation is already the first one of the next."""
        assert self._current is not None
        if self.episode is None:
            observation, info = self._current
            return observation, 0.0, True, False, info
        observation, reward, terminated, _, info = self.env.step(action)
        self._film(at_the_end=terminated)
        self._current = observation, info
        if terminated:
            self._save()
            self._current = self._begin() or self._current
        else:
            self.commands += int(float(reward))
        observation, info = self._current
        return observation, float(reward), self.episode is None, False, info

    def _begin(self) -> tuple[Any, dict[str, Any]] | None:
        """The next episode's first observation and info; None if there is no episode left."""
        self.episode = next(self._episodes, None)
        if self.episode is None:
            return None
        started = self.env.reset(seed=self.episode.seed, options={"task": self.episode.task})
        self.commands += 1
        self._frames, self._steps = [], 0
        self._film()
        return started

    def _film(self, at_the_end: bool = False) -> None:
        """Keeps a picture now and then and of the end, if the episode is to be shown."""
        if self.episode is not None and self.episode.video is not None:
            if at_the_end or self._steps % self._film_every == 0:
                self._frames.append(self.env.render())  # type: ignore[arg-type]
            self._steps += 1

    def _save(self) -> None:
        """Writes the episode's video and line. The line comes last: an episode that has one is not played again."""
        if self.episode is not None and self.episode.video is not None:
            file = self.episode.video
            file.parent.mkdir(parents=True, exist_ok=True)
            partial = file.with_name(f".{file.name}")
            write_video(partial, self._frames, round(CONTROL_HZ / self._film_every))
            partial.rename(file)
        append_episode(self._results_dir, self.unwrapped.result())  # type: ignore[attr-defined]
