"""Decides which episodes a dataset will have and cuts them into shards, before anything is written."""

import sys
from bisect import bisect_left
from typing import Any

from dataset_convert import checks
from dataset_convert.calvin import RGB, VECTORS, CalvinSplit
from dataset_convert.episodes import (
    NO_COMMAND,
    Span,
    as_ranges,
    missing_frames,
    play_spans,
    shared_frames,
    window_of_frames,
    window_spans,
)
from dataset_convert.options import ConvertConfig
from dataset_convert.shards import Job, cut_into_shards, describe, staging_of
from lerobot_lansar.calvin import BLOCK_ORDER, SCENE_NAMES, TASKS

FRAMES_PER_SHARD = 8000
"""Frames in one parquet file, and in one mp4 per camera (about 30 MB)."""


def make_plan(config: ConvertConfig, split: CalvinSplit) -> tuple[Job, Any, dict[str, Any]]:
    """Decides which episodes there will be and in which shards; prints what is unusual about the source.

    Returns:
        The work, LeRobot's description of the dataset, and what to report in the manifest.

    Raises:
        FileNotFoundError: Frames are missing and `skip_bad` is off, or pictures were not recorded.
        ValueError: The blocks' order is unclear, or nothing is left to convert.
    """
    shared = _shared_frames(config, split)
    spans, left_out = _choose_spans(config, split, shared if config.exclude_shared else [])
    scenes = sorted({span.scene for span in spans})
    votes = {scene: checks.block_votes(split, scene) for scene in scenes}
    orders = {scene: checks.block_order(scene, votes[scene]) for scene in scenes}
    for scene, order in orders.items():
        if order != BLOCK_ORDER.get(scene):
            warn(f"scene {scene}: block columns are {', '.join(order)}, as its lifts show")
    unknown_tasks = sorted({window.task for window in split.windows} - set(TASKS))
    if config.task_in_state and unknown_tasks:
        raise ValueError(f"--task_in_state=true: {', '.join(unknown_tasks)} is none of CALVIN's {len(TASKS)} tasks")

    from dataset_convert import features  # imports LeRobot, which takes seconds; worker processes import this module

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
        sentences=_sentences(split, spans),
        task_names=[*TASKS, *unknown_tasks],
        scene_names=[*SCENE_NAMES, *sorted(set(scenes) - set(SCENE_NAMES))],
        skip_bad=config.skip_bad,
    )
    _check_recorded(config, job)
    report = {
        "license": config.license,
        "shared_frames": shared,
        "block_votes": {scene: votes[scene].tolist() for scene in scenes},
        "left_out": left_out,
    }
    return job, info, report


def warn(text: str) -> None:
    """Prints a line on the standard error stream."""
    print(text, file=sys.stderr)


def _shared_frames(config: ConvertConfig, split: CalvinSplit) -> list[int]:
    """Frames that are in training and in validation; prints what happens to them."""
    shared = shared_frames(split) if config.split == "training" else []
    if shared:
        used = [f for f in shared if any(first <= f <= last for first, last in split.recordings)]
        fate = "left out" if config.exclude_shared else "kept; --exclude_shared=true leaves them out"
        fate = f"{len(used)} of them inside training's recordings, {fate}" if used else "in no recording, not converted"
        warn(f"frames {as_ranges(shared)} are in training and in validation: {fate}")
    return shared


def _choose_spans(
    config: ConvertConfig, split: CalvinSplit, excluded: list[int]
) -> tuple[list[Span], list[dict[str, Any]]]:
    """The episodes, and descriptions of those that are left out because frames are missing."""
    if config.mode == "play":
        spans = play_spans(split, excluded)
    else:
        spans = window_spans(split.windows, config.dedup, excluded)
    spans, left_out = _without_missing(config, split, spans)
    if not spans:
        raise ValueError(f"{split.folder}: no episode is left to convert")
    inside = sum(len(span.windows) for span in spans)
    if inside < len(split.windows):
        warn(f"{len(split.windows) - inside} of {len(split.windows)} annotated windows are left out")
    return spans, left_out


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


def _check_recorded(config: ConvertConfig, job: Job) -> None:
    """Reads an episode's first frame, so that pictures that were not recorded are reported at once.

    Raises:
        FileNotFoundError, ValueError: It cannot be read; with `skip_bad`, no episode's first frame can.
    """
    arrays = dict.fromkeys([*VECTORS, *(RGB if config.embed else ()), *job.arrays()])
    first_error: Exception | None = None
    for span in job.spans:
        try:
            job.split.read([span.start], arrays)
            return
        except (FileNotFoundError, ValueError) as error:
            if not config.skip_bad:
                raise
            first_error = first_error or error
    raise ValueError(f"{job.split.folder}: no episode is left to convert; the first: {first_error}") from first_error
