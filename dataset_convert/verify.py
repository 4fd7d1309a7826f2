"""`lansar-verify`: compares a converted dataset with its source, frame by frame."""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from tqdm import tqdm

from dataset_convert.episodes import as_ranges
from dataset_convert.verify_cameras import check_cameras
from dataset_convert.verify_claims import Dataset, Mismatch, check_claims
from dataset_convert.verify_frames import Found, verify_file
from lerobot_lansar.command import run_command
from lerobot_lansar.datasets import MANIFEST, find_dataset
from lerobot_lansar.jobs.pool import in_processes


@dataclass
class VerifyConfig:
    """Compares every frame of a converted dataset with the CALVIN folder it came from."""

    # Name of the dataset, you/name.
    repo_id: str
    # Folder of the CALVIN dataset, the one that holds training/ and validation/.
    root: Path
    # The dataset's folder; by default where LeRobot looks for a dataset of that name, or its download from the hub.
    dataset_dir: Path | None = None
    # Smallest peak signal-to-noise ratio (dB) that a picture in a video may have; PNGs must be equal.
    min_psnr: float = 22.0
    # Processes that compare in parallel.
    workers: int = 1


def verify(config: VerifyConfig) -> str:
    """Compares a dataset with its source.

    Returns:
        A few lines that say what was compared.

    Raises:
        FileNotFoundError: Files of one of them are missing.
        Mismatch: They differ; the message says where.
        ValueError: The source is defective, or an option wrong.
    """
    if config.workers < 1:
        raise ValueError(f"--workers={config.workers}: expected 1 or more")
    folder = find_dataset(config.repo_id, config.dataset_dir)
    dataset = Dataset(folder, config.root)
    told = check_claims(dataset)
    if wrong := check_cameras(dataset):
        raise Mismatch(f"{folder}/{MANIFEST}: {wrong}")
    found = _verify_frames(dataset, config)
    _check_stats(dataset, found)
    _check_shared(dataset, found)
    lines = [
        f"{folder}: {len(dataset.spans)} episodes, {found.frames} frames equal {dataset.split.folder}: all states and "
        "both forms of the action exactly, as are commands, tasks, scenes, windows and times",
        f"{len(dataset.manifest['left_out'])} defective episodes are listed as left out; no other one is missing",
    ]
    for key, feature in dataset.features.items():
        if key in found.psnr:
            mean, worst = np.mean(found.psnr[key]), np.min(found.psnr[key])
            lines.append(f"{key}: video, PSNR {mean:.1f} dB on average, {worst:.1f} at worst")
        elif feature["dtype"] == "image":
            lines.append(f"{key}: equal, pixel by pixel")
    return "\n".join(lines + told)


def _verify_frames(dataset: Dataset, config: VerifyConfig) -> Found:
    """Compares all files of frames; returns what they hold together."""
    files = sorted((dataset.folder / "data").rglob("*.parquet"))
    work = partial(verify_file, dataset, min_psnr=config.min_psnr)
    whole, total = Found(), dataset.info["total_frames"]
    with tqdm(total=total, desc="verifying", unit="frame") as bar:
        for found in in_processes(work, files, config.workers):
            bar.update(found.frames)
            whole.add(found)
    if whole.frames != total:
        raise Mismatch(f"{dataset.folder}/data holds {whole.frames} frames, meta/info.json says {total}")
    return whole


def _check_stats(dataset: Dataset, found: Found) -> None:
    """The smallest, largest and mean numbers of meta/stats.json are those of the frames."""
    stats: dict[str, Any] = json.loads((dataset.folder / "meta/stats.json").read_text())
    for key, (low, high, total) in found.sums.items():
        for name, wanted in (("min", low), ("max", high), ("mean", total / found.frames)):
            if not np.allclose(stats[key][name], wanted, rtol=1e-5, atol=1e-6):
                raise Mismatch(f"{dataset.folder}/meta/stats.json: {name} of {key} is not that of the frames")


def _check_shared(dataset: Dataset, found: Found) -> None:
    """Frames of training that are in validation too are those that the manifest lists; with exclude_shared, none."""
    if dataset.validation is None:
        return
    listed = set() if dataset.manifest["request"]["exclude_shared"] else set(dataset.manifest["shared_frames"])
    unlisted = sorted(found.shared - listed)
    if unlisted:
        raise Mismatch(
            f"{dataset.folder}: training and validation share frames {as_ranges(unlisted)}, which are here and "
            f"{'should be left out' if dataset.manifest['request']['exclude_shared'] else 'are not listed'}"
        )


@draccus.wrap()
def run(config: VerifyConfig) -> int:
    """Verifies; 1 if the dataset differs from its source."""
    try:
        print(verify(config))
    except Mismatch as error:
        print(f"mismatch: {error}", file=sys.stderr)
        return 1
    return 0


def main() -> int:
    """Entry point of `lansar-verify`."""
    return run_command("lansar-verify", run)


if __name__ == "__main__":
    sys.exit(main())
