"""The options of `lansar-eval`: those of `lerobot-eval`, and how the work is divided."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs.default import EvalConfig
from lerobot.configs.eval import EvalPipelineConfig

from ..benchmark import LH_MTLC
from ..command import CommandError
from ..envs.command_line import named_device
from ..envs.configuration_calvin import CalvinEnvConfig
from ..jobs.executors import check_executor
from ..jobs.pool import usable_cores
from ..jobs.work import SlurmConfig


@dataclass
class EvaluateEvalConfig(EvalConfig):
    """LeRobot's options of `--eval`."""

    # Environments that each worker steps, one after the other, for one batch of the policy.
    batch_size: int = 20
    # Not used: --workers divides the environments among processes.
    use_async_envs: bool = False

    def __post_init__(self) -> None:
        wanted = self.batch_size
        super().__post_init__()  # lowers it to --eval.n_episodes, which --chains may still raise
        self.batch_size = wanted or self.batch_size


@dataclass
class EvaluateConfig(EvalPipelineConfig):
    """Evaluates a policy on the CALVIN desk as lerobot-eval does, in several processes; goes on where it stopped."""

    eval: EvaluateEvalConfig = field(default_factory=EvaluateEvalConfig)
    # Chains of the benchmark to play: the same as --eval.n_episodes. All of them: 1000.
    chains: int | None = None
    # Processes, each with a copy of the policy; by default one per CPU core, and one alone if the policy is on a GPU.
    # Under Slurm, jobs.
    workers: int | None = None
    # Where they run: local (processes), slurm or ray (pip install 'lerobot_policy_lansar[ray]').
    executor: str = "local"
    # How jobs are submitted with --executor=slurm.
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    # How many episodes of each task are filmed, the first ones.
    videos: int = 10

    def __post_init__(self) -> None:
        if self.output_dir is None:
            raise CommandError("give --output_dir: an interrupted evaluation goes on in it")
        super().__post_init__()
        if self.policy is not None and self.executor != "local":
            self.policy.device = named_device() or self.policy.device  # jobs may have what this machine lacks
        if self.workers is None:
            on_cpu = self.policy is None or self.policy.device in (None, "cpu")
            self.workers = usable_cores() if on_cpu else 1
        if self.chains is not None:
            self.eval.n_episodes = self.chains

    def check(self) -> None:
        """Raises CommandError or ValueError for options that cannot be carried out."""
        if not isinstance(self.env, CalvinEnvConfig):
            raise CommandError(f"lansar-eval evaluates on the CALVIN desk, --env.type=calvin; got {self.env.type}")
        if self.policy is None or not self.policy.pretrained_path:
            raise CommandError("give the policy to evaluate: --policy.path=FOLDER, or a name on the hub")
        if self.chains is not None and list(self.env.suites()) != [LH_MTLC]:
            raise CommandError(
                f"--chains counts chains of the benchmark, but --env.task={self.env.task}: give --eval.n_episodes, "
                "the episodes of each task"
            )
        if self.seed is None:
            raise CommandError("lansar-eval needs a --seed: it decides which episodes are played")
        if self.eval.recording:
            raise CommandError("--eval.recording=true works with lerobot-eval only")
        if self.env.results_dir is not None:
            raise CommandError("leave out --env.results_dir: lansar-eval writes the episodes into --output_dir")
        assert self.workers is not None
        for name, value, least in (
            ("workers", self.workers, 1),
            ("eval.n_episodes", self.eval.n_episodes, 1),
            ("eval.batch_size", self.eval.batch_size, 1),
            ("videos", self.videos, 0),
        ):
            if value < least:
                raise CommandError(f"--{name} must be at least {least}, got {value}")
        check_executor(self.executor, self.slurm)

    @property
    def folder(self) -> Path:
        """`--output_dir`, absolute: jobs may run in another working directory."""
        assert self.output_dir is not None
        return Path(self.output_dir).resolve()

    @property
    def desk(self) -> CalvinEnvConfig:
        """`--env`."""
        assert isinstance(self.env, CalvinEnvConfig)
        return self.env
