"""How fast a CALVIN folder becomes a LeRobotDataset: `lansar-convert` against a loop over LeRobot's `add_frame`.

    python benchmarks/convert.py [--root=DIR] [--episodes=136] [--repeat=4] [--loop_episodes=20] [--output=FILE.json]

The loop is the one of LeRobot's own examples: pictures are staged as PNG files and encoded when the episode is saved.
It is timed without its imports, lansar-convert as a whole command (most of its start-up is importing LeRobot). Both run
with both video codecs, LeRobot's default and ours, to separate what the codec gains from what the writer gains.
"""

import json
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus
import numpy as np
from tqdm import tqdm

from dataset_convert.calvin import CalvinSplit
from dataset_convert.features import dataset_features, pictures_of
from dataset_convert.layout import RGBEncoder
from dataset_convert.safe_pickle import load_object_array
from lerobot_lansar.calvin import CONTROL_HZ, TASKS
from lerobot_lansar.cameras import gripper_camera_pose

OURS = RGBEncoder()
LEROBOTS = RGBEncoder(vcodec="libsvtav1", crf=30, preset="12", pix_fmt="yuv420p")
ABCD_FRAMES = 2_400_000
CORES = 32


@dataclass
class Options:
    """What to measure."""

    # A CALVIN folder with pictures; recorded here by default.
    root: Path | None = None
    # Episodes to record.
    episodes: int = 136
    # How often lansar-convert gets every window, so that its start-up matters as little as in a real conversion.
    repeat: int = 4
    # Episodes that the loop converts.
    loop_episodes: int = 20
    # JSON file for the results.
    output: Path | None = None


@dataclass
class Measured:
    """One way to convert: frames per second, megabytes per thousand frames."""

    frames_per_second: float
    mb_per_1000_frames: float


def size(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def loop(root: Path, episodes: int, encoder: RGBEncoder, images: str, target: Path) -> Measured:
    """Converts the first windows as LeRobot's examples do."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.constants import DEFAULT_FEATURES

    split = CalvinSplit(root, "training")
    pictures = pictures_of(images, depth=False, tactile=False, encoder=encoder)
    features = {k: v for k, v in dataset_features("rel", pictures).items() if k not in DEFAULT_FEATURES}
    pix_fmt = "yuv444p" if encoder.pix_fmt == "auto" else encoder.pix_fmt
    settings = RGBEncoderConfig(**{**asdict(encoder), "pix_fmt": pix_fmt})
    codec = {"rgb_encoder": settings} if images == "video" else {}
    frames, started = 0, time.perf_counter()
    dataset = LeRobotDataset.create(
        "benchmark/desk",
        CONTROL_HZ,
        features,
        target,
        "panda",
        use_videos=images == "video",
        image_writer_threads=4,
        **codec,
    )
    for number, window in enumerate(tqdm(split.windows[:episodes], desc="add_frame", unit="episode", leave=False)):
        for frame in range(window.start, window.end):
            with np.load(split.frame_file(frame)) as content:
                item = {
                    "observation.state": content["robot_obs"].astype(np.float32),
                    "calvin.gripper_camera_pose": gripper_camera_pose(content["robot_obs"]).reshape(16).astype("f4"),
                    "observation.environment_state": content["scene_obs"].astype(np.float32),
                    "action": content["rel_actions"].astype(np.float32),
                    "calvin.actions": content["actions"].astype(np.float32),
                    "observation.images.static": content["rgb_static"],
                    "observation.images.gripper": content["rgb_gripper"],
                }
            numbers = {"frame": frame, "window": number, "task": list(TASKS).index(window.task), "scene": 0}
            item |= {f"calvin.{name}": np.array([value]) for name, value in numbers.items()}
            dataset.add_frame({**item, "task": window.sentence})
            frames += 1
        dataset.save_episode()
    dataset.finalize()
    return Measured(frames / (time.perf_counter() - started), size(target) / 1e3 / frames)


def command(root: Path, encoder: RGBEncoder, images: str, workers: int, target: Path) -> Measured:
    """Converts all windows with lansar-convert."""
    words = [
        sys.executable,
        "-m",
        "dataset_convert",
        f"--root={root}",
        "--repo_id=benchmark/desk",
        f"--workers={workers}",
        f"--output_dir={target}",
        f"--images={images}",
        *(f"--rgb_encoder.{name}={value}" for name, value in asdict(encoder).items() if value is not None),
    ]
    started = time.perf_counter()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    spent = time.perf_counter() - started
    frames = json.loads((target / "meta/info.json").read_text())["total_frames"]
    return Measured(frames / spent, size(target) / 1e3 / frames)


def record(episodes: int, target: Path) -> None:
    """Records demonstrations with pictures."""
    words = [
        sys.executable,
        "-m",
        "lerobot_lansar.demos.record",
        f"--output_dir={target}",
        f"--episodes={episodes}",
        "--scene=[A,B,C,D]",
        "--validation_episodes=4",
        "--workers=2",
        "--cameras=[static,gripper]",
    ]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def repeated(root: Path, times: int, target: Path) -> None:
    """Copies a CALVIN folder with every window listed `times` times; frames are links."""
    training = target / "training"
    (training / "lang_annotations").mkdir(parents=True)
    for file in (root / "training").iterdir():
        if file.is_file():
            (training / file.name).symlink_to(file.resolve())
    name = "lang_annotations/auto_lang_ann.npy"
    listed = load_object_array(root / "training" / name)
    for part, keys in (("language", ("ann", "task")), ("info", ("indx",))):
        for key in keys:
            listed[part][key] = list(listed[part][key]) * times
    np.save(training / name, listed, allow_pickle=True)


def main() -> None:
    """Measures and prints a table."""
    options = draccus.parse(Options)
    rows: dict[str, Measured] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        root = options.root
        if root is None:
            root = folder / "desk"
            record(options.episodes, root)
        many = folder / "many"
        repeated(root, options.repeat, many)
        ways = (
            ("h264", OURS, "video", (1, 2)),
            ("LeRobot's default AV1", LEROBOTS, "video", (2,)),
            ("PNG", OURS, "png", (2,)),
        )
        target = folder / "dataset"
        for codec, encoder, images, counts in tqdm(ways, desc="codecs"):
            rows[f"add_frame, {codec}"] = loop(root, options.loop_episodes, encoder, images, target)
            shutil.rmtree(target)
            for workers in counts:
                rows[f"lansar-convert, {codec}, {workers} workers"] = command(many, encoder, images, workers, target)
                shutil.rmtree(target)
    print("| | frames per second | MB per 1000 frames |\n| --- | ---: | ---: |")
    for way, row in rows.items():
        print(f"| {way} | {row.frames_per_second:.0f} | {row.mb_per_1000_frames:.2f} |")
    one, two = (rows[f"lansar-convert, h264, {n} workers"].frames_per_second for n in (1, 2))
    default = rows["add_frame, LeRobot's default AV1"].frames_per_second
    result = {
        "rows": {way: asdict(row) for way, row in rows.items()},
        "times_add_frame_with_its_default": two / default,
        "times_add_frame_with_our_codec": two / rows["add_frame, h264"].frames_per_second,
        "times_add_frame_with_its_default_one_worker": one / default,
        "two_workers_times_one": two / one,
        "hours_for_abcd_on_32_cores": ABCD_FRAMES / (two / 2 * CORES) / 3600,
    }
    for key, value in result.items():
        if isinstance(value, float):
            print(f"{key.replace('_', ' '):44s} {value:8.3f}")
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
