"""`--env.type=calvin`: the options of the CALVIN desk in LeRobot's commands, and its vector environments."""

import functools
from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from ..benchmark import LH_MTLC
from ..calvin import CAMERAS, CONTROL_HZ, STEPS_PER_COMMAND
from ..desk import Desk
from ..desk.errors import DeskError
from .calvin import CalvinEnv, environment_state_size


@EnvConfig.register_subclass("calvin")
@dataclass
class CalvinEnvConfig(EnvConfig):
    """The CALVIN desk; see `CalvinEnv` for what each option does.

    Attributes:
        task: `lh_mtlc` for the benchmark's chains, a task's name, or several names separated by commas: LeRobot
            then evaluates one after the other, `--eval.n_episodes` each.
    """

    task: str | None = LH_MTLC
    fps: int = CONTROL_HZ
    scene: str = "D"
    assets: str | None = None
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    control_mode: str = "rel"
    steps_per_command: int = STEPS_PER_COMMAND
    annotations: str | None = None
    results_dir: str | None = None
    renderer: str = "fast"
    perturbation_every: int = 0
    perturbation_scale: float = 0.0
    render_fps: int = CONTROL_HZ
    task_in_state: bool = False

    def __post_init__(self) -> None:
        if self.max_parallel_tasks != 1:
            raise DeskError(
                "--env.max_parallel_tasks must be 1: LeRobot's parallel tasks share one policy object, which would "
                "mix the episodes' histories"
            )
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (7,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (15,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (environment_state_size(self.task_in_state),)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
        for camera in self.cameras:
            if camera not in CAMERAS:
                raise DeskError(f"--env.cameras: {camera!r} is unknown; choose among {', '.join(CAMERAS)}")
            size, key = CAMERAS[camera], f"{OBS_IMAGES}.{camera}"
            self.features[key] = PolicyFeature(FeatureType.VISUAL, (size, size, 3))
            self.features_map[key] = key

    @property
    def gym_id(self) -> str:
        """The id under which the environment is registered with gymnasium."""
        return "lerobot_lansar/Calvin-v0"

    @property
    def gym_kwargs(self) -> dict:
        """Arguments of `CalvinEnv`, without the task."""
        names = (
            "scene",
            "assets",
            "cameras",
            "control_mode",
            "steps_per_command",
            "annotations",
            "results_dir",
            "renderer",
            "perturbation_every",
            "perturbation_scale",
            "task_in_state",
        )
        return {name: getattr(self, name) for name in names} | {"render_fps": self.render_fps}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task: `{task: {0: environment}}`.

        Finished episodes freeze instead of being simulated on. Workers are forked: a fresh interpreter would import
        all of LeRobot (20 s and 0.9 GB each). The first task's are forked here, in `lerobot-eval` before the
        policy exists, the others' when their turn comes.
        """
        tasks = [task.strip() for task in (self.task or LH_MTLC).split(",")]
        makers = {task: [functools.partial(CalvinEnv, task=task, **self.gym_kwargs)] * n_envs for task in tasks}
        if not use_async_envs or n_envs == 1:
            mode = gym.vector.AutoresetMode.NEXT_STEP
            return {
                task: {
                    0: gym.vector.SyncVectorEnv([freeze_after_episode_end(make) for make in made], autoreset_mode=mode)
                }
                for task, made in makers.items()
            }
        if self.renderer.startswith("fast"):  # compiled kernels and meshes are read once, before the fork
            with Desk(self.scene, self.assets, cameras=(), renderer=self.renderer) as desk:
                desk.render()
        envs = {task: ForkedVectorEnv(made) for task, made in makers.items()}
        envs[tasks[0]]._ensure()
        return {task: {0: env} for task, env in envs.items()}  # type: ignore[dict-item]


class ForkedVectorEnv(_LazyAsyncVectorEnv):
    """LeRobot's asynchronous environments that start at first use and freeze finished episodes, in forked workers."""

    _env: gym.vector.AsyncVectorEnv | None

    def _ensure(self) -> None:
        if self._env is None:
            self._env = gym.vector.AsyncVectorEnv(
                [freeze_after_episode_end(make) for make in self._env_fns],
                context="fork",
                autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP,
            )
