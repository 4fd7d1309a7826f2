"""Types that the executors share: work, Slurm's options, the error of a lost worker."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ..command import CommandError

Work = tuple[Callable[..., None], tuple[Any, ...]]
"""A function at the top level of a module and its first arguments; the shard's number is its last one. Pickled."""


class WorkerDied(CommandError):
    """A worker was killed, or failed on another machine."""


@dataclass
class SlurmConfig:
    """How jobs are submitted to Slurm (`sbatch`)."""

    # Partition to submit to; Slurm needs one.
    partition: str = ""
    # Time limit of a job.
    time: str = "24:00:00"
    # Quality of service.
    qos: str = "normal"
    # Memory per core, in GB.
    mem_per_cpu_gb: int = 4
    # Shards that one job of the array runs, one after the other.
    shards_per_job: int = 1
    # Further options of sbatch, for example account.
    sbatch_args: dict[str, str] = field(default_factory=dict)
