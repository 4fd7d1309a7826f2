"""Runs shards under Slurm and on Ray, through datatrove's executors."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from datatrove.executor import RayPipelineExecutor, SlurmPipelineExecutor
from datatrove.pipeline.base import PipelineStep

from .work import SlurmConfig, Work, WorkerDied


class Step(PipelineStep):
    """A pipeline step of datatrove that calls a function with the shard's number."""

    name = "lansar"
    type = "work"

    def __init__(self, work: Work):
        super().__init__()
        self.function, self.arguments = work

    def run(self, data: Any, rank: int = 0, world_size: int = 1) -> None:
        """Called by datatrove; `rank` is the shard's number."""
        with self.track_time():
            self.function(*self.arguments, rank)


def submit_to_slurm(work: Work, shards: int, finish: Work, workers: int, slurm: SlurmConfig, logging_dir: Path) -> None:
    """Submits an array of jobs for the shards, and a job for the finishing step that waits for them.

    Raises:
        subprocess.CalledProcessError: Slurm refused a job; those it had taken are cancelled.
    """
    folders = _empty_folders(logging_dir)
    submitted = _Jobs()
    options = {**_slurm_options(slurm), "job_id_retriever": submitted}
    first = SlurmPipelineExecutor(
        [Step(work)],
        shards,
        workers=workers,
        tasks_per_job=slurm.shards_per_job,
        logging_dir=folders[0],
        job_name="lansar",
        **options,
    )
    last = SlurmPipelineExecutor(
        [Step(finish)], 1, logging_dir=folders[1], job_name="lansar-finish", depends=first, **options
    )
    try:
        last.run()
    except BaseException:
        if submitted:  # otherwise the next try's jobs would write the same files at the same time
            subprocess.run(["scancel", *submitted], check=False)
        raise


def run_on_ray(work: Work, shards: int, workers: int, logging_dir: Path) -> None:
    """Runs all shards on the configured Ray cluster, or on a local one.

    Raises:
        WorkerDied: Some shards failed.
    """
    import ray

    folder = _empty_folders(logging_dir)[0]
    if not ray.is_initialized():
        ray.init()
    executor = RayPipelineExecutor([Step(work)], shards, workers=workers, logging_dir=folder)
    executor.run()
    if missing := executor.get_incomplete_ranks(skip_completed=True):
        raise WorkerDied(f"{len(missing)} of {shards} shards failed on Ray; their logs are in {folder}/logs")


class _Jobs(list[str]):
    """Ids of submitted jobs. datatrove calls it with the output of sbatch, to get the id."""

    def __call__(self, printed: str) -> str:
        self.append(printed.split()[-1])
        return self[-1]


def _empty_folders(logging_dir: Path) -> list[str]:
    """Log folders of both steps; removes the completion markers of an earlier run, or datatrove would skip shards."""
    folders = [logging_dir / name for name in ("work", "finish")]
    for folder in folders:
        shutil.rmtree(folder / "completions", ignore_errors=True)
    return [str(folder) for folder in folders]


def _slurm_options(slurm: SlurmConfig) -> dict[str, Any]:
    return {
        "time": slurm.time,
        "partition": slurm.partition,
        "qos": slurm.qos,
        "mem_per_cpu_gb": slurm.mem_per_cpu_gb,
        "sbatch_args": dict(slurm.sbatch_args),
        # so that jobs find datatrove's own commands
        "venv_path": str(Path(sys.prefix) / "bin" / "activate") if sys.prefix != sys.base_prefix else None,
        "mail_type": "NONE",
    }
