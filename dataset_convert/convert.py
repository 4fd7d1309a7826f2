"""`lansar-convert`: a split of a CALVIN dataset becomes a LeRobotDataset v3."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus

from dataset_convert import card
from dataset_convert.calvin import CalvinSplit
from dataset_convert.embed import SourcePictures, embed, load_clip
from dataset_convert.episodes import as_ranges
from dataset_convert.hub import push
from dataset_convert.options import ConvertConfig
from dataset_convert.plan import EXCLUDE_SHARED, make_plan, warn
from dataset_convert.shards import DATASET, SHARDS, Job, convert_shard, frames_done, staging_of
from lerobot_lansar.command import CommandError, run_command
from lerobot_lansar.datasets import MANIFEST
from lerobot_lansar.jobs.executors import run_shards
from lerobot_lansar.jobs.staging import publish, staging

MAX_LISTED = 20
"""Left-out episodes that are printed at most; the manifest lists all."""


class HubError(CommandError):
    """The upload failed; the dataset is safe on disk."""


def convert(config: ConvertConfig) -> Path:
    """Converts a split; the dataset appears at `config.target` complete or not at all.

    An interrupted conversion is resumed; a finished one is not repeated.

    Args:
        config: The command's options.

    Returns:
        The dataset's folder. With `executor="slurm"` it appears when the jobs are done.

    Raises:
        FileNotFoundError: Files of the source are missing.
        ValueError: An option or the source's content is wrong, or the target holds something else.
        WorkerDied: A worker was killed; the same call goes on where it stopped.
        HubError: The upload failed.
    """
    config.check()
    config = replace(config, root=config.root.resolve(), output_dir=config.target.resolve())
    split = config.open_split()
    request = config.request(split)
    if _is_done(config.target, request):
        _check_license(config)
        print(f"{config.target} already holds this conversion", file=sys.stderr)
        shutil.rmtree(staging_of(config.target), ignore_errors=True)
        _embed_and_push(config, split)
        return config.target
    job, info, report = make_plan(config, split)
    if config.embed:
        load_clip(config.clip.model, config.clip.pretrained)  # now: an unknown CLIP is reported before the long part
    folder = job.folder
    with staging(folder, config.target, request, _has_shards, submitting=config.executor == "slurm"):
        if config.target.exists() and any(config.target.iterdir()):
            raise ValueError(f"another process has just written {config.target}")
        for name in (DATASET, SHARDS):
            (folder / name).mkdir(exist_ok=True)
        run_shards(
            (convert_shard, (job,)),
            len(job.shards),
            (conclude, (config, job, info, request, report)),
            executor=config.executor,
            workers=min(config.workers, len(job.shards)),
            slurm=config.slurm,
            logging_dir=_logs(config, folder),
            progress=lambda: frames_done(folder),
            total=sum(len(span) for span in job.spans),
            unit="frame",
            desc="converting",
        )
    return config.target


def conclude(
    config: ConvertConfig, job: Job, info: Any, request: dict[str, Any], report: dict[str, Any], _: int
) -> None:
    """The step after all shards: joins them to one dataset, puts it in its place, embeds and uploads it."""
    from dataset_convert import finish  # imports LeRobot, which takes seconds; worker processes import this module

    manifest = finish.finish(job, info, config.rgb_encoder, request, report)
    card.write(job.dataset, config.repo_id)
    publish(job.folder, job.dataset, config.target)
    left_out = manifest["left_out"]
    for bad in left_out[:MAX_LISTED]:
        warn(f"left out: frames {bad['start']}-{bad['end'] - 1}: {bad['reason']}")
    if left_out:
        warn(f"{len(left_out)} defective episodes were left out; {MANIFEST} lists them")
    late = sorted(set(manifest["shared_frames"]) - set(report["shared_frames"]))
    if late:
        warn(f"frames {as_ranges(late)} are in validation too, as converting showed; {EXCLUDE_SHARED}")
    _embed_and_push(config, job.split)


def _embed_and_push(config: ConvertConfig, split: CalvinSplit) -> None:
    if config.embed:
        clip = load_clip(config.clip.model, config.clip.pretrained)
        pictures = SourcePictures(split, config.target)
        readers = config.workers - 1 if config.executor == "local" else 0  # workers elsewhere are not this machine's
        embed(config.target, pictures, clip, config.clip, num_workers=readers)
        card.write(config.target, config.repo_id)
    if config.push_to_hub:
        try:
            push(config.target, config.repo_id, config.private)
        except Exception as error:  # the network's errors are of many kinds
            raise HubError(
                f"cannot upload {config.target}: {error}; the dataset is complete there, run this again to go on"
            ) from error


def _is_done(target: Path, request: dict[str, Any]) -> bool:
    """Whether the target holds this conversion; raises ValueError if it holds anything else."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return False
    manifest = target / MANIFEST
    if manifest.is_file() and json.loads(manifest.read_text())["request"] == request:
        return True
    what = "the result of another conversion" if manifest.is_file() else "something else"
    raise ValueError(f"--output_dir={target} holds {what}: remove it or choose another folder")


def _check_license(config: ConvertConfig) -> None:
    """An omitted `--license` means the default, which must not change a published licence."""
    kept = json.loads((config.target / MANIFEST).read_text())["license"]
    if kept != config.license:
        raise ValueError(
            f"--license={config.license}: {config.target} was made with --license={kept}: repeat that, or change "
            f"`license` in its {MANIFEST}"
        )


def _has_shards(folder: Path) -> bool:
    """Whether a staging folder holds finished shards.

    Shards without the dataset do not count: they are left by a run that was killed just after it published.
    """
    return (folder / DATASET).exists() and any((folder / SHARDS).glob("*.json"))


def _logs(config: ConvertConfig, folder: Path) -> Path:
    """Where datatrove logs: Slurm's logs outlive the staging folder, nobody needs the others."""
    if config.executor == "slurm":
        return config.target.parent / f"{config.target.name}.slurm_logs"
    return folder / "jobs"


@draccus.wrap()
def run(config: ConvertConfig) -> None:
    """Converts, and says where the dataset is."""
    folder = convert(config)
    if config.executor == "slurm" and not folder.exists():
        print(f"submitted; {folder} appears when the jobs are done")
    else:
        print(f"dataset {config.repo_id} is at {folder}")


def main() -> int:
    """Entry point of `lansar-convert`."""
    os.environ.setdefault("SVT_LOG", "1")  # errors only: otherwise the AV1 encoder prints 20 lines per file
    return run_command("lansar-convert", run, resumable=True)


if __name__ == "__main__":
    # Workers on other machines must find these functions under their module's real name, not in `__main__`.
    from dataset_convert.convert import main as run_main

    sys.exit(run_main())
