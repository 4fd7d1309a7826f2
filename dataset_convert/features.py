"""What a converted dataset looks like to LeRobot: its features, its videos' codecs, the files that describe it.

Imports LeRobot, which takes seconds: `plan` and `finish`, which run once, use this; workers do not.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
from lerobot.configs import DepthEncoderConfig, RGBEncoderConfig
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.feature_utils import create_empty_dataset_info, get_hf_features_from_features
from lerobot.datasets.io_utils import write_info, write_stats, write_tasks
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH, DatasetInfo
from lerobot.datasets.video_utils import get_video_info
from lerobot.utils.constants import DEFAULT_FEATURES

from dataset_convert.frames import TACTILE, shape_of
from dataset_convert.layout import Codec, Layout, Picture, RGBEncoder, camera_sizes
from dataset_convert.poses import pose_features
from dataset_convert.stats import Stats
from lerobot_lansar.calvin import ACTION_NAMES, CAMERAS, CONTROL_HZ, ROBOT_OBS_NAMES, SCENE_OBS_NAMES, TASKS
from lerobot_lansar.datasets import INTERVENTION_FEATURE

_TASK_NAMES = [f"task_{task}" for task in TASKS]
_NUMBERS = ("calvin.frame", "calvin.window", "calvin.task", "calvin.scene")

# ---- cameras and codecs


def pictures_of(
    images: str,
    depth: bool,
    tactile: bool,
    encoder: RGBEncoder,
    image_size: int = 0,
    cameras: Iterable[str] = tuple(CAMERAS),
) -> tuple[Picture, ...]:
    """All camera features that these options ask for.

    Args:
        images: `"video"`, `"png"` or `"none"`.
        depth: Both cameras' distances too.
        tactile: The fingertip sensors too. Their depth, fractions of a millimetre, is always stored exactly.
        encoder: Of the colour videos.
        image_size: Width and height of both cameras' pictures; 0: the cameras' own.
        cameras: Those that were recorded.

    Raises:
        ValueError: LeRobot cannot encode like this here.
    """
    if images == "none":
        return ()
    rgb_codec, depth_codec = (_rgb_codec(encoder), _depth_codec()) if images == "video" else (None, None)
    if rgb_codec and image_size % 2 and "444" not in rgb_codec.pix_fmt:
        raise ValueError(f"--image_size={image_size}: videos as {rgb_codec.pix_fmt} need an even number")
    found = [_camera_picture(f"rgb_{camera}", image_size, rgb_codec) for camera in cameras]
    if depth:
        found += [_camera_picture(f"depth_{camera}", image_size, depth_codec) for camera in cameras]
    if tactile:
        height, width, _ = TACTILE["rgb_tactile"]
        for finger in range(2):
            key = f"observation.images.tactile_{finger}"
            channels = slice(3 * finger, 3 * finger + 3)
            found.append(Picture(key, "rgb_tactile", channels, (height, width, 3), rgb_codec))
            found.append(Picture(f"{key}_depth", "depth_tactile", finger, (height, width, 1)))
    return tuple(found)


def _camera_picture(array: str, image_size: int, codec: Codec | None) -> Picture:
    """The feature that holds one of CALVIN's arrays of a camera's colours or distances."""
    kind, _, camera = array.partition("_")
    height, width = shape_of(array, image_size)[:2]
    if kind == "rgb":
        return Picture(f"observation.images.{camera}", array, slice(None), (height, width, 3), codec)
    return Picture(f"observation.images.{camera}_depth", array, 0, (height, width, 1), codec)


def _rgb_config(encoder: RGBEncoder) -> RGBEncoderConfig:
    pix_fmt = encoder.pix_fmt
    if pix_fmt == "auto":
        pix_fmt = "yuv444p" if encoder.vcodec in ("h264", "hevc") else "yuv420p"
    try:
        return RGBEncoderConfig(**{**asdict(encoder), "preset": encoder.preset or None, "pix_fmt": pix_fmt})
    except (ValueError, RuntimeError) as error:
        named = f"--rgb_encoder.vcodec={encoder.vcodec} --rgb_encoder.pix_fmt={pix_fmt}"
        raise ValueError(f"{named}: {error}") from error


def _rgb_codec(encoder: RGBEncoder) -> Codec:
    config = _rgb_config(encoder)
    # One thread per video: shards run in parallel instead.
    return Codec(config.vcodec, config.pix_fmt, config.get_codec_options(1, as_strings=True))


def _depth_codec() -> Codec:
    config = DepthEncoderConfig()
    quantizer = {name: getattr(config, name) for name in ("depth_min", "depth_max", "shift", "use_log", "pix_fmt")}
    return Codec(config.vcodec, config.pix_fmt, config.get_codec_options(1, as_strings=True), quantizer)


# ---- the dataset before anything is written


def dataset_features(
    action: str,
    pictures: tuple[Picture, ...],
    scene_state: bool = True,
    task_in_state: bool = False,
    camera_poses: bool = False,
    interventions: bool = False,
) -> dict[str, dict]:
    """LeRobot's description of the dataset's columns.

    Args:
        action: `"rel"` or `"abs"`, the form that `action` holds; the other one is kept as `calvin.actions` or
            `calvin.rel_actions`, names that LeRobot does not take for something a policy should predict.
        pictures: Camera features.
        scene_state: Whether the scene's state is stored.
        task_in_state: Whether the commanded task is stored, after the scene's state if there is one.
        camera_poses: The cameras' poses and intrinsics are observations too.
        interventions: A column says who acted.

    Returns:
        Feature name to {"dtype", "shape", "names"}, LeRobot's own columns (`index`, ...) included.
    """
    other, other_form = ("calvin.actions", "abs") if action == "rel" else ("calvin.rel_actions", "rel")
    told = [*(SCENE_OBS_NAMES if scene_state else ()), *(_TASK_NAMES if task_in_state else ())]
    features = {
        "observation.state": _vector(ROBOT_OBS_NAMES),
        **({"observation.environment_state": _vector(told)} if told else {}),
        "action": _vector(ACTION_NAMES[action]),
        other: _vector(ACTION_NAMES[other_form]),
        **{key: {"dtype": "int64", "shape": (1,), "names": None} for key in _NUMBERS},
        **({INTERVENTION_FEATURE: {"dtype": "bool", "shape": (1,), "names": None}} if interventions else {}),
        **{key: _matrix(numbers) for key, numbers in pose_features(camera_sizes(pictures), camera_poses).items()},
    }
    for picture in pictures:
        features[picture.key] = {
            "dtype": "video" if picture.codec else "image",
            "shape": picture.shape,
            "names": ["height", "width", "channels"],
        }
        if picture.is_depth:
            features[picture.key]["info"] = {"is_depth_map": True, "depth_unit": "m"}
    return {**features, **DEFAULT_FEATURES}


def _vector(names: Iterable[str]) -> dict:
    names = list(names)
    return {"dtype": "float32", "shape": (len(names),), "names": names}


def _matrix(numbers: int) -> dict:
    """A square matrix, row by row."""
    side = math.isqrt(numbers)
    return _vector(f"row_{row}_column_{column}" for row in range(side) for column in range(side))


def empty_info(
    action: str,
    pictures: tuple[Picture, ...],
    scene_state: bool,
    task_in_state: bool,
    camera_poses: bool,
    interventions: bool,
) -> DatasetInfo:
    """The dataset's description before anything is written."""
    has_videos = any(picture.codec for picture in pictures)
    features = dataset_features(action, pictures, scene_state, task_in_state, camera_poses, interventions)
    return create_empty_dataset_info(CODEBASE_VERSION, CONTROL_HZ, features, has_videos, "panda")


def layout_of(info: DatasetInfo, pictures: tuple[Picture, ...]) -> Layout:
    """What the writer needs to know of a description."""
    schema = get_hf_features_from_features(info.features).arrow_schema
    return Layout(schema, pictures, info.chunks_size, DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH)


# ---- the dataset after all shards


def merge_stats(stats: list[Stats]) -> Stats:
    """LeRobot's `aggregate_stats` in the order of the first item; its own order differs from run to run."""
    merged = aggregate_stats(stats)
    return {key: merged[key] for key in stats[0]}


def write_description(
    root: Path,
    info: DatasetInfo,
    layout: Layout,
    encoder: RGBEncoder,
    first_shard: int,
    sentences: list[str],
    episodes: int,
    frames: int,
    stats: Stats,
) -> None:
    """Writes the files that describe the whole dataset, after all shards.

    Args:
        root: The dataset's folder.
        info: What `empty_info` returned; its counters and its videos' properties are filled in.
        layout: How its files look.
        encoder: Encoded the colour videos.
        first_shard: Number of the first shard that has episodes.
        sentences: The commands, in the order of their numbers.
        episodes, frames: How many there are.
        stats: Of all frames.
    """
    for picture in layout.pictures:
        if picture.codec:
            config: Any = DepthEncoderConfig() if picture.is_depth else _rgb_config(encoder)
            found = get_video_info(root / layout.video_file(first_shard, picture.key), video_encoder=config)
            info.features[picture.key]["info"] = {**info.features[picture.key].get("info", {}), **found}
    info.total_episodes, info.total_frames, info.total_tasks = episodes, frames, len(sentences)
    info.splits = {"train": f"0:{episodes}"}
    write_tasks(pd.DataFrame({"task_index": range(len(sentences))}, index=pd.Index(sentences, name="task")), root)
    write_stats(stats, root)
    write_info(info, root)
