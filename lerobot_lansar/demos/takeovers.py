"""Chains in which a policy acts, and the demonstrator takes over when the policy is stuck.

Several sessions are played at once in one process, each on a desk of its own, so that the policy acts in all of them
with one call. Imports LeRobot, which takes seconds; other modes of lansar-record do without.
"""

import hashlib
from collections.abc import Generator, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector.utils import concatenate, create_empty_array
from huggingface_hub import snapshot_download
from huggingface_hub.errors import HFValidationError
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType
from lerobot.envs.utils import preprocess_observation
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins

from ..calvin import CHAIN_LENGTH, POSE_UNITS, STEPS_PER_COMMAND, TASKS, TCP_POSE, relative_action
from ..command import CommandError
from ..datasets import IS_INTERVENTION
from ..desk import Desk, DeskError, SimulationError, is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import Snapshot
from ..desk.starts import sample_start
from ..envs.command_line import check_policy, shapes_read, trained_depth_unit
from ..envs.configuration_calvin import CalvinEnvConfig
from ..envs.control_mode import refuse_other_mode
from ..envs.pictures import Pictures
from ..envs.spaces import EnvironmentState, observation_space, observe
from ..evaluation.loading import load_policy
from ..evaluation.rows import ResetAtCommands
from ..evaluation.stream import Episode
from ..jobs.pool import usable_cores
from .calvin_folder import FrameWriter, Unit
from .demonstrator import AFTERWARDS, Frame, carry_out
from .moves import FALLEN
from .play import choose_task, feasible_tasks, stay, whole_windows
from .record_config import RecordConfig
from .skills import SKILLS
from .stuck import Watch

# ---- the policy


def prepare(config: RecordConfig) -> RecordConfig:
    """The same options with the checkpoint as an absolute folder, and checked as far as possible before the work.

    Raises:
        CommandError: The policy does not fit what it would observe.
    """
    path = str(config.policy.path)
    if not Path(path).is_dir():
        try:
            path = snapshot_download(path)
        except HFValidationError:
            raise CommandError(f"--policy.path={path} is neither a folder nor a name on the hub") from None
    policy = replace(config.policy, path=str(Path(path).resolve()), sha256=checkpoint_sha256(Path(path)))
    unit = config.env.depth_unit or (trained_depth_unit() if config.depth else None)
    config = replace(config, policy=policy, env=replace(config.env, depth_unit=unit))
    trained = _policy_config(config)
    features = trained.input_features or {}
    check_policy(environment_state_of(config), pictures_of(config), shapes_read(trained), option="--")
    reads_pictures = getattr(trained, "use_images", True)
    cameras = {key.rsplit(".", 1)[1] for key, feature in features.items() if feature.type is FeatureType.VISUAL}
    missing = {camera.removesuffix("_depth") for camera in cameras} - set(config.cameras)
    if missing and reads_pictures:
        raise CommandError(
            f"the policy reads pictures of {', '.join(sorted(missing))}, which --cameras={config.cameras} does not "
            f"record: set --cameras='[{','.join(sorted(missing | set(config.cameras)))}]'"
        )
    return config


def checkpoint_sha256(folder: Path) -> str:
    """What identifies a checkpoint wherever it lies: SHA-256 of the files that LeRobot reads of it.

    Raises:
        CommandError: There is no checkpoint.
    """
    if not (folder / "config.json").is_file():
        raise CommandError(f"--policy.path={folder} holds no config.json: name a checkpoint's folder pretrained_model")
    digest = hashlib.sha256()
    names = ("config.json", "*.safetensors", "policy_*.json")
    for file in sorted(file for name in names for file in folder.glob(name)):
        digest.update(f"{file.name} ".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _policy_config(config: RecordConfig) -> PreTrainedConfig:
    register_third_party_plugins()
    overrides = [f"--{option}" for option in config.policy.options]
    policy = PreTrainedConfig.from_pretrained(str(config.policy.path), cli_overrides=overrides)
    policy.pretrained_path = Path(str(config.policy.path))
    return policy


def pictures_of(config: RecordConfig) -> Pictures:
    """The part of the policy's observations that comes from cameras."""
    unit = config.env.depth_unit or "m"
    return Pictures(tuple(config.cameras), config.image_size, config.depth, unit, config.env.camera_poses)


def environment_state_of(config: RecordConfig) -> EnvironmentState:
    """What the policy's observations hold in `environment_state`."""
    return EnvironmentState(config.env.scene_state, config.env.task_in_state)


@dataclass(frozen=True)
class Request:
    """What a session needs an action for.

    Attributes:
        observation: As the environment gives it.
        sentence: The command.
    """

    observation: dict[str, Any]
    sentence: str


class Actor:
    """The policy for the sessions of a batch.

    Args:
        config: The command's options, after `prepare`.
        sessions: Those of the batch, in order.
    """

    def __init__(self, config: RecordConfig, sessions: Sequence["Session"]):
        policy, self._processors = _loaded(config)
        self._resetting = ResetAtCommands(policy, sessions)
        self._space = observation_space(pictures_of(config), environment_state_of(config))
        device = str(policy.config.device or "cpu").partition(":")[0]
        self._precision = lambda: torch.autocast(device) if policy.config.use_amp else nullcontext()

    def act(self, requests: Sequence[Request]) -> np.ndarray:
        """(B, 7) the actions for all sessions, as LeRobot's `rollout` computes them."""
        before_env, after_env, before, after = self._processors
        buffer: Any = create_empty_array(self._space, n=len(requests), fn=np.zeros)
        stacked = concatenate(self._space, [request.observation for request in requests], buffer)
        batch = preprocess_observation(stacked)  # type: ignore[arg-type]
        batch["task"] = [request.sentence for request in requests]
        with torch.inference_mode(), self._precision():
            action = after(self._resetting.select_action(before(before_env(batch))))
        return after_env({ACTION: action})[ACTION].to("cpu").numpy().astype(np.float64)


_policies: dict[str, Any] = {}


def _loaded(config: RecordConfig) -> Any:
    """The policy and its processors, loaded once per process."""
    key = repr((config.policy, config.env, config.scene, config.cameras, config.depth, config.image_size))
    if key not in _policies:
        env = CalvinEnvConfig(
            scene=config.scenes[0],
            cameras=config.cameras,
            control_mode=config.env.control_mode,
            scene_state=config.env.scene_state,
            task_in_state=config.env.task_in_state,
            depth=config.depth,
            depth_unit=config.env.depth_unit,
            camera_poses=config.env.camera_poses,
            image_size=config.image_size,
        )
        threads = max(1, usable_cores() // config.workers)
        torch.set_num_threads(min(torch.get_num_threads(), threads))
        _policies[key] = load_policy(_policy_config(config), env)
    return _policies[key]


# ---- a session


class Session:
    """Chains on one desk, one after the other, until enough frames are recorded.

    Args:
        config: The command's options, after `prepare`.
        desk: Its cameras are recorded, and shown to the policy.
        frames: How many to record.
        seed: Decides everything but what the policy does.
        sentences: Task to the sentences that command it.
        folder: Where the frames go.

    Attributes:
        episode, commands: For `ResetAtCommands`.
    """

    def __init__(
        self,
        config: RecordConfig,
        desk: Desk,
        frames: int,
        seed: list[int],
        sentences: dict[str, list[str]],
        folder: Path,
    ):
        self._config, self._desk, self._frames, self._sentences = config, desk, frames, sentences
        self._rng, self._words = np.random.default_rng(seed), np.random.default_rng([*seed, 1])
        self._writer = FrameWriter(folder, desk.scene, config.image_size)
        self._pictures = pictures_of(config)
        self._unit = Unit(desk.scene.name)
        self._is_new = True  # until the policy's first action
        own = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self.episode: Episode | None = Episode("takeovers", own)
        self.commands = 0

    def play(self) -> Generator[Request, np.ndarray, Unit]:
        """Yields what the policy sees, is sent its action (7,), and returns what was recorded."""
        with self._writer:
            while self._left:
                first = self._writer.frames
                self._snapshots: list[Snapshot] = []
                self._acted: list[bool] = []  # by the demonstrator, for each frame
                self._fulfilled: list[tuple[int, int, str]] = []
                said: dict[int, str] = {}  # first frame of each command to its sentence
                with suppress(SimulationError):
                    yield from self._chain(said)
                if self._snapshots:
                    self._unit.recordings.append((first, self._writer.frames))
                    self._keep_windows(first, said)
            self._unit.frames, self._unit.sums = self._writer.frames, self._writer.sums()
        self.episode = None
        return self._unit

    @property
    def _left(self) -> int:
        return self._frames - self._writer.frames

    def _keep_windows(self, first: int, said: dict[int, str]) -> None:
        for start, end, task in whole_windows(self._snapshots, self._fulfilled):
            if self._config.keep_successes or any(self._acted[start:end]):
                self._unit.windows.append((first + start, first + end, task))
                self._unit.sentences.append(said[start])

    def _chain(self, said: dict[int, str]) -> Generator[Request, np.ndarray, None]:
        """Up to five commands, from a random state to the first one that even the demonstrator does not fulfil."""
        rng = self._rng
        self._obs = self._desk.reset(*sample_start(self._desk, str(rng.choice(list(TASKS))), rng))
        self._last = self._desk.snapshot()
        self._target = self._obs["robot_obs"][TCP_POSE].copy()  # what relative actions move, as in `Desk.step`
        before: str | None = None
        for _ in range(CHAIN_LENGTH):
            feasible = feasible_tasks(self._desk.scene, self._last, self._obs, before)
            if not feasible or not self._left:
                return
            before = task = choose_task(feasible, before, rng, self._config.weights)
            choices = self._sentences[task]
            said[len(self._snapshots)] = sentence = choices[int(self._words.integers(len(choices)))]
            if not (yield from self._command(task, sentence)):
                return

    def _command(self, task: str, sentence: str) -> Generator[Request, np.ndarray, bool]:
        """One command; returns whether it was fulfilled and the chain can go on."""
        self.commands += 1
        self._began, self._task, self._start, start = len(self._snapshots), task, self._last, self._obs
        self._satisfied, self._done = 0, False
        self._count(self._unit.tried)
        watch, before = Watch(task, self._start, self._config.patience), None
        # One frame more than the demonstrator, which rests afterwards: that much belongs to the window.
        while self._satisfied <= AFTERWARDS + 1:
            if not self._left or self._has_fallen():
                return False
            action = yield Request(self._observe(task), sentence)
            earlier = self._obs
            refused = not self._follow(action)
            stuck = watch.is_stuck(self._obs, self._last) and not self._satisfied
            if refused or stuck:
                before = earlier
                break
        else:
            self._count(self._unit.accepted)
            self._count(self._unit.alone)
            return not self._has_fallen()
        if self._has_fallen():
            return False
        self._demonstrate(start, before)
        if self._done:
            self._count(self._unit.accepted)
        return self._done and not self._has_fallen()

    def _demonstrate(self, start: Observation, before: Observation) -> None:
        """The demonstrator does what is left to do, and rests."""
        config, pause = self._config, int(self._rng.integers(1, 6))
        acting = SKILLS[self._task]
        for skill, limit in ((acting, STEPS_PER_COMMAND), (stay, pause)):
            for frame, after, now in carry_out(
                self._desk,
                self._obs,
                skill,
                self._rng,
                start=start if skill is acting else None,
                before=before if skill is acting else None,
                variety=config.variety,
                noise=config.noise,
                steps=min(self._left, limit),
            ):
                self._target = frame["actions"][TCP_POSE].copy()
                self._add(frame, True, after, now)
                if skill is acting and self._satisfied > AFTERWARDS:
                    break

    def _observe(self, task: str) -> dict[str, Any]:
        mode, environment_state = self._config.env.control_mode, environment_state_of(self._config)
        return observe(self._obs, self._pictures, mode, task, environment_state)

    def _follow(self, action: np.ndarray) -> bool:
        """One step by the policy; False if the desk refuses its action."""
        mode = self._config.env.control_mode
        if self._is_new and np.isfinite(action).all():
            refuse_other_mode(action, mode)
        self._is_new = False
        gripper = [1.0 if action[6] > 0 else -1.0]
        if mode == "abs":
            target, meant = action[TCP_POSE], action[TCP_POSE]
        else:
            target = self._target + action[TCP_POSE] * POSE_UNITS
            meant = self._obs["robot_obs"][TCP_POSE] + action[TCP_POSE] * POSE_UNITS
        try:
            after = self._desk.step(np.concatenate([target, gripper]), "abs")
        except DeskError:
            return False
        self._target = target
        meant = np.concatenate([meant, gripper])
        frame = {**self._obs, "actions": meant, "rel_actions": relative_action(meant, self._obs["robot_obs"])}
        self._add(frame, False, after, self._desk.snapshot())
        return True

    def _add(self, frame: Frame, demonstrated: bool, after: Observation, now: Snapshot) -> None:
        """Records a frame, whose state is the present one, and goes on to the state after it."""
        self._writer.add({**frame, IS_INTERVENTION: np.array([demonstrated])})
        self._snapshots.append(self._last)
        self._acted.append(demonstrated)
        self._unit.demonstrated += int(demonstrated)
        if self._satisfied and not self._done:
            self._done = True
            self._fulfilled.append((self._began, len(self._snapshots) - 1, self._task))
        self._obs, self._last = after, now
        self._satisfied = self._satisfied + 1 if is_fulfilled(self._task, self._start, now) else 0

    def _has_fallen(self) -> bool:
        return any(block.position[2] < FALLEN for block in self._last.blocks.values())

    def _count(self, counts: dict[str, int]) -> None:
        counts[self._task] = counts.get(self._task, 0) + 1


# ---- a batch of sessions


def record_sessions(
    config: RecordConfig,
    units: Sequence[tuple[int, str, str, int, list[int], Path]],
    sentences: dict[str, dict[str, list[str]]],
) -> Generator[tuple[int, Unit], None, None]:
    """Plays some sessions at once.

    Args:
        config: The command's options, after `prepare`.
        units: Of each session its number, split, scene, frames, seed and folder.
        sentences: Split to task to the sentences that command it.

    Yields:
        Number and unit of each session, as soon as it is finished.
    """
    with ExitStack() as desks:
        sessions = []
        for _, split, scene, frames, seed, folder in units:
            # A new desk each: where several are open, one that was used before can differ in the last digits.
            desk = Desk(scene, config.assets, config.cameras, config.renderer, config.depth)
            desks.enter_context(desk)
            sessions.append(Session(config, desk, frames, seed, sentences[split], folder))
        actor, playing = Actor(config, sessions), [session.play() for session in sessions]
        requests = [next(play) for play in playing]
        under_way = list(range(len(sessions)))
        while under_way:
            actions = actor.act(requests)  # those of sessions that are over go on with their last request
            for k in list(under_way):
                try:
                    requests[k] = playing[k].send(actions[k])
                except StopIteration as end:
                    under_way.remove(k)
                    yield units[k][0], end.value
