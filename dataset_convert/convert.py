"""`lansar-convert`: a split of a CALVIN dataset becomes a LeRobotDataset v3."""

import json
import os
import shutil
import sys
from bisect import bisect_left
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus

from dataset_convert import checks
from dataset_convert.calvin import RGB, VECTORS, CalvinSplit
from dataset_convert.embed import ClipOptions, SourcePictures, embed, load_clip
from dataset_convert.episodes import (
    DEDUP,
    MODES,
    NO_COMMAND,
    Span,
    as_ranges,
    missing_frames,
    play_spans,
    shared_frames,
    window_of_frames,
    window_spans,
)
from dataset_convert.hub import folder_of, push
from dataset_convert.layout import MANIFEST, RGBEncoder
from dataset_convert.shards import DATASET, SHARDS, Job, convert_shard, cut_into_shards, describe, frames_done
from lerobot_lansar.calvin import BLOCK_ORDER, SCENE_NAMES, TASKS
from lerobot_lansar.command import CommandError, run_command
from lerobot_lansar.jobs.executors import check_executor, run_shards
from lerobot_lansar.jobs.staging import publish, staging
from lerobot_lansar.jobs.work import SlurmConfig

FRAMES_PER_SHARD = 8000
"""One parquet file and one mp4 per camera (about 30 MB) hold this many frames."""

IMAGES = ("video", "png", "none")


@dataclass
class ConvertConfig:
    """Converts a split of a CALVIN dataset to a LeRobotDataset v3 at 30 fps."""

    # folder of the CALVIN dataset, the one that holds training/ and validation/
    root: Path
    # name of the dataset, you/name; also its place on the hub
    repo_id: str
    # folder to create; by default where LeRobot looks for a dataset of that name
    output_dir: Path | None = None
    # which split to convert
    split: str = "training"
    # windows: an episode is an annotated window; play: an uninterrupted recording, windows are annotations in it
    mode: str = "windows"
    # windows to leave out because they overlap: none, those of one task (task), or all (frames)
    dedup: str = "none"
    # training: leave out what contains frames that are in validation too
    exclude_shared: bool = False
    # leave defective episodes out, and say so, instead of stopping
    skip_bad: bool = False
    # what `action` holds: rel (relative) or abs (absolute); the other form is kept in another column
    action: str = "rel"
    # tell policies that read no language what is asked for: 34 more numbers in observation.environment_state, 1 for the
    # commanded task and 0 for the others
    task_in_state: bool = False
    # both cameras as video, as png in the parquet files, or none
    images: str = "video"
    # store the cameras' distances too
    depth: bool = False
    # store the fingertip sensors' pictures too
    tactile: bool = False
    rgb_encoder: RGBEncoder = field(default_factory=RGBEncoder)
    # compute CLIP embeddings of the pictures and store them beside the data
    embed: bool = False
    clip: ClipOptions = field(default_factory=ClipOptions)
    # processes that convert in parallel
    workers: int = 1
    # where they run: local, slurm or ray
    executor: str = "local"
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    # of the data, a word that the hub knows, for the card; CALVIN's is mit
    license: str = "mit"
    # upload to the hub when done
    push_to_hub: bool = False
    # make the uploaded dataset private
    private: bool = False

    @property
    def target(self) -> Path:
        """The folder to create."""
        return folder_of(self.repo_id, self.output_dir)

    def check(self) -> None:
        """Raises ValueError at an option that cannot be."""
        for name, choices in (
            ("action", ("rel", "abs")),
            ("mode", MODES),
            ("dedup", DEDUP),
            ("images", IMAGES),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(f"--{name}={getattr(self, name)}: expected {' or '.join(choices)}")
        if self.mode == "play" and self.dedup != "none":
            raise ValueError("--dedup is for --mode=windows: in play every frame occurs once")
        if self.images == "none" and (self.depth or self.tactile):
            raise ValueError("--images=none: then there is neither --depth nor --tactile")
        if self.exclude_shared and self.split != "training":
            raise ValueError(f"--exclude_shared is for --split=training, not {self.split}")
        if self.workers < 1:
            raise ValueError(f"--workers={self.workers}: expected 1 or more")
        if self.push_to_hub and self.repo_id.count("/") != 1:
            raise ValueError(f"--repo_id={self.repo_id}: expected user/name to push to the hub")
        if self.private and not self.push_to_hub:
            raise ValueError("--private=true is for --push_to_hub=true: nothing is uploaded without it")
        check_executor(self.executor, self.slurm)

    def request(self, split: CalvinSplit) -> dict[str, Any]:
        """Everything that decides the dataset's frames."""
        names = (
            "split",
            "mode",
            "dedup",
            "exclude_shared",
            "skip_bad",
            "action",
            "images",
            "depth",
            "tactile",
        )
        encoder = asdict(self.rgb_encoder) if self.images == "video" else None
        return {
            "source": self.root.resolve().name,
            "source_sha256": split.source_sha256,
            **{name: getattr(self, name) for name in names},
            "rgb_encoder": encoder,
            **({"task_in_state": True} if self.task_in_state else {}),
        }


class HubError(CommandError):
    """The upload failed; the dataset is safe on disk."""


def convert(config: ConvertConfig) -> Path:
    """Converts a split; the dataset appears at `config.target` complete or not at all.

    What is there of an interrupted conversion is used; what is finished is not done again.

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
    split = CalvinSplit(config.root, config.split)
    request = config.request(split)
    if _is_done(config.target, request):
        kept = json.loads((config.target / MANIFEST).read_text())["license"]
        if kept != config.license:  # no option is the default, which must not change what was published
            raise ValueError(
                f"--license={config.license}: {config.target} was made with --license={kept}: repeat that, or change "
                f"`license` in its {MANIFEST}"
            )
        print(f"{config.target} already holds this conversion", file=sys.stderr)
        shutil.rmtree(staging_of(config.target), ignore_errors=True)
        _after(config, split)
        return config.target
    job, info, report = plan(config, split)
    _check_recorded(config, job)
    if config.embed:
        load_clip(config.clip.model, config.clip.pretrained)
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


def staging_of(output_dir: Path) -> Path:
    """Where a dataset is prepared: a hidden folder beside its place, on the same file system."""
    return output_dir.parent / f".{output_dir.name}.incomplete"


def _has_shards(folder: Path) -> bool:
    """Whether a staging folder holds finished shards; without the dataset it is left by a run that was killed just
    after it published."""
    return (folder / DATASET).exists() and any((folder / SHARDS).glob("*.json"))


def _check_recorded(config: ConvertConfig, job: Job) -> None:
    """Reads the first frame of an episode, so that pictures that were not recorded are reported at once.

    Raises:
        FileNotFoundError, ValueError: It cannot be read; with `skip_bad`: that of no episode can.
    """
    arrays = dict.fromkeys([*VECTORS, *(RGB if config.embed else ()), *job.arrays()])
    first: Exception | None = None
    for span in job.spans:
        try:
            job.split.read([span.start], arrays)
            return
        except (FileNotFoundError, ValueError) as error:
            if not config.skip_bad:
                raise
            first = first or error
    raise ValueError(f"{job.split.folder}: no episode is left to convert; the first: {first}") from first


def plan(config: ConvertConfig, split: CalvinSplit) -> tuple[Job, Any, dict[str, Any]]:
    """Decides which episodes there will be and in which shards; prints what is remarkable of the source.

    Returns:
        The work, LeRobot's description of the dataset, and what to report in the manifest.

    Raises:
        FileNotFoundError: Frames are missing and `skip_bad` is off.
        ValueError: The blocks' order is unclear, or nothing is left to convert.
    """
    shared = shared_frames(split) if config.split == "training" else []
    if shared:
        used = [f for f in shared if any(first <= f <= last for first, last in split.recordings)]
        what = "left out" if config.exclude_shared else "kept; --exclude_shared=true leaves them out"
        what = (
            f"{len(used)} of them inside training's recordings, {what}" if used else "in no recording, so not converted"
        )
        _say(f"frames {as_ranges(shared)} are in training and in validation: {what}")
    excluded = shared if config.exclude_shared else []
    if config.mode == "play":
        spans = play_spans(split, excluded)
    else:
        spans = window_spans(split.windows, config.dedup, excluded)
    spans, left_out = _without_missing(config, split, spans)
    if not spans:
        raise ValueError(f"{split.folder}: no episode is left to convert")
    inside = sum(len(span.windows) for span in spans)
    if inside < len(split.windows):
        _say(f"{len(split.windows) - inside} of {len(split.windows)} annotated windows are left out")
    scenes = sorted({span.scene for span in spans})
    votes = {scene: checks.block_votes(split, scene) for scene in scenes}
    orders = {scene: checks.block_order(scene, votes[scene]) for scene in scenes}
    for scene, order in orders.items():
        if order != BLOCK_ORDER.get(scene):
            _say(f"scene {scene}: block columns are {', '.join(order)}, as its lifts show")
    names = {window.task for window in split.windows}
    if config.task_in_state and not names <= set(TASKS):
        raise ValueError(
            f"--task_in_state=true: {', '.join(sorted(names - set(TASKS)))} is none of CALVIN's {len(TASKS)} tasks"
        )

    from dataset_convert import features

    pictures = features.pictures_of(config.images, config.depth, config.tactile, config.rgb_encoder)
    info = features.empty_info(config.action, pictures, config.task_in_state)
    job = Job(
        split=split,
        folder=staging_of(config.target),
        spans=spans,
        shards=cut_into_shards([len(span) for span in spans], FRAMES_PER_SHARD),
        layout=features.layout_of(info, pictures),
        action=config.action,
        task_in_state=config.task_in_state,
        block_orders=orders,
        tasks=_sentences(split, spans),
        task_names=[*TASKS, *sorted(names - set(TASKS))],
        scene_names=[*SCENE_NAMES, *sorted(set(scenes) - set(SCENE_NAMES))],
        skip_bad=config.skip_bad,
    )
    report = {
        "license": config.license,
        "shared_frames": shared,
        "block_votes": {scene: votes[scene].tolist() for scene in scenes},
        "left_out": left_out,
    }
    return job, info, report


def _without_missing(
    config: ConvertConfig, split: CalvinSplit, spans: list[Span]
) -> tuple[list[Span], list[dict[str, Any]]]:
    missing = missing_frames(spans, split.frames())
    if not missing:
        return spans, []
    if not config.skip_bad:
        raise FileNotFoundError(
            f"{split.frame_file(missing[0])} is missing, {len(missing)} frames in all: {as_ranges(missing)}; download "
            "or record them again, or leave their episodes out with --skip_bad=true"
        )
    kept, left_out = [], []
    for span in spans:
        lost = missing[bisect_left(missing, span.start) : bisect_left(missing, span.end)]
        if lost:
            left_out.append({**describe(span), "reason": f"frames are missing: {as_ranges(lost)}"})
        else:
            kept.append(span)
    return kept, left_out


def _sentences(split: CalvinSplit, spans: list[Span]) -> list[str]:
    """The distinct commands in the order in which they first occur."""
    found: dict[str, None] = {}
    for span in spans:
        numbers = dict.fromkeys(window_of_frames(span, split.windows).tolist())
        found |= dict.fromkeys(split.windows[n].sentence if n >= 0 else NO_COMMAND for n in numbers)
    return list(found)


def conclude(
    config: ConvertConfig, job: Job, info: Any, request: dict[str, Any], report: dict[str, Any], _: int
) -> None:
    """The step after all shards: one dataset of them, in its place; then its embeddings and the upload."""
    from dataset_convert import card, finish

    manifest = finish.finish(job, info, config.rgb_encoder, request, report)
    card.write(job.dataset, config.repo_id)
    publish(job.folder, job.dataset, config.target)
    for bad in manifest["left_out"][:20]:
        _say(f"left out: frames {bad['start']}-{bad['end'] - 1}: {bad['reason']}")
    if manifest["left_out"]:
        _say(f"{len(manifest['left_out'])} defective episodes were left out; {MANIFEST} lists them")
    _after(config, job.split)


def _after(config: ConvertConfig, split: CalvinSplit) -> None:
    if config.embed:
        from dataset_convert import card

        clip = load_clip(config.clip.model, config.clip.pretrained)
        pictures = SourcePictures(split, config.target)
        embed(config.target, pictures, clip, config.clip, num_workers=config.workers - 1)
        card.write(config.target, config.repo_id)
    if config.push_to_hub:
        try:
            push(config.target, config.repo_id, config.private)
        except Exception as error:  # the network's errors are of many kinds
            raise HubError(
                f"cannot upload {config.target}: {error}; the dataset is complete there, run this again to go on"
            ) from error


def _is_done(target: Path, request: dict[str, Any]) -> bool:
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return False
    manifest = target / MANIFEST
    if manifest.is_file() and json.loads(manifest.read_text())["request"] == request:
        return True
    what = "the result of another conversion" if manifest.is_file() else "something else"
    raise ValueError(f"--output_dir={target} holds {what}: remove it or choose another folder")


def _logs(config: ConvertConfig, folder: Path) -> Path:
    """datatrove's. Those of Slurm jobs outlive the staging folder, the others say nothing that matters."""
    if config.executor == "slurm":
        return config.target.parent / f"{config.target.name}.slurm_logs"
    return folder / "jobs"


def _say(text: str) -> None:
    print(text, file=sys.stderr)


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
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the encoder prints 20 lines per file otherwise
    return run_command("lansar-convert", run, resumable=True)


if __name__ == "__main__":
    # workers on other machines know these functions by their module's real name
    from dataset_convert.convert import main as run_main

    sys.exit(run_main())
