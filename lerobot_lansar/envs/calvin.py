"""The CALVIN desk as a gymnasium environment: the long-horizon benchmark, or one task at a time."""

import json
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..benchmark import LH_MTLC, load_chains
from ..calvin import CAMERAS, CHAIN_LENGTH, CONTROL_HZ, CONTROL_MODES, STEPS_PER_COMMAND, TASKS
from ..desk import Desk, DeskError, Observation, SimulationError, is_fulfilled
from ..desk.oracle import Snapshot
from ..desk.render import RENDERERS
from ..desk.sentences import load_commands
from ..desk.starts import sample_start


class CalvinEnv(gym.Env):
    """A Panda at a desk with a drawer, a sliding door, a light bulb, an LED and three blocks, told what to do.

    Description:
        `task="lh_mtlc"` (default): an episode is one chain of CALVIN's benchmark, five commands in a row.
        `task=<name>`: an episode is one command, from a random state in which it is feasible.
        The command in force is `env.task_description`; it changes when a command is fulfilled.

    Action space (7,) at 30 Hz:
        `control_mode="rel"`: TCP translation in units of 0.02 m and rotation (euler xyz) in units of 0.05 rad, both
        nominally within +-1 and added to a target pose, then the gripper. `"abs"`: TCP xyz (m), euler xyz (rad),
        gripper. The gripper opens for positive values and closes otherwise.

    Observation space:
        `agent_pos` (15,): CALVIN's robot_obs. `environment_state` (24,): CALVIN's scene_obs, blocks red, blue,
        pink; privileged simulator state (58 numbers with `task_in_state`). `pixels`: `static` (200, 200, 3) and
        `gripper` (84, 84, 3) uint8, those asked for by `cameras`. `control_mode` (1,): 0 relative, 1 absolute;
        policies check it.

    Rewards: 1 for each fulfilled command, judged by CALVIN's oracle after every step; 0 otherwise. The return of a
        chain is the number of commands fulfilled in a row, its mean over chains CALVIN's average length.

    Success: `info["is_success"]` is True when all commands of the episode are fulfilled.

    Starting state: chain number `seed % 1000`, or a random feasible state drawn from `seed`. Without a seed
        the environment's own generator decides.

    Episode end: terminated when the last command is fulfilled or a command is not fulfilled within
        `steps_per_command` control steps (360 in CALVIN). An episode whose simulation diverges ends as failed, with
        the last finite observation.

    Args:
        task: `"lh_mtlc"` or one of the 34 tasks.
        scene: `"A"`, `"B"`, `"C"` or `"D"`; the benchmark is defined on D.
        assets: `data` folder of a calvin_env checkout, or None for the built-in desk.
        cameras: Pictures in the observation; without any, an episode takes a half to a third of the time.
        control_mode: `"rel"` or `"abs"`.
        steps_per_command: Control steps that a command may take.
        annotations: YAML file of sentences by task (CALVIN's format); our own by default.
        results_dir: If given, every finished episode is appended to `episodes-<process id>.jsonl` in it.
        renderer: `"fast"`, `"fast_gl"` (the look of CALVIN's public data), `"tiny"` or `"egl"`; see
            `Desk`.
        perturbation_every: If not 0, the position difference of every so many-th action is replaced by a draw from
            the normal distribution around it with `perturbation_scale` times its size as standard deviation, each
            coordinate on its own (Eq 4.9 of the thesis; its experiments are 50 and 5, 25 and 2.5, 5 and 0.5). The
            draws depend on the episode's seed.
        perturbation_scale: Gamma of that equation.
        render_fps: How often `render` draws a new picture; in between it returns the last one again.
        task_in_state: `environment_state` also holds a number for each of the 34 tasks, 1 for the one that is
            commanded and 0 for the others: for policies that read no language (ACT, Diffusion, VQ-BeT), trained on
            what `lansar-convert --task_in_state=true` makes.
        render_mode: `"rgb_array"`, the static camera's picture.

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
        results_dir: str | None = None,
        renderer: str = "fast",
        perturbation_every: int = 0,
        perturbation_scale: float = 0.0,
        render_fps: int = CONTROL_HZ,
        task_in_state: bool = False,
        render_mode: str | None = "rgb_array",
    ):
        if task != LH_MTLC and task not in TASKS:
            raise DeskError(f"task {task!r} is unknown; it is {LH_MTLC!r} or one of: {', '.join(TASKS)}")
        if task == LH_MTLC and scene != "D":
            raise DeskError(f"the benchmark's chains start in scene D, not {scene!r}; name a single task for {scene!r}")
        if scene == "D_eval":
            raise DeskError("scene 'D_eval' fixes the blocks, but an episode's task or chain decides; use 'D'")
        if control_mode not in CONTROL_MODES:
            raise DeskError(f"control_mode {control_mode!r} is unknown; it is 'rel' or 'abs'")
        if steps_per_command < 1 or not 1 <= render_fps <= CONTROL_HZ:
            raise DeskError(f"steps_per_command must be at least 1 and render_fps between 1 and {CONTROL_HZ}")
        if perturbation_every < 0 or not 0 <= perturbation_scale < np.inf:
            raise DeskError(
                "perturbation_every and perturbation_scale must be 0 or more, got "
                f"{perturbation_every} and {perturbation_scale}"
            )
        if (perturbation_every > 0) != (perturbation_scale > 0):
            raise DeskError("perturbation_every and perturbation_scale go together: give both or neither")
        self.perturbation_every, self.perturbation_scale = perturbation_every, perturbation_scale
        self.task = task
        self.control_mode = control_mode
        self.steps_per_command = steps_per_command
        self.render_mode = render_mode
        if renderer not in RENDERERS:
            raise DeskError(f"renderer {renderer!r} is unknown; choose among {', '.join(RENDERERS)}")
        self._desk_options = {
            "scene": scene,
            "assets": assets,
            "cameras": tuple(cameras),
            "renderer": renderer,
        }
        self._sentences = load_commands(annotations, "validation")
        self._results_dir = None if results_dir is None else Path(results_dir)
        self._redraw_every = max(1, round(CONTROL_HZ / render_fps))
        self._max_episode_steps = steps_per_command * (CHAIN_LENGTH if task == LH_MTLC else 1)
        self._desk: Desk | None = None  # opened at the first reset, in the process that steps it
        self._commands: tuple[str, ...] = ()
        self._diverged = False
        self._last: Observation = {}
        self._done: list[dict[str, Any]] = []
        self.task_description = "" if task == LH_MTLC else self._sentences[task][0]
        self.task_in_state = task_in_state
        self.observation_space = _observation_space(tuple(cameras), environment_state_size(task_in_state))
        self.action_space = _action_space(control_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode; see the class for what `seed` decides. `options` are ignored."""
        super().reset(seed=seed)
        if self._desk is None:
            self._desk = Desk(**self._desk_options)  # type: ignore[arg-type]
        self._diverged = False
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if self.task == LH_MTLC:
            chains = load_chains()
            self._chain: int | None = self._seed % len(chains)
            chain = chains[self._chain]
            self._commands = chain.tasks
            obs = self._desk.reset(chain.robot_obs, chain.scene_obs)
        else:
            self._chain = None
            self._commands = (self.task,)
            start = sample_start(self._desk, self.task, np.random.default_rng(self._seed))
            obs = self._desk.reset(*start)
        self._last = obs
        self._disturbance = np.random.default_rng([self._seed, 4, 9])
        self._done = []
        self._picture: tuple[int, np.ndarray] | None = None  # the step it was drawn at, and the static picture
        self._steps = 0
        self._begin_command()
        return self._observation(obs), self._info()

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 1/30 s.

        Raises:
            DeskError: No reset yet; an action that is not (7,) and finite; a first action of an episode that
                plainly belongs to the other control mode.
        """
        if self._desk is None or not self._commands:
            raise DeskError("reset the environment before stepping it")
        if self._steps == 0:
            self._refuse_other_mode(np.asarray(action, dtype=np.float64))
        if self.perturbation_every and (self._steps + 1) % self.perturbation_every == 0:
            action = self._perturbed(np.array(action, dtype=np.float64))
        try:
            self._last = self._desk.step(action, self.control_mode)
        except SimulationError:  # costs this episode only; the next reset starts the desk anew
            self._diverged = True
        self._steps += 1
        self._command_steps += 1
        fulfilled = not self._diverged and is_fulfilled(self._current, self._start, self._desk.snapshot())
        failed = self._diverged or (not fulfilled and self._command_steps >= self.steps_per_command)
        if fulfilled or failed:
            self._done.append(
                {
                    "task": self._current,
                    "sentence": self.task_description,
                    "success": fulfilled,
                    "steps": self._command_steps,
                }
            )
        finished = failed or len(self._done) == len(self._commands)
        info = self._info()
        if finished:
            self._write_result()
            self._commands = ()
        elif fulfilled:
            self._begin_command()
        return self._observation(self._last), float(fulfilled), finished, False, info

    def render(self) -> np.ndarray:  # type: ignore[override]
        """The static camera's picture, (200, 200, 3) uint8."""
        if self._desk is None:
            raise DeskError("reset the environment before rendering it")
        if self._diverged and self._picture is not None:
            return self._picture[1]
        if self._picture is None or self._steps - self._picture[0] >= self._redraw_every:
            self._picture = (self._steps, self._desk.render("static"))
        return self._picture[1]

    def close(self) -> None:
        """Closes the desk."""
        if self._desk is not None:
            self._desk.close()
            self._desk = None

    def _perturbed(self, action: np.ndarray) -> np.ndarray:
        """Eq 4.9; an action that is not (7,) and finite is left to the desk, which says what is wrong."""
        if action.shape == (7,) and np.isfinite(action).all():
            origin = self._last["robot_obs"][:3] if self.control_mode == "abs" else 0.0
            delta = action[:3] - origin
            action[:3] = origin + self._disturbance.normal(delta, np.abs(delta) * self.perturbation_scale)
        return action

    @property
    def _current(self) -> str:
        return self._commands[len(self._done)]

    def _begin_command(self) -> None:
        assert self._desk is not None
        self._start: Snapshot = self._desk.snapshot()
        self._command_steps = 0
        self.task_description = self._sentences[self._current][0]
        self._told = np.array([task == self._current for task in TASKS], dtype=np.float64)

    def _observation(self, obs: dict[str, np.ndarray]) -> dict[str, Any]:
        observation: dict[str, Any] = {
            "agent_pos": obs["robot_obs"],
            "environment_state": np.concatenate([obs["scene_obs"], self._told])
            if self.task_in_state
            else obs["scene_obs"],
            "control_mode": np.array([CONTROL_MODES.index(self.control_mode)], dtype=np.float32),
        }
        cameras = self._desk_options["cameras"]
        if cameras:
            observation["pixels"] = {camera: obs[f"rgb_{camera}"] for camera in cameras}  # type: ignore[union-attr]
        if "rgb_static" in obs:
            self._picture = (self._steps, obs["rgb_static"])
        return observation

    def _info(self) -> dict[str, Any]:
        successes = sum(command["success"] for command in self._done)
        return {
            "is_success": bool(self._commands) and successes == len(self._commands),
            "successes": successes,
        }

    def _refuse_other_mode(self, action: np.ndarray) -> None:
        """Catches a policy of the other control mode at its first action, before it costs an evaluation.

        A hand above the desk points down, so an absolute roll is near +-pi; a relative one lies within +-1.
        """
        if action.shape != (7,) or not np.isfinite(action).all():
            return  # the desk says what is wrong
        if self.control_mode == "rel" and abs(action[3]) > 2 and 0.2 < action[2] < 1.2:
            looks, other = f"absolute: height {action[2]:.2f} m and roll {action[3]:.2f} rad", "abs"
        elif self.control_mode == "abs" and abs(action[3]) <= 1:
            looks, other = f"relative: roll {action[3]:.2f} rad, a hand that points up", "rel"
        else:
            return
        raise DeskError(
            f"the environment takes control_mode={self.control_mode!r} actions and the policy's look {looks}. "
            f"Set --env.control_mode={other}, or use a policy trained on {self.control_mode!r} actions"
        )

    def _write_result(self) -> None:
        if self._results_dir is None:
            return
        assert self._desk is not None
        result = {
            "seed": self._seed,
            "chain": self._chain,
            "scene": self._desk.scene.name,
            "commands": self._done,
            "successes": sum(command["success"] for command in self._done),
            "assets": self._desk.assets,
            "renderer": self._desk.renderer if self._desk.cameras else None,
            "control_mode": self.control_mode,
            "steps_per_command": self.steps_per_command,
            "perturbation_every": self.perturbation_every,
            "perturbation_scale": self.perturbation_scale,
            "version": version("lerobot_policy_lansar"),
        }
        self._results_dir.mkdir(parents=True, exist_ok=True)
        with open(self._results_dir / f"episodes-{os.getpid()}.jsonl", "a") as file:
            file.write(json.dumps(result) + "\n")


def environment_state_size(task_in_state: bool) -> int:
    """How many numbers `environment_state` has."""
    return 24 + (len(TASKS) if task_in_state else 0)


def _observation_space(cameras: tuple[str, ...], scene_size: int) -> spaces.Dict:
    numbers = {"agent_pos": 15, "environment_state": scene_size}
    entries: dict[str, spaces.Space] = {
        key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in numbers.items()
    }
    entries["control_mode"] = spaces.Box(0, 1, (1,), np.float32)
    for camera in cameras:
        if camera not in CAMERAS:
            raise DeskError(f"camera {camera!r} is unknown; choose among {', '.join(CAMERAS)}")
    if cameras:
        entries["pixels"] = spaces.Dict({c: spaces.Box(0, 255, (CAMERAS[c], CAMERAS[c], 3), np.uint8) for c in cameras})
    return spaces.Dict(entries)


def _action_space(control_mode: str) -> spaces.Box:
    if control_mode == "rel":
        return spaces.Box(-1, 1, (7,), np.float32)
    # any turn of an angle is understood; the roll's range is that of a hand that points down
    low = np.array([-1.0, -1.0, 0.2, np.pi / 2, -np.pi, -np.pi, -1.0], dtype=np.float32)
    high = np.array([1.0, 1.0, 1.0, np.pi * 3 / 2, np.pi, np.pi, 1.0], dtype=np.float32)
    return spaces.Box(low, high, dtype=np.float32)
