"""Decides which episodes a dataset will have and cuts them into shards, before anything is written."""

import sys
from bisect import bisect_left
from dataclasses import asdict
from typing import Any

import numpy as np

from dataset_convert import blocks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.episodes import (
    Span,
    as_ranges,
    missing_frames,
    play_spans,
    window_of_frames,
    window_spans,
)
from dataset_convert.frames import INTERVENTION, RGB, recorded_arrays
from dataset_convert.language import read_embeddings
from dataset_convert.options import ConvertConfig
from dataset_convert.poses import describe_cameras
from dataset_convert.shards import Job, cut_into_shards, describe, staging_of
from dataset_convert.shared import ValidationStates, find_shared
from lerobot_lansar.calvin import CAMERAS, SCENE_NAMES, TASKS
from lerobot_lansar.datasets import NO_COMMAND

FRAMES_PER_SHARD = 8000
"""Frames in one parquet file, and in one mp4 per camera (about 30 MB)."""


EXCLUDE_SHARED = "--exclude_shared=true leaves them out"

type LeftOut = list[dict[str, Any]]
"""Descriptions of episodes that are left out, for the manifest."""


def make_plan(config: ConvertConfig, split: CalvinSplit) -> tuple[Job, Any, dict[str, Any]]:
    """Decides which episodes there will be and in which shards; prints what is unusual about the source.

    Returns:
        The work, LeRobot's description of the dataset, and what to report in the manifest.

    Raises:
        FileNotFoundError: Frames are missing and `skip_bad` is off, or pictures were not recorded.
        ValueError: The source contradicts what is known of its scenes, or nothing is left to convert.
    """
    if config.mode == "windows" and not split.windows:
        raise ValueError(f"{split.language} holds no annotated window: --mode=play needs none")
    if not split.scenes_from.startswith("scene_info"):
        warn(f"{split.folder}: scene {', '.join(split.scenes)} ({split.scenes_from})")
    if config.lang_embeddings:
        read_embeddings(split.language, len(split.windows))  # an error comes now, not after the long part
    shared, validation = _shared_frames(config, split)
    spans, left_out = _choose_spans(config, split, shared if config.exclude_shared else [])
    scenes = sorted({span.scene for span in spans})
    orders, report = _block_orders(config, split, scenes)
    unknown_tasks = sorted({window.task for window in split.windows} - set(TASKS))
    if config.task_in_state and unknown_tasks:
        raise ValueError(f"--task_in_state=true: {', '.join(unknown_tasks)} is none of CALVIN's {len(TASKS)} tasks")

    from dataset_convert import features  # imports LeRobot, which takes seconds; worker processes import this module

    size = _image_size(config, split)
    recorded = recorded_arrays(split.frame_file(span.start) for span in spans)
    cameras = [camera for camera in CAMERAS if f"rgb_{camera}" in recorded] or list(CAMERAS)
    pictures = features.pictures_of(config.images, config.depth, config.tactile, config.rgb_encoder, size, cameras)
    says_who_acted = INTERVENTION.keys() <= recorded
    info = features.empty_info(
        config.action,
        pictures,
        config.scene_state,
        config.task_in_state,
        config.camera_poses,
        says_who_acted or config.is_intervention,
    )
    job = Job(
        split=split,
        folder=staging_of(config.target),
        spans=spans,
        shards=cut_into_shards([len(span) for span in spans], FRAMES_PER_SHARD),
        layout=features.layout_of(info, pictures),
        action=config.action,
        scene_state=config.scene_state,
        task_in_state=config.task_in_state,
        block_orders=orders,
        sentences=_sentences(split, spans),
        task_names=[*TASKS, *unknown_tasks],
        scene_names=[*SCENE_NAMES, *sorted(set(scenes) - set(SCENE_NAMES))],
        skip_bad=config.skip_bad,
        camera_poses=config.camera_poses,
        interventions="recorded" if says_who_acted else "all" if config.is_intervention else "",
        also_checked=tuple(RGB) if config.embed else (),
        validation=None if config.exclude_shared else validation,
    )
    _check_recorded(job)
    report |= {"license": config.license, "scenes_from": split.scenes_from, "shared_frames": shared}
    report["look"] = {**asdict(split.look), "image_size": size}
    report["cameras"] = describe_cameras(job.layout.camera_sizes())
    return job, info, {**report, "left_out": left_out}


def warn(text: str) -> None:
    """Prints a line on the standard error stream."""
    print(text, file=sys.stderr)


def _image_size(config: ConvertConfig, split: CalvinSplit) -> int:
    """Width and height of both cameras' pictures in the dataset; 0: the cameras' own.

    Raises:
        ValueError: They were recorded at another size already; at a second resizing they would no longer be what the
            environment shows.
    """
    recorded = split.look.image_size
    if config.image_size and recorded not in (0, config.image_size):
        raise ValueError(
            f"--image_size={config.image_size}: {split.folder} was recorded with --image_size={recorded}; leave out "
            "--image_size, or record again without it"
        )
    return config.image_size or recorded


def _block_orders(
    config: ConvertConfig, split: CalvinSplit, scenes: list[str]
) -> tuple[dict[str, tuple[str, ...]], dict[str, Any]]:
    """Each scene's block order, and what speaks for and against it.

    Raises:
        ValueError: Something speaks against it and the user has not decided.
    """
    orders, votes, against = {}, {}, {}
    for scene in scenes:
        evidence = blocks.gather_evidence(split, scene)
        orders[scene] = blocks.block_order(scene, evidence, config.block_order)
        votes[scene] = evidence.votes.tolist()
        if contrary := blocks.contradictions(scene, evidence):
            against[scene] = contrary
            warn(f"warning: scene {scene}: {'; '.join(contrary)}; --block_order={config.block_order} takes no notice")
    return orders, {"block_votes": votes, "contradictions": against}


def _shared_frames(config: ConvertConfig, split: CalvinSplit) -> tuple[list[int], ValidationStates | None]:
    """Frames that are in training and in validation, of which it prints what happens to them; validation's states."""
    workers = config.workers if config.executor == "local" else 1
    validation = ValidationStates.read(split.root / "validation", workers) if config.split == "training" else None
    if validation is None and config.exclude_shared:
        raise FileNotFoundError(
            f"--exclude_shared=true needs the frames of {split.root / 'validation'}, which is empty or missing: "
            "download them, or leave out the option"
        )
    if validation is None:
        return [], None
    shared = find_shared(split, validation, _planned_frames(config, split) if config.exclude_shared else None, workers)
    if shared:
        used = [f for f in shared if any(first <= f <= last for first, last in split.recordings)]
        fate = "left out" if config.exclude_shared else f"kept; {EXCLUDE_SHARED}"
        fate = f"{len(used)} of them inside training's recordings, {fate}" if used else "in no recording, not converted"
        warn(f"frames {as_ranges(shared)} are in training and in validation: {fate}")
    return shared, validation


def _planned_frames(config: ConvertConfig, split: CalvinSplit) -> np.ndarray:
    """Frames that can become part of an episode; some of them several times."""
    if config.mode == "play":
        spans = [(first, last + 1) for first, last in split.recordings.tolist()]
    else:
        spans = [(w.start, w.end) for number, w in enumerate(split.windows) if number not in split.faults]
    return np.concatenate([np.arange(start, end) for start, end in spans])


def _choose_spans(config: ConvertConfig, split: CalvinSplit, excluded: list[int]) -> tuple[list[Span], LeftOut]:
    """The episodes, and descriptions of those that cannot become one."""
    if config.mode == "play":
        spans = play_spans(split, excluded)
    else:
        spans = window_spans(split.windows, config.dedup, excluded, split.faults)
    windows = split.windows
    faulty = [(Span(windows[n].start, windows[n].end, windows[n].scene, (n,)), why) for n, why in split.faults.items()]
    left_out = [{**describe(span), "reason": reason} for span, reason in faulty]
    for step in (_without_scene, _without_missing):
        spans, lost = step(config, split, spans)
        left_out += lost
    if not spans:
        first = f"; the first: {left_out[0]['reason']}" if left_out else ""
        raise ValueError(f"{split.folder}: no episode is left to convert{first}")
    inside = sum(len(span.windows) for span in spans)
    if inside < len(split.windows):
        warn(f"{len(split.windows) - inside} of {len(split.windows)} annotated windows are left out")
    return spans, left_out


def _without_scene(config: ConvertConfig, split: CalvinSplit, spans: list[Span]) -> tuple[list[Span], LeftOut]:
    """Leaves out recordings that lie in no scene."""
    lost = [span for span in spans if not span.scene]
    reason = f"lies in no scene of scene_info.npy {split.scenes}"
    if lost and not config.skip_bad:
        raise ValueError(
            f"{split.folder / 'ep_start_end_ids.npy'}: recording [{lost[0].start}, {lost[0].end}) {reason}"
        )
    return [span for span in spans if span.scene], [{**describe(span), "reason": reason} for span in lost]


def _without_missing(config: ConvertConfig, split: CalvinSplit, spans: list[Span]) -> tuple[list[Span], LeftOut]:
    """Leaves out episodes of which frames are missing."""
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


def _check_recorded(job: Job) -> None:
    """Reads an episode's first frame, so that pictures that were not recorded are reported at once.

    Raises:
        FileNotFoundError, ValueError: It cannot be read; with `skip_bad`, no episode's first frame can.
    """
    arrays = [*job.numbers(), *job.arrays()]
    first_error: Exception | None = None
    for span in job.spans:
        try:
            job.split.read([span.start], arrays)
            return
        except (FileNotFoundError, ValueError) as error:
            if not job.skip_bad:
                raise
            first_error = first_error or error
    raise ValueError(f"{job.split.folder}: no episode is left to convert; the first: {first_error}") from first_error
