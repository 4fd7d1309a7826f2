"""The options of `lansar-record`, and which unit of a recording belongs where."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..calvin import CONTROL_HZ, CONTROL_MODES
from ..desk import SCENES, DeskError
from ..jobs.executors import check_executor
from ..jobs.work import SlurmConfig
from ..pictures import check_size
from .play import KINDS
from .skills import SKILLS

_SHORTEST = 0.1 / 60
"""Hours of the shortest recording."""

SPLITS = ("training", "validation")
MODES = ("windows", "play", "chains", "takeovers")


def group_by_scene(scenes: Sequence[str], count: int) -> list[str]:
    """The scene of each of `count` units: divided as evenly as possible, units of one scene next to each other.

    >>> group_by_scene(["A", "B"], 5)
    ['A', 'A', 'A', 'B', 'B']
    """
    return [scenes[index * len(scenes) // count] for index in range(count)]


class UnitSlot(NamedTuple):
    """Where a unit (an episode, or a session of play) belongs in a recording.

    Attributes:
        split: One of `SPLITS`.
        number: The unit's number within its split.
        scene: Letter of the scene that it is recorded in.
    """

    split: str
    number: int
    scene: str


@dataclass
class TakeoverPolicy:
    """The policy of `--mode=takeovers`."""

    # A checkpoint: its folder, or its name on the hub.
    path: str | None = None
    # Its changed options, name=value; --policy.NAME=VALUE is short for it.
    options: list[str] = field(default_factory=list)
    # Filled in: identifies the checkpoint.
    sha256: str = ""


@dataclass
class TakeoverEnv:
    """What the policy of `--mode=takeovers` observes, in the environment's terms; pictures are as recorded."""

    # The policy's actions: rel (relative) or abs (absolute).
    control_mode: str = "rel"
    # Give the simulator's own state of the scene in environment_state.
    scene_state: bool = True
    # Add 34 numbers to environment_state, 1 for the commanded task and 0 for the others.
    task_in_state: bool = False
    # Add the cameras' poses and intrinsics.
    camera_poses: bool = False
    # Unit of depth, mm or m; by default that in which LeRobot trained the policy.
    depth_unit: str | None = None


@dataclass
class RecordConfig:
    """Records demonstrations into OUTPUT_DIR/training and OUTPUT_DIR/validation, in CALVIN's on-disk format."""

    # Folder to create; an interrupted recording goes on in it.
    output_dir: Path
    # One scene, or several among which the recording is divided evenly: --scene='[A,B,C]'.
    scene: list[str] | str = "D"
    # windows: one command from a random start per episode; play: tasks follow each other without a reset, and CALVIN's
    # windows of at most 64 frames are cut from that; chains: play whose windows are whole subtasks; takeovers: chains
    # in which --policy.path acts, and the demonstrator takes over when it is stuck.
    mode: str = "windows"
    # Tasks to demonstrate, in turn (naming one twice doubles its share); all by default. Windows only.
    tasks: list[str] = field(default_factory=lambda: list(SKILLS))
    # Accepted demonstrations in the training split. Windows only.
    episodes: int = 100
    # Accepted demonstrations in the validation split; by default a tenth, and at least one of each task in each scene.
    # Windows only.
    validation_episodes: int | None = None
    # Hours of play, chains or takeovers in the training split.
    hours: float = 1.0
    # Hours of play, chains or takeovers in the validation split; a tenth by default.
    validation_hours: float | None = None
    # Length of a session of play, chains or takeovers; sessions are divided among the workers.
    session_minutes: float = 2.0
    # How often play, chains and takeovers choose a kind of task compared with the others, which have 1:
    # '{lift_slider: 3, place_in_slider: 2}'; 0 leaves it out where anything else can be done.
    weights: dict[str, float] = field(default_factory=dict)
    # Decides all random choices: the same seed gives the same data for any number of workers.
    seed: int = 0
    # Pictures to record: static, gripper; '[]' records states only, at least twice as fast.
    cameras: list[str] = field(default_factory=lambda: ["static", "gripper"])
    # Record the cameras' depth too (m), as in CALVIN's public data.
    depth: bool = False
    # Width and height of both cameras' pictures and depth; 0: 200 and 84, the cameras' own.
    image_size: int = 0
    # Disturbance of executed actions, in relative action units (the recorded actions are the intended ones).
    noise: float = 0.2
    # How much speed, approach, contact points and pauses differ between episodes: 0 (not at all) to 1.
    variety: float = 1.0
    # The `data` folder of a calvin_env checkout; the built-in desk by default.
    assets: str | None = None
    # What draws the pictures: gl (the look of CALVIN's public data), tiny, pybullet_gl or pybullet_tiny.
    renderer: str = "gl"
    # The policy that acts. Takeovers only, as the four options below.
    policy: TakeoverPolicy = field(default_factory=TakeoverPolicy)
    # What it observes, as in lansar-eval.
    env: TakeoverEnv = field(default_factory=TakeoverEnv)
    # The policy is stuck when it takes so many times as long as the demonstrator does on average.
    patience: float = 1.5
    # Windows also of the commands that the policy fulfilled by itself.
    keep_successes: bool = False
    # Sessions that each worker plays at once, for one batch of the policy.
    batch_size: int = 8
    # YAML file of sentences by task for the training split, in CALVIN's format; our own by default.
    annotations: str | None = None
    # The same for the validation split.
    validation_annotations: str | None = None
    # Where the work runs: local (processes), slurm or ray (pip install 'lerobot_policy_lansar[ray]').
    executor: str = "local"
    # Processes that record in parallel; under Slurm, jobs at a time.
    workers: int = 1
    # How jobs are submitted with --executor=slurm.
    slurm: SlurmConfig = field(default_factory=SlurmConfig)

    def __post_init__(self) -> None:
        for name in ("validation_episodes", "validation_hours"):
            if getattr(self, name) is None:
                setattr(self, name, self._usual(name))

    def _usual(self, name: str) -> Any:
        """The default of an option of `_SESSION_OPTIONS` or `_EPISODE_OPTIONS`, which may depend on others."""
        if name == "validation_episodes":
            return max(len(self.tasks) * len(self.scenes), round(self.episodes / 10))
        if name == "validation_hours":
            return max(self.hours / 10, _SHORTEST)
        return getattr(RecordConfig, name)

    def check(self) -> None:
        """Raises ValueError for options that cannot be carried out."""
        for task in self.tasks:
            if task not in SKILLS:
                raise DeskError(f"--tasks: there is no task {task!r}; choose among: {', '.join(SKILLS)}")
        if not self.tasks:
            raise DeskError("--tasks must name at least one task")
        for scene in self.scenes:
            if scene not in SCENES:
                raise DeskError(f"--scene: {scene!r} is none of {', '.join(SCENES)}")
        if not self.scenes or len(set(self.scenes)) != len(self.scenes):
            raise DeskError(f"--scene must name one scene, or different ones as '[A,B]', got {self.scene}")
        if self.mode not in MODES:
            raise DeskError(f"--mode is one of {', '.join(MODES)}, got {self.mode!r}")
        check_executor(self.executor, self.slurm)
        check_size("--image_size", self.image_size)
        if self.depth and not self.cameras:
            raise DeskError("--depth=true needs --cameras")
        if not 0 <= self.variety <= 1:
            raise DeskError(f"--variety lies between 0 and 1, got {self.variety}")
        if not 0 <= self.noise <= 0.5:
            raise DeskError(f"--noise lies between 0 and 0.5, got {self.noise}")
        if self.seed < 0:
            raise DeskError(f"--seed must be 0 or more, got {self.seed}")
        for name in ("episodes", "validation_episodes", "workers"):
            if getattr(self, name) < 1:
                raise DeskError(f"--{name} must be at least 1, got {getattr(self, name)}")
        for name, minutes in (("hours", 60), ("validation_hours", 60), ("session_minutes", 1)):
            if not _SHORTEST * 60 <= getattr(self, name) * minutes <= 1e6:
                raise DeskError(f"--{name} must be at least 6 seconds, got {getattr(self, name)}")
        self._check_takeovers()
        for name in _SESSION_OPTIONS if self.mode == "windows" else _EPISODE_OPTIONS:
            if getattr(self, name) != self._usual(name):
                raise DeskError(f"--{name} has no effect with --mode={self.mode}: leave it out, or choose another mode")
        for kind, weight in self.weights.items():
            if kind not in KINDS:
                raise DeskError(f"--weights: there is no kind of task {kind!r}; choose among: {', '.join(KINDS)}")
            if not 0 <= weight <= 100:
                raise DeskError(f"--weights: a weight lies between 0 and 100, got {weight} for {kind}")
        if self.mode == "windows" and self.weights:
            raise DeskError(
                "--weights goes with --mode=play, chains or takeovers; with --mode=windows name a task twice in --tasks"
            )
        if self.mode != "windows" and self.tasks != list(SKILLS):
            raise DeskError(f"--tasks goes with --mode=windows; --mode={self.mode} carries out whatever is feasible")

    def _check_takeovers(self) -> None:
        if self.mode != "takeovers":
            changed = [name for name, usual in _TAKEOVER_OPTIONS.items() if getattr(self, name) != usual]
            if changed:
                raise DeskError(f"--{changed[0]} goes with --mode=takeovers, not --mode={self.mode}")
            return
        if not self.policy.path:
            raise DeskError("--mode=takeovers needs the policy that acts: --policy.path=FOLDER, or a name on the hub")
        if self.env.control_mode not in CONTROL_MODES:
            raise DeskError(f"--env.control_mode is {' or '.join(CONTROL_MODES)}, got {self.env.control_mode!r}")
        if self.env.depth_unit not in (None, "m", "mm"):
            raise DeskError(f"--env.depth_unit is m or mm, got {self.env.depth_unit!r}")
        if not 0 < self.patience <= 10:
            raise DeskError(f"--patience lies between 0 and 10, got {self.patience}")
        if self.batch_size < 1:
            raise DeskError(f"--batch_size must be at least 1, got {self.batch_size}")

    @property
    def scenes(self) -> list[str]:
        """The scenes by letter."""
        return [self.scene] if isinstance(self.scene, str) else self.scene

    def request(self) -> dict[str, object]:
        """The options that decide what the recorded data are: all but where they go and where the work runs."""
        without = {"output_dir", "workers", "executor", "slurm", "batch_size"}
        without |= (
            {"hours", "validation_hours", "session_minutes", "weights"}
            if self.mode == "windows"
            else {"tasks", "episodes", "validation_episodes"}
        )
        if self.mode != "takeovers":
            without |= set(_TAKEOVER_OPTIONS)
        request = {k: v for k, v in asdict(self).items() if k not in without}
        if self.mode == "takeovers":
            del request["policy"]["path"]  # the same checkpoint elsewhere is the same
        return request

    def counts(self) -> tuple[int, int]:
        """How many units the training and the validation split have: episodes, or sessions of play."""
        if self.mode == "windows":
            assert self.validation_episodes is not None
            return self.episodes, self.validation_episodes
        training, validation = (len(self.sessions(split)) for split in SPLITS)
        return training, validation

    def sessions(self, split: str) -> list[tuple[str, int]]:
        """Scene and frames of each session of play: equally many frames in each scene, whose last session holds the
        remainder."""
        hours = self.hours if split == "training" else self.validation_hours
        assert hours is not None
        total, each = (round(minutes * 60 * CONTROL_HZ) for minutes in (hours * 60, self.session_minutes))
        shares = [total * (k + 1) // len(self.scenes) - total * k // len(self.scenes) for k in range(len(self.scenes))]
        return [
            (scene, min(each, share - start))
            for scene, share in zip(self.scenes, shares, strict=True)
            for start in range(0, share, each)
        ]

    def shard_size(self) -> int:
        """Units that one shard of work records; decided by the request alone."""
        if self.mode == "takeovers":
            return self.batch_size
        return max(4, sum(self.counts()) // 500) if self.mode == "windows" else 1

    def annotations_of(self, split: str) -> str | None:
        """The user's file of sentences for a split, if any."""
        return self.annotations if split == "training" else self.validation_annotations

    def slot(self, index: int) -> UnitSlot:
        """Where the `index`-th of all units belongs. Units are grouped by scene."""
        training, validation = self.counts()
        split, count = ("training", training) if index < training else ("validation", validation)
        number = index if index < training else index - training
        if self.mode == "windows":
            return UnitSlot(split, number, group_by_scene(self.scenes, count)[number])
        return UnitSlot(split, number, self.sessions(split)[number][0])


_SESSION_OPTIONS = ("hours", "validation_hours", "session_minutes")
_EPISODE_OPTIONS = ("episodes", "validation_episodes")

_TAKEOVER_OPTIONS = {
    "policy": TakeoverPolicy(),
    "env": TakeoverEnv(),
    "patience": RecordConfig.patience,
    "keep_successes": RecordConfig.keep_successes,
    "batch_size": RecordConfig.batch_size,
}
"""Options that only --mode=takeovers has, with their defaults."""
