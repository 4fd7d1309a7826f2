"""`--env.type=calvin`: the options of the CALVIN desk in LeRobot's commands, and its vector environments."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from ..benchmark import LH_MTLC
from ..calvin import CAMERAS, CONTROL_HZ, ROBOT_OBS_NAMES, STEPS_PER_COMMAND
from ..desk import Desk, DeskError
from .calvin import CalvinEnv
from .spaces import ACTION_SIZE, environment_state_size


@EnvConfig.register_subclass("calvin")
@dataclass
class CalvinEnvConfig(EnvConfig):
    """The CALVIN desk. The comment above each option is its help text; `CalvinEnv` documents the environment."""

    # lh_mtlc for the benchmark's chains, a task's name, or several names separated by commas: LeRobot then evaluates
    # one after the other, --eval.n_episodes each.
    task: str | None = LH_MTLC
    # Control steps per second, for LeRobot's information: the desk always runs at 30.
    fps: int = CONTROL_HZ
    # A, B, C or D; the benchmark is defined on D.
    scene: str = "D"
    # The data folder of a calvin_env checkout, to use CALVIN's own files; by default the built-in desk.
    assets: str | None = None
    # Pictures in the observation: [static,gripper], one of them, or [] (two to three times as fast).
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    # rel: actions are differences to a target pose, in units of 0.02 m and 0.05 rad; abs: the TCP's pose to go to.
    control_mode: str = "rel"
    # Control steps that a command may take before the episode has failed.
    steps_per_command: int = STEPS_PER_COMMAND
    # YAML file of sentences by task, in CALVIN's format; by default our own sentences, held out for evaluation.
    annotations: str | None = None
    # Folder in which a line is appended to episodes.jsonl for every finished episode; use a new one per evaluation.
    results_dir: str | None = None
    # fast, fast_gl (the look of CALVIN's public data), or PyBullet's own: tiny, egl.
    renderer: str = "fast"
    # Perturb the position difference of every perturbation_every-th action; needs perturbation_scale. 0: none.
    perturbation_every: int = 0
    # Standard deviation of that perturbation, as a multiple of the action's own position difference.
    perturbation_scale: float = 0.0
    # New pictures per second in LeRobot's videos, from 1 to 30; fewer save time.
    render_fps: int = CONTROL_HZ
    # Add 34 numbers to environment_state, 1 for the commanded task and 0 for the others: for policies that read no
    # language, trained on what lansar-convert --task_in_state=true makes.
    task_in_state: bool = False

    def __post_init__(self) -> None:
        if self.max_parallel_tasks != 1:
            raise DeskError(
                "--env.max_parallel_tasks must be 1: LeRobot's parallel tasks share one policy object, which would "
                "mix the episodes' histories"
            )
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_SIZE,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(ROBOT_OBS_NAMES),)),
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
            "render_fps",
            "task_in_state",
        )
        return {name: getattr(self, name) for name in names}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task: `{task: {0: environment}}`.

        Finished episodes freeze instead of being simulated further. Workers are forked, as a fresh interpreter would
        import all of LeRobot (20 s and 0.9 GB each): those of the first task here, which in `lerobot-eval` is before
        the policy exists, those of the others when their turn comes.
        """
        tasks = [task.strip() for task in (self.task or LH_MTLC).split(",")]
        makers = {task: [functools.partial(CalvinEnv, task=task, **self.gym_kwargs)] * n_envs for task in tasks}
        if not use_async_envs or n_envs == 1:
            return {task: {0: gym.vector.SyncVectorEnv(**_freezing(made))} for task, made in makers.items()}
        if self.renderer.startswith("fast"):  # reads compiled kernels and meshes once, before the fork
            with Desk(self.scene, self.assets, cameras=(), renderer=self.renderer) as desk:
                desk.render()
        envs = {task: ForkedVectorEnv(made) for task, made in makers.items()}
        envs[tasks[0]]._ensure()
        return {task: {0: env} for task, env in envs.items()}  # type: ignore[dict-item]


class ForkedVectorEnv(_LazyAsyncVectorEnv):
    """LeRobot's asynchronous environments, started at first use, in forked workers; finished episodes freeze."""

    _env: gym.vector.AsyncVectorEnv | None

    def _ensure(self) -> None:
        if self._env is None:
            self._env = gym.vector.AsyncVectorEnv(**_freezing(self._env_fns), context="fork")


def _freezing(makers: Sequence[Callable[[], gym.Env]]) -> dict[str, Any]:
    """Arguments of a vector environment whose finished episodes freeze."""
    return {
        "env_fns": [freeze_after_episode_end(make) for make in makers],
        "autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP,
    }
