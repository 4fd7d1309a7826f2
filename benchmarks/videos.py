"""What videos keep of pictures: codecs and pixel formats by size, signal-to-noise ratio and time.

   python benchmarks/videos.py [--frames=DIR] [--count=1000] [--assets=DIR] [--output=FILE.json]

The frames are CALVIN's: those of a folder of `episode_….npz` files, or of demonstrations recorded here on all four
desks. Luma and chroma are compared as 8-bit YCbCr at full resolution; a ratio is that of all pictures together.
Decoding is what training does: single frames at random times, by LeRobot's own function.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus
import numpy as np
from lerobot.datasets.video_utils import decode_video_frames
from PIL import Image
from tqdm import tqdm

from dataset_convert.features import pictures_of
from dataset_convert.layout import Picture, RGBEncoder
from dataset_convert.writer import Video
from lerobot_lansar.calvin import CAMERAS, CONTROL_HZ

ENCODERS = {
    "h264 18 yuv420p": RGBEncoder(pix_fmt="yuv420p"),
    "h264 18 yuv444p": RGBEncoder(pix_fmt="yuv444p"),
    "h264 20 yuv444p": RGBEncoder(crf=20, pix_fmt="yuv444p"),
    "h264 23 yuv444p": RGBEncoder(crf=23, pix_fmt="yuv444p"),
    "libsvtav1 30 yuv420p (LeRobot's default)": RGBEncoder(vcodec="libsvtav1", crf=30, preset="12", pix_fmt="yuv420p"),
}
DECODED = 200
"""Frames that are decoded one by one."""


@dataclass
class Options:
    """What to measure."""

    # Folder of CALVIN's frames; recorded here by default.
    frames: Path | None = None
    # Frames at most.
    count: int = 1000
    # `data` folder of a calvin_env checkout, for recording; the built-in desk by default.
    assets: str | None = None
    # JSON file for the results.
    output: Path | None = None


@dataclass
class Row:
    """One encoder on one camera: kB per picture, ratios (dB), and ms per picture."""

    camera: str
    encoder: str
    kilobytes: float
    psnr_rgb: float
    psnr_luma: float
    psnr_chroma: float
    encode_ms: float
    decode_ms: dict[str, float]


def record(target: Path, assets: str | None) -> Path:
    """Records demonstrations of all tasks on all desks; returns the folder of the frames."""
    words = ["--scene=[A,B,C,D]", "--episodes=136", "--validation_episodes=4", "--workers=2", f"--output_dir={target}"]
    words += [f"--assets={assets}"] if assets else []
    command = [sys.executable, "-m", "lerobot_lansar.demos.record", *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return target / "training"


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio, dB, of all pictures together."""
    error = ((a.astype(np.float32) - b) ** 2).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def as_ycbcr(pictures: np.ndarray) -> np.ndarray:
    """RGB pictures (n, H, W, 3) as YCbCr."""
    return np.stack([np.asarray(Image.fromarray(picture).convert("YCbCr")) for picture in pictures])


def decoders() -> list[str]:
    """LeRobot's decoders that work here."""
    try:
        from torchcodec.decoders import VideoDecoder  # noqa: F401
    except (ImportError, RuntimeError, OSError):
        return ["pyav"]
    return ["pyav", "torchcodec"]


def measure(picture: Picture, name: str, pictures: np.ndarray, file: Path) -> Row:
    """Encodes and decodes one camera's pictures."""
    started = time.perf_counter()
    with Video(file, picture) as video:
        video.add(pictures)
    encode = time.perf_counter() - started
    times = [number / CONTROL_HZ for number in range(len(pictures))]

    def decode(which: list[float], backend: str) -> np.ndarray:
        frames = decode_video_frames(file, which, 1e-4, backend, return_uint8=True)
        return frames.numpy().transpose(0, 2, 3, 1)

    stored = np.concatenate([decode(times[start : start + 100], "pyav") for start in range(0, len(times), 100)])
    chosen = np.random.default_rng(0).choice(times, DECODED)
    milliseconds = {}
    for backend in decoders():
        decode(times[:1], backend)
        started = time.perf_counter()
        for moment in chosen:
            decode([float(moment)], backend)
        milliseconds[backend] = (time.perf_counter() - started) / DECODED * 1e3
    ours, theirs = as_ycbcr(stored), as_ycbcr(pictures)
    return Row(
        camera=picture.key.rpartition(".")[2],
        encoder=name,
        kilobytes=file.stat().st_size / len(pictures) / 1e3,
        psnr_rgb=psnr(stored, pictures),
        psnr_luma=psnr(ours[..., 0], theirs[..., 0]),
        psnr_chroma=psnr(ours[..., 1:], theirs[..., 1:]),
        encode_ms=encode / len(pictures) * 1e3,
        decode_ms=milliseconds,
    )


def main() -> None:
    """Measures and prints a table."""
    options = draccus.parse(Options)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = options.frames or record(Path(name) / "desks", options.assets)
        files = sorted(folder.glob("episode_*.npz"))
        # runs of 50 frames from everywhere: neighbours must stay neighbours
        runs = [files[start : start + 50] for start in range(0, len(files), 50)]
        step = -(-len(runs) * 50 // options.count)
        chosen = [file for run in runs[::step] for file in run]
        for camera in tqdm(CAMERAS, desc="cameras"):
            pictures = np.stack([np.load(file)[f"rgb_{camera}"] for file in chosen])
            for encoder, settings in tqdm(ENCODERS.items(), desc=camera, leave=False):
                (picture,) = (p for p in pictures_of("video", False, False, settings) if p.array == f"rgb_{camera}")
                file = Path(name) / f"{len(rows)}.mp4"  # a name of its own: LeRobot keeps open decoders by path
                rows.append(measure(picture, encoder, pictures, file))
    names = list(rows[0].decode_ms)
    print(f"{len(pictures)} pictures of each camera\n")
    print("| camera | encoder | kB | RGB dB | luma | chroma | encode ms |", *(f"{n} ms |" for n in names))
    print("| --- | --- |" + " ---: |" * (5 + len(names)))
    for row in rows:
        numbers = [row.kilobytes, row.psnr_rgb, row.psnr_luma, row.psnr_chroma, row.encode_ms, *row.decode_ms.values()]
        print(f"| {row.camera} | {row.encoder} |", *(f"{number:.2f} |" for number in numbers))
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
