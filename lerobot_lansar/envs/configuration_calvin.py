"""`--env.type=calvin`: the options of the CALVIN desk in LeRobot's commands."""

import functools
from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.configs import DEFAULT_DEPTH_UNIT
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE, OBS_STR

from ..benchmark import LH_MTLC
from ..calvin import CAMERAS, CONTROL_HZ, ROBOT_OBS_NAMES, STEPS_PER_COMMAND
from ..command import CommandError
from ..desk import Desk
from ..desk.assets import find_assets
from ..desk.render import OURS
from ..desk.scenes import get_scene
from ..pictures import check_size
from .calvin import LARGEST_RENDER, CalvinEnv
from .command_line import (
    check_policy,
    evaluated_policy,
    refuse_recording,
    trained_depth_unit,
)
from .pictures import Pictures, camera_keys, depth_key
from .spaces import ACTION_SIZE, EnvironmentState
from .suites import suites
from .vector import ForkedVectorEnv, SerialVectorEnv


@EnvConfig.register_subclass("calvin")
@dataclass
class CalvinEnvConfig(EnvConfig):
    """The CALVIN desk. The comment above each option is its help text; `CalvinEnv` documents the environment.

    Raises:
        CommandError: An option cannot be used. LeRobot's commands end with its message; that of a ValueError would
            stand above a long traceback.
    """

    # lh_mtlc for the benchmark's chains, a task's name, a group (rotate, push, slider, drawer, lift, place, stack,
    # lights), all for the 34 tasks, or several of these separated by commas. LeRobot evaluates one task after the
    # other, --eval.n_episodes each.
    task: str | None = LH_MTLC
    # Control steps per second: 30, nothing else.
    fps: int = CONTROL_HZ
    # A, B, C or D; the benchmark is defined on D.
    scene: str = "D"
    # The data folder of a calvin_env checkout, to use CALVIN's own files; by default the built-in desk.
    assets: str | None = None
    # Pictures in the observation: [static,gripper], one of them, or [] (three to five times as fast).
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    # rel: actions are differences to a target pose, in units of 0.02 m and 0.05 rad; abs: the TCP's pose to go to.
    control_mode: str = "rel"
    # Control steps that a command may take before the episode has failed.
    steps_per_command: int = STEPS_PER_COMMAND
    # YAML file of sentences by task, in CALVIN's format; by default our own sentences, held out for evaluation.
    annotations: str | None = None
    # Which sentence commands a task: first, as in CALVIN, or random, drawn anew for each command by the episode's seed.
    sentence: str = "first"
    # Folder in which a line is appended to episodes.jsonl for every finished episode; use a new one per evaluation.
    results_dir: str | None = None
    # gl (the look of CALVIN's public data), tiny (TinyRenderer's look), or PyBullet's own: pybullet_gl, pybullet_tiny.
    renderer: str = "gl"
    # Perturb the position difference of every perturbation_every-th action; needs perturbation_scale. 0: none.
    perturbation_every: int = 0
    # Standard deviation of that perturbation, as a multiple of the action's own position difference.
    perturbation_scale: float = 0.0
    # New pictures per second in LeRobot's videos, from 1 to 30; fewer save time.
    render_fps: int = CONTROL_HZ
    # Give the simulator's own state of the scene in environment_state; without, only pictures show the blocks.
    scene_state: bool = True
    # Add 34 numbers to environment_state, 1 for the commanded task and 0 for the others: for policies that read no
    # language, trained on what lansar-convert --task_in_state=true makes.
    task_in_state: bool = False
    # Add the cameras' depth: observation.images.static_depth and .gripper_depth, one channel each.
    depth: bool = False
    # Unit of depth, mm or m; by default that in which LeRobot trained the policy: --dataset.depth_output_unit, or mm.
    depth_unit: str | None = None
    # Add the cameras' poses and intrinsics: observation.camera_pose.static (4x4 numbers, row by row),
    # observation.camera_intrinsics.static (3x3), and the same for the gripper.
    camera_poses: bool = False
    # Width and height of both cameras' pictures, as in lansar-convert --image_size; 0: 200 and 84, the cameras' own.
    image_size: int = 0
    # Width and height of the pictures in LeRobot's videos; 0: 200, the static camera's own.
    render_size: int = 0

    def __post_init__(self) -> None:
        if self.max_parallel_tasks != 1:
            raise CommandError(
                "--env.max_parallel_tasks must be 1: LeRobot's parallel tasks share one policy object, which would "
                "mix the episodes' histories"
            )
        if self.fps != CONTROL_HZ:
            raise CommandError(
                f"--env.fps must be {CONTROL_HZ}, got {self.fps}: the desk makes {CONTROL_HZ} control steps per "
                "second, as CALVIN does. --env.render_fps sets how many pictures per second the videos have"
            )
        self.suites()
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_SIZE,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(ROBOT_OBS_NAMES),)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        if size := self._environment_state().size:
            self._add("environment_state", OBS_ENV_STATE, FeatureType.ENV, (size,))
        for camera in self.cameras:
            if camera not in CAMERAS:
                raise CommandError(f"--env.cameras: {camera!r} is unknown; choose among {', '.join(CAMERAS)}")
        try:
            self._pictures()
            check_size("render_size", self.render_size, LARGEST_RENDER)
        except ValueError as error:
            raise CommandError(f"--env.{error}") from error
        for camera in self.cameras:
            self._describe(camera)

    def _environment_state(self) -> EnvironmentState:
        return EnvironmentState(self.scene_state, self.task_in_state)

    def _pictures(self) -> Pictures:
        unit = self.depth_unit or DEFAULT_DEPTH_UNIT
        return Pictures(tuple(self.cameras), self.image_size, self.depth, unit, self.camera_poses)

    def _describe(self, camera: str) -> None:
        """Describes what the observation holds of a camera."""
        size, key = self._pictures().size(camera), f"{OBS_IMAGES}.{camera}"
        self._add(key, key, FeatureType.VISUAL, (size, size, 3))
        if self.depth:
            self._add(depth_key(camera), f"{key}_depth", FeatureType.VISUAL, (size, size, 1))
        for key, count in camera_keys(camera).items() if self.camera_poses else ():
            self._add(key, f"{OBS_STR}.{key}", FeatureType.STATE, (count,))

    def _add(self, key: str, policy_key: str, kind: FeatureType, shape: tuple[int, ...]) -> None:
        """Describes an entry of the observation, by its own name and the one that LeRobot gives it."""
        self.features[key] = PolicyFeature(kind, shape)
        self.features_map[key] = policy_key

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
            "sentence",
            "results_dir",
            "renderer",
            "perturbation_every",
            "perturbation_scale",
            "render_fps",
            "scene_state",
            "task_in_state",
            "depth",
            "camera_poses",
            "image_size",
            "render_size",
        )
        unit = self.depth_unit or (trained_depth_unit() if self.depth else DEFAULT_DEPTH_UNIT)
        results_extra = {"policy": evaluated_policy(), "policy_reset": "batch"}
        return {**{name: getattr(self, name) for name in names}, "depth_unit": unit, "results_extra": results_extra}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Processors that change nothing. LeRobot asks for them before the first step, in training too.

        Raises:
            CommandError: An option cannot be used. The command's policy was trained with another `environment_state`
                (`--env.scene_state`, `--env.task_in_state`), or on pictures of another size, or on depth. Or the
                command records what LeRobot would mix up or cannot store.
        """
        refuse_recording(mixed=self.sentence == "random" or LH_MTLC in self.suites(), depth=self.depth)
        check_policy(self._environment_state(), self._pictures())
        self._try()
        return PolicyProcessorPipeline(steps=[]), PolicyProcessorPipeline(steps=[])

    def _try(self) -> None:
        """Refuses what the environments would refuse, of which a training has none before its first evaluation."""
        try:
            for tasks in self.suites().values():
                for task in tasks:
                    CalvinEnv(task=task, **self.gym_kwargs)  # opens no desk
            find_assets(get_scene(self.scene), self.assets)
        except (OSError, ValueError) as error:
            raise CommandError(f"--env: {error}") from error

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task: `{suite: {number of the task in it: environment}}`.

        Finished episodes freeze instead of being simulated further. The workers of the first task are forked here,
        which in `lerobot-eval` is before the policy exists, those of the others when their turn comes.
        """
        make = functools.partial(CalvinEnv, **self.gym_kwargs)
        makers = {
            suite: [[functools.partial(make, task=task)] * n_envs for task in tasks]
            for suite, tasks in self.suites().items()
        }
        if not use_async_envs or n_envs == 1:
            return {suite: dict(enumerate(map(SerialVectorEnv, made))) for suite, made in makers.items()}
        if self.renderer in OURS:  # reads compiled kernels and meshes once, before the fork
            with Desk(self.scene, self.assets, cameras=(), renderer=self.renderer) as desk:
                desk.render()
        envs = {suite: [ForkedVectorEnv(each) for each in made] for suite, made in makers.items()}
        next(iter(envs.values()))[0]._ensure()
        return {suite: dict(enumerate(made)) for suite, made in envs.items()}

    def suites(self) -> dict[str, tuple[str, ...]]:
        """The tasks of `--env.task` by suite, the name by which LeRobot groups its results."""
        return suites(self.task or LH_MTLC)
