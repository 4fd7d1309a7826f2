"""The CALVIN desk as a gymnasium environment: the long-horizon benchmark, or one task at a time."""

import functools
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..benchmark import LH_MTLC, load_chains
from ..calvin import CAMERAS, CHAIN_LENGTH, CONTROL_HZ, CONTROL_MODES, STEPS_PER_COMMAND, TASKS
from ..desk import Desk, DeskError, Observation, SimulationError, Snapshot, completed_tasks, is_fulfilled
from ..desk.render import RENDERERS
from ..desk.scenes import get_scene
from ..desk.sentences import load_commands
from ..desk.starts import sample_start
from ..pictures import check_size
from .control_mode import refuse_other_mode
from .episodes import append_episode
from .pictures import Pictures
from .spaces import ACTION_SIZE, EnvironmentState, action_space, observation_space, observe

# With an episode's seed: generators apart from the one that draws its start.
_PERTURBATION_STREAM = (4, 9)
_SENTENCE_STREAM = (1,)

_LOOK_EVERY = 5
"""Control steps between looks at whether another task than the commanded one has been fulfilled."""

LARGEST_RENDER = 1024
"""Largest width and height of what `CalvinEnv.render` returns, pixels."""

SENTENCE_CHOICES = ("first", "random")
"""Which of a task's sentences commands it."""


class CalvinEnv(gym.Env):
    """A Panda at a desk with a drawer, a sliding door, a light bulb, an LED and three blocks, commanded in words.

    Description:
        `task="lh_mtlc"` (default): an episode is one chain of CALVIN's benchmark, five commands in a row.
        `task=<name>`: an episode is one command, from a random state in which it is feasible.
        `env.task_description` is the command in force; it changes when a command is fulfilled.

    Action space (7,) at 30 Hz:
        `control_mode="rel"`: TCP translation in units of 0.02 m and rotation (euler xyz) in units of 0.05 rad, both
        nominally within +-1 and added to a target pose, then the gripper. `"abs"`: TCP xyz (m), euler xyz (rad, with
        any number of full turns), gripper. A positive gripper command opens, any other closes.

    Observation space:
        `agent_pos` (15,): CALVIN's robot_obs, but with the euler angles of `continuous_euler`, as in the datasets of
        this package: they do not jump where the arm works. `environment_state` (24,): CALVIN's scene_obs, blocks in
        red, blue, pink order; privileged simulator state. With `task_in_state` 34 numbers follow; without `scene_state`
        those 24 are left out, and the entry if nothing remains. `pixels`: the pictures named by `cameras`, `static`
        (200, 200, 3) and `gripper` (84, 84, 3) uint8. `control_mode` (1,): 0 relative, 1 absolute. With `depth`,
        `images.<camera>_depth` (1, n, n) float32: the distance along the camera's axis, in the form in which LeRobot
        hands depth to policies. With `camera_poses`, `camera_pose.<camera>` (16,) and `camera_intrinsics.<camera>` (9,)
        float32: the matrices (4, 4) and (3, 3) of `Desk.camera`, row by row.

    Rewards: 1 for each fulfilled command, judged by CALVIN's oracle after every step; 0 otherwise. The return of a
        chain is the number of commands fulfilled in a row; its mean over chains is CALVIN's average length.

    Success: `info["is_success"]` is True when all commands of the episode are fulfilled.

    Starting state: chain number `seed % 1000`, or a random feasible state drawn from `seed`. Without a seed, the
        environment's own generator draws one.

    Episode end: terminated when the last command is fulfilled, or when a command is not fulfilled within
        `steps_per_command` control steps (360 in CALVIN). An action that the desk refuses (not finite, or beyond
        +-100) and a simulation that diverges also end the episode as failed; the observation is then the last one
        before. `reason` in `episodes.jsonl` says what happened.

    Args:
        task: `"lh_mtlc"` or one of the 34 tasks.
        scene: `"A"`, `"B"`, `"C"` or `"D"`; the benchmark is defined on D.
        assets: `data` folder of a calvin_env checkout, or None for the built-in desk.
        cameras: Pictures in the observation. Without any, a step takes a third to a fifth of the time.
        control_mode: `"rel"` or `"abs"`.
        steps_per_command: Control steps that a command may take.
        annotations: YAML file of sentences by task (CALVIN's format); our own by default.
        sentence: `"first"`: a task is commanded by the first of its sentences, as in CALVIN. `"random"`: by any of
            them; the draws depend on the episode's seed.
        results_dir: If given, a line is appended to `episodes.jsonl` in it for every finished episode.
        results_extra: Further entries of each line, such as the name of the policy.
        renderer: `"gl"` (the look of CALVIN's public data), `"tiny"`, `"pybullet_gl"` or `"pybullet_tiny"`; see `Desk`.
        perturbation_every: If not 0, every `perturbation_every`-th action is perturbed: each coordinate of its
            position difference is replaced by a draw from the normal distribution around it whose standard deviation
            is `perturbation_scale` times its size (Eq 4.9 of the thesis; its experiments are 50 and 5, 25 and 2.5,
            5 and 0.5). The draws depend on the episode's seed.
        perturbation_scale: Gamma of that equation.
        render_fps: How many new pictures `render` draws per second; in between it returns the last one again, but for
            an episode's end, which it shows.
        depth: Whether observations hold the cameras' depth too.
        depth_unit: `"m"` or `"mm"`.
        camera_poses: Whether observations hold the cameras' poses and intrinsics too.
        image_size: Width and height of all pictures and depth in observations; 0: the cameras' own. `resize` in
            `lerobot_lansar.pictures` says how they are brought to that size.
        render_size: Width and height of what `render` returns; 0: the camera's own.
        scene_state: Whether `environment_state` holds the scene's 24 numbers.
        task_in_state: Whether `environment_state` also holds a number for each of the 34 tasks: 1 for the one that is
            commanded, 0 for the others. For policies that read no language (ACT, Diffusion), trained on what
            `lansar-convert --task_in_state=true` makes.
        render_mode: `"rgb_array"`: the static camera's picture.

    Version: v0.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012

    def __init__(
        self,
        task: str = LH_MTLC,
        scene: str = "D",
        assets: str | None = None,
        cameras: Sequence[str] = ("static", "gripper"),
        control_mode: str = "rel",
        steps_per_command: int = STEPS_PER_COMMAND,
        annotations: str | None = None,
        sentence: str = "first",
        results_dir: str | None = None,
        results_extra: dict[str, Any] | None = None,
        renderer: str = "gl",
        perturbation_every: int = 0,
        perturbation_scale: float = 0.0,
        render_fps: int = CONTROL_HZ,
        scene_state: bool = True,
        task_in_state: bool = False,
        depth: bool = False,
        depth_unit: str = "m",
        camera_poses: bool = False,
        image_size: int = 0,
        render_size: int = 0,
        render_mode: str | None = "rgb_array",
    ):
        _check_task(task, scene)
        _check_numbers(steps_per_command, render_fps, perturbation_every, perturbation_scale)
        if control_mode not in CONTROL_MODES:
            raise DeskError(f"control_mode {control_mode!r} is unknown; it is 'rel' or 'abs'")
        if sentence not in SENTENCE_CHOICES:
            raise DeskError(f"sentence {sentence!r} is unknown; it is 'first' or 'random'")
        if renderer not in RENDERERS:
            raise DeskError(f"renderer {renderer!r} is unknown; choose among {', '.join(RENDERERS)}")
        check_size("render_size", render_size, LARGEST_RENDER)
        self.pictures = Pictures(tuple(cameras), image_size, depth, depth_unit, camera_poses)
        self.task, self._scene = task, scene
        self.control_mode = control_mode
        self.sentence = sentence
        self.steps_per_command = steps_per_command
        self.perturbation_every, self.perturbation_scale = perturbation_every, perturbation_scale
        self.environment_state = EnvironmentState(scene_state, task_in_state)
        self.render_mode = render_mode
        self.observation_space = observation_space(self.pictures, self.environment_state)
        self.action_space = action_space(control_mode)
        self._render_size = render_size or CAMERAS["static"]
        self._redraw_every = max(1, round(CONTROL_HZ / render_fps))
        self._results_dir = None if results_dir is None else Path(results_dir)
        self._results_extra = results_extra or {}
        self._sentences = load_commands(annotations, "validation")
        self.task_description = "" if task == LH_MTLC else self._sentences[task][0]
        self._open_desk = functools.partial(Desk, scene, assets, self.pictures.cameras, renderer, depth)
        self._is_new = True  # until its first step
        self._desk: Desk | None = None  # opened at the first reset, in the process that steps it
        self._commands: tuple[str, ...] = ()  # tasks of the episode; empty when none is under way
        self._outcomes: list[dict[str, Any]] = []  # of the commands that ended, in order
        self._reason: str | None = None  # why the episode ended before its time
        self._last: Observation = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode; see the class for what `seed` decides.

        Args:
            seed: Of the episode.
            options: `{"task": name}` changes the environment's task from this episode on.

        Raises:
            DeskError: The task is unknown, or cannot start in the scene.
        """
        super().reset(seed=seed)
        if options is not None and "task" in options:
            _check_task(options["task"], self._scene)
            self.task = options["task"]
        if self._desk is None:
            self._desk = self._open_desk()
        self._reason = None
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if self.task == LH_MTLC:
            chains = load_chains()
            self._chain: int | None = self._seed % len(chains)
            chain = chains[self._chain]
            self._commands = chain.tasks
            self._last = self._desk.reset(chain.robot_obs, chain.scene_obs)
        else:
            self._chain = None
            self._commands = (self.task,)
            start = sample_start(self._desk, self.task, np.random.default_rng(self._seed))
            self._last = self._desk.reset(*start)
        self._choices = np.random.default_rng([self._seed, *_SENTENCE_STREAM])
        self._perturbations = np.random.default_rng([self._seed, *_PERTURBATION_STREAM])
        self._outcomes = []
        self._picture: tuple[int, np.ndarray] | None = None  # the step it was drawn at, and the static picture
        self._steps = 0
        self._begin_command()
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 1/30 s.

        Raises:
            DeskError: The environment was not reset; the action is not (7,); the environment's very first action
                plainly belongs to the other control mode.
        """
        if self._desk is None or not self._commands:
            raise DeskError("reset the environment before stepping it")
        if self._is_new and _is_action(action):  # a wild action fails its own episode instead, in `_advance`
            refuse_other_mode(np.asarray(action, dtype=np.float64), self.control_mode)
        self._is_new = False
        if self.perturbation_every and (self._steps + 1) % self.perturbation_every == 0:
            action = self._perturbed(np.array(action, dtype=np.float64))
        self._advance(self._desk, action)
        self._steps += 1
        self._command_steps += 1
        fulfilled, finished = self._judge()
        info = self._info()
        if finished:
            if self._results_dir is not None:
                append_episode(self._results_dir, self.result())
            self._commands = ()
        elif fulfilled:
            self._begin_command()
        return self._observation(), float(fulfilled), finished, False, info

    def _advance(self, desk: Desk, action: Any) -> None:
        """Moves the desk. What goes wrong there costs this episode only; the next reset starts the desk anew."""
        try:
            self._last = desk.step(action, self.control_mode)
        except SimulationError:
            self._reason = "simulation diverged"
        except DeskError as error:
            if np.shape(action) != (ACTION_SIZE,):  # would fail every episode
                raise
            self._reason = str(error)
        if self._reason is not None:
            warnings.warn(
                "episodes fail early: the desk refuses the policy's actions, or its simulation diverges; `reason` in "
                "the lines of episodes.jsonl tells which (lerobot-eval writes them with --env.results_dir)",
                stacklevel=3,
            )

    def render(self) -> np.ndarray:  # type: ignore[override]
        """The static camera's picture, (200, 200, 3) uint8, or of `render_size`."""
        if self._desk is None:
            raise DeskError("reset the environment before rendering it")
        if self._reason is not None and self._picture is not None:
            return self._picture[1]
        every = self._redraw_every if self._commands else 1  # the last picture shows how the episode ended
        if self._picture is None or self._steps - self._picture[0] >= every:
            self._picture = (self._steps, self._desk.render("static", self._render_size))
        return self._picture[1]

    def close(self) -> None:
        """Closes the desk."""
        if self._desk is not None:
            self._desk.close()
            self._desk = None

    @property
    def _max_episode_steps(self) -> int:
        """LeRobot asks for it by this name."""
        return self.steps_per_command * (CHAIN_LENGTH if self.task == LH_MTLC else 1)

    @property
    def _current(self) -> str:
        """The task that is commanded."""
        return self._commands[len(self._outcomes)]

    def _begin_command(self) -> None:
        assert self._desk is not None
        self._start: Snapshot = self._desk.snapshot()
        self._command_steps = 0
        self._done_instead: str | None = None
        sentences = self._sentences[self._current]
        chosen = int(self._choices.integers(len(sentences))) if self.sentence == "random" else 0
        self.task_description = sentences[chosen]
        self._observed_task = self._current

    def _judge(self) -> tuple[bool, bool]:
        """Whether the last step fulfilled the command, and whether it ended the episode; notes how a command ended."""
        assert self._desk is not None
        ended_early = self._reason is not None
        now = self._desk.snapshot()
        fulfilled = not ended_early and is_fulfilled(self._current, self._start, now)
        failed = ended_early or (not fulfilled and self._command_steps >= self.steps_per_command)
        look = failed or self._command_steps % _LOOK_EVERY == 0
        if look and not (fulfilled or ended_early or self._done_instead):
            self._done_instead = min(completed_tasks(self._start, now), default=None)
        if fulfilled or failed:
            self._outcomes.append(
                {
                    "task": self._current,
                    "sentence": self.task_description,
                    "success": fulfilled,
                    "steps": self._command_steps,
                    "done": self._current if fulfilled else self._done_instead,
                }
            )
        return fulfilled, failed or len(self._outcomes) == len(self._commands)

    def _perturbed(self, action: np.ndarray) -> np.ndarray:
        """Eq 4.9. The desk refuses an action that is not (7,) and finite, so that is returned unchanged."""
        if _is_action(action):
            origin = self._last["robot_obs"][:3] if self.control_mode == "abs" else 0.0
            delta = action[:3] - origin
            action[:3] = origin + self._perturbations.normal(delta, np.abs(delta) * self.perturbation_scale)
        return action

    def _observation(self) -> dict[str, Any]:
        if "rgb_static" in self._last and self._render_size == CAMERAS["static"]:
            self._picture = (self._steps, self._last["rgb_static"])
        return observe(self._last, self.pictures, self.control_mode, self._observed_task, self.environment_state)

    def _info(self) -> dict[str, Any]:
        successes = self._successes()
        return {
            "is_success": bool(self._commands) and successes == len(self._commands),
            "successes": successes,
        }

    def _successes(self) -> int:
        """How many commands the episode has fulfilled."""
        return sum(outcome["success"] for outcome in self._outcomes)

    def result(self) -> dict[str, Any]:
        """The line of `episodes.jsonl` that describes the episode: what was commanded, what became of it, settings.

        A command's `done` is the commanded task if it was fulfilled. Else it is the task that was fulfilled first
        (looked for every `_LOOK_EVERY` steps; of several the first in alphabetical order), or null. `end` is the state
        in which the episode ended; `Desk.reset(…, continued=True)` goes on from it.
        """
        assert self._desk is not None
        return {
            "seed": self._seed,
            "chain": self._chain,
            "scene": self._desk.scene.name,
            "commands": self._outcomes,
            "successes": self._successes(),
            "reason": self._reason,
            "end": {key: self._last[key].tolist() for key in ("robot_obs", "scene_obs")},
            "assets": self._desk.assets,
            "renderer": self._desk.renderer if self._desk.cameras else None,
            "image_size": self.pictures.image_size if self._desk.cameras else None,
            "control_mode": self.control_mode,
            "steps_per_command": self.steps_per_command,
            "sentence": self.sentence,
            "perturbation_every": self.perturbation_every,
            "perturbation_scale": self.perturbation_scale,
            "version": version("lerobot_policy_lansar"),
            **self._results_extra,
        }


def _is_action(action: Any) -> bool:
    return np.shape(action) == (ACTION_SIZE,) and bool(np.isfinite(action).all())


def _check_task(task: str, scene: str) -> None:
    """Raises DeskError unless episodes of the task can start in the scene."""
    if task != LH_MTLC and task not in TASKS:
        raise DeskError(f"task {task!r} is unknown; it is {LH_MTLC!r} or one of: {', '.join(TASKS)}")
    if task == LH_MTLC and scene != "D":
        raise DeskError(f"the benchmark's chains start in scene D, not {scene!r}; name a single task for {scene!r}")
    if scene == "D_eval":
        raise DeskError("scene 'D_eval' fixes the blocks, but an episode's task or chain places them; use 'D'")
    get_scene(scene)


def _check_numbers(steps_per_command: int, render_fps: int, perturbation_every: int, perturbation_scale: float) -> None:
    """Raises DeskError if one of these options is out of its range."""
    if steps_per_command < 1 or not 1 <= render_fps <= CONTROL_HZ:
        raise DeskError(f"steps_per_command must be at least 1 and render_fps between 1 and {CONTROL_HZ}")
    if perturbation_every < 0 or not 0 <= perturbation_scale < np.inf:
        raise DeskError(
            "perturbation_every and perturbation_scale must be finite and at least 0, got "
            f"{perturbation_every} and {perturbation_scale}"
        )
    if (perturbation_every > 0) != (perturbation_scale > 0):
        raise DeskError("perturbation_every and perturbation_scale go together: give both or neither")
