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
    the mean. Here an environment begins the next episode at once.

    Args:
        env: Without `results_dir`.
        episodes: Shared by all environments of the batch: each takes the next one. There is at least one for each.
        results_dir: Each episode gets a line in `episodes.jsonl` there, when its video is written.
        longest: Steps after which `rollout` may stop: more than all episodes can take.
        render_fps: About how many pictures per second a video has.

    Attributes:
        episode: The one being played, or None when there is none left.
        commands: How many commands have begun, in all episodes.
    """

    def __init__(self, env: CalvinEnv, episodes: Iterator[Episode], results_dir: Path, longest: int, render_fps: int):
        super().__init__(env)
        self.episode: Episode | None = None
        self.commands = 0
        self._episodes, self._results_dir = episodes, results_dir
        self._max_episode_steps = longest
        self._film_every = max(1, round(CONTROL_HZ / render_fps))
        self._frames: list[np.ndarray] = []
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins the first episode; `seed` is ignored, since each episode has its own."""
        started = self._begin()
        assert started is not None, "there are no more environments than episodes"
        return started

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step. Where an episode ends, the observation is already the first one of the next."""
        observation, reward, terminated, _, info = self.env.step(action)
        self._film()
        if not terminated:
            self.commands += int(float(reward))
            return observation, float(reward), False, False, info
        self._save()
        started = self._begin()
        if started is None:
            return observation, float(reward), True, False, info
        return started[0], float(reward), False, False, started[1]

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

    def _film(self) -> None:
        """Keeps a picture now and then, if the episode is to be shown."""
        if self.episode is not None and self.episode.video is not None:
            if self._steps % self._film_every == 0:
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
