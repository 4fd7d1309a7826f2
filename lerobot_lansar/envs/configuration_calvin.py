"""``--env.type=calvin``: the options of the CALVIN desk in LeRobot's commands, and its vector environments."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from ..desk.cameras import CAMERAS
from ..desk.errors import DeskError
from .calvin import LH_MTLC, CalvinEnv


@EnvConfig.register_subclass("calvin")
@dataclass
class CalvinEnvConfig(EnvConfig):
    """The CALVIN desk; see :class:`~lerobot_lansar.envs.calvin.CalvinEnv` for what each option does.

    Attributes:
        task: ``lh_mtlc`` for the benchmark's chains, a task's name, or several names separated by commas: LeRobot
            then evaluates one after the other, ``--eval.n_episodes`` each.
    """

    task: str | None = LH_MTLC
    fps: int = 30
    scene: str = "D"
    assets: str | None = None
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    control_mode: str = "rel"
    steps_per_command: int = 360
    annotations: str | None = None
    results_dir: str | None = None
    render_fps: int = 30

    def __post_init__(self) -> None:
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (7,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (15,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (24,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
        for camera in self.cameras:
            if camera not in CAMERAS:
                raise DeskError(f"--env.cameras: {camera!r} is unknown; choose among {', '.join(CAMERAS)}")
            size, key = CAMERAS[camera].size, f"{OBS_IMAGES}.{camera}"
            self.features[key] = PolicyFeature(FeatureType.VISUAL, (size, size, 3))
            self.features_map[key] = key

    @property
    def gym_id(self) -> str:
        """The id under which the environment is registered with gymnasium."""
        return "lerobot_lansar/Calvin-v0"

    @property
    def gym_kwargs(self) -> dict:
        """Arguments of :class:`CalvinEnv`, without the task."""
        names = (
            "scene",
            "assets",
            "cameras",
            "control_mode",
            "steps_per_command",
            "annotations",
            "results_dir",
        )
        return {name: getattr(self, name) for name in names} | {"render_fps": self.render_fps}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task: ``{task: {0: environment}}``.

        Finished episodes freeze instead of being simulated on, and workers are forked here, before a policy
        exists: a fresh interpreter would import all of LeRobot (20 s and 0.9 GB each).
        """
        tasks = [task.strip() for task in (self.task or LH_MTLC).split(",")]
        return {task: {0: self._vector_env(task, n_envs, use_async_envs)} for task in tasks}

    def _vector_env(self, task: str, n_envs: int, use_async_envs: bool) -> gym.vector.VectorEnv:
        make: Callable[[], gym.Env] = functools.partial(CalvinEnv, task=task, **self.gym_kwargs)
        makers = [freeze_after_episode_end(make)] * n_envs
        mode = gym.vector.AutoresetMode.NEXT_STEP
        if use_async_envs and n_envs > 1:
            return gym.vector.AsyncVectorEnv(makers, context="fork", autoreset_mode=mode)
        return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
