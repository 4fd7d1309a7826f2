"""`lansar-embed`: CLIP embeddings of a dataset's pictures, computed once and stored beside it.

It reads a finished dataset. `lansar-convert --embed=true` does the same with the source's pictures: they are not
compressed, and exist even if the dataset has none.
"""

import functools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import draccus
import numpy as np
from filelock import FileLock, Timeout
from tqdm import tqdm

from dataset_convert import card
from dataset_convert.calvin import CalvinSplit
from dataset_convert.layout import check_format
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.store import IMAGE_FEATURES, PARTIAL, EmbeddingWriter, clip_dir, dataset_fingerprint
from lerobot_lansar.command import run_command
from lerobot_lansar.datasets import MANIFEST, find_dataset
from lerobot_lansar.pictures import resize

if TYPE_CHECKING:
    from lerobot_lansar.clip.model import Clip

ARRAYS = {feature: f"rgb_{camera}" for camera, feature in IMAGE_FEATURES.items()}
"""The pictures that are embedded: LeRobot's feature to CALVIN's array."""

_SAVE_EVERY = 20  # batches
_PATIENCE = 3.0  # s to wait for another process, in case it is just ending


@dataclass
class EmbedConfig:
    """Stores CLIP embeddings of a LeRobotDataset's pictures in its folder `clip`."""

    # Name of the dataset, you/name.
    repo_id: str
    # Its folder; by default where LeRobot looks for a dataset of that name, or LeRobot's download from the hub.
    dataset_dir: Path | None = None
    # Which CLIP embeds the pictures.
    clip: ClipConfig = field(default_factory=ClipConfig)
    # Pictures of each camera at a time.
    batch_size: int = 128
    # Processes that decode pictures, beside the one that embeds them.
    num_workers: int = 0


class Pictures(Protocol):
    """Distinct pictures, and the rows of the dataset that show each one; a torch dataset.

    Attributes:
        rows: For each item the numbers of the dataset's rows that show it, (n,).
        name: Where the pictures are from.
    """

    rows: list[np.ndarray]
    name: str

    def __len__(self) -> int: ...

    def __getitem__(self, item: int) -> dict[str, Any]:
        """Feature to uint8 (H, W, 3), or float (3, H, W) in [0, 1]."""
        ...


class SourcePictures:
    """The pictures of the CALVIN folder, at the dataset's size; a frame that is in several windows occurs once.

    Args:
        split: Where they are.
        root: The converted dataset.
    """

    name = "source"

    def __init__(self, split: CalvinSplit, root: Path):
        manifest = json.loads((root / MANIFEST).read_text())
        episodes, self._size = manifest["episodes"], manifest["look"]["image_size"]
        frames = np.concatenate([np.arange(episode["start"], episode["end"]) for episode in episodes])
        self.split = split
        self.frames, first = np.unique(frames, return_inverse=True)
        order = np.argsort(first, kind="stable")
        self.rows = np.split(order, np.cumsum(np.bincount(first))[:-1])

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, item: int) -> dict[str, Any]:
        read = self.split.read([int(self.frames[item])], ARRAYS.values())
        pictures = {key: read[array][0] for key, array in ARRAYS.items()}
        return {key: resize(picture, self._size or len(picture)) for key, picture in pictures.items()}


class DatasetPictures:
    """The pictures of a LeRobotDataset, decoded by LeRobot.

    Raises:
        ValueError: It lacks one of the two cameras.
    """

    name = "dataset"

    def __init__(self, repo_id: str, root: Path):
        # Takes seconds, and lansar-convert's worker processes import this module.
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        self.dataset = LeRobotDataset(repo_id, root=root)
        missing = ARRAYS.keys() - set(self.dataset.meta.camera_keys)
        if missing:
            raise ValueError(
                f"{root} has no {', '.join(sorted(missing))}: convert it with --images=video or png, or embed while "
                "converting (lansar-convert --embed=true)"
            )
        self.rows = [np.array([row]) for row in range(len(self.dataset))]

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, item: int) -> dict[str, Any]:
        found = self.dataset[item]
        return {key: found[key] for key in ARRAYS}


@functools.cache
def load_clip(model: str, pretrained: str) -> "Clip":
    """Loads a CLIP, on the GPU if there is one.

    Args:
        model: open_clip model name.
        pretrained: open_clip's tag or a weights file; "" for an untrained model.

    Raises:
        ValueError: There is no such model, or its weights cannot be loaded.
    """
    # Take seconds, and lansar-convert's worker processes import this module.
    import torch

    from lerobot_lansar.clip.model import Clip

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return Clip(ClipConfig(model=model, pretrained=pretrained), device)
    except Exception as error:  # open_clip, the hub and torch each raise their own
        raise ValueError(f"--clip.model={model} --clip.pretrained={pretrained}: {error}") from error


def embed(
    root: Path,
    pictures: Pictures,
    clip: "Clip",
    options: ClipConfig,
    *,
    batch_size: int = 128,
    num_workers: int = 0,
) -> None:
    """Writes `clip/<image feature>.npy`, (total_frames, D) float16 ordered by absolute index, and `clip/clip.json`.

    `clip.json` names the CLIP, the frames (`fingerprint`) and each array's SHA-256. The folder appears complete; a
    pass that was interrupted, or killed at any time, goes on where it was last saved.

    Args:
        root: The dataset's folder.
        pictures: What to embed.
        clip: What `load_clip` returned.
        options: Names it.
        batch_size: Pictures of each camera at a time.
        num_workers: Processes that read pictures.

    Raises:
        ValueError: There are embeddings of another CLIP, or of other frames, or another process is embedding.
    """
    lock = (root / PARTIAL).with_suffix(".lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(lock, timeout=_PATIENCE):
            _embed(root, pictures, clip, options, batch_size, num_workers)
    except Timeout:
        raise ValueError(f"another process is embedding the pictures of {root}: wait for it or stop it") from None


def _embed(
    root: Path, pictures: Pictures, clip: "Clip", options: ClipConfig, batch_size: int, num_workers: int
) -> None:
    from torch.utils.data import DataLoader, Subset  # late, as in load_clip

    writer = EmbeddingWriter(
        root,
        {
            "model": options.model,
            "pretrained": Path(options.pretrained).name,
            "weights_sha256": clip.weights_sha256,
            "embed_dim": clip.embed_dim,
            "frames": sum(len(rows) for rows in pictures.rows),
            "fingerprint": dataset_fingerprint(root),
            "pictures": pictures.name,
        },
    )
    if writer.finished:
        return
    todo: Any = Subset(pictures, range(writer.done, len(pictures)))  # type: ignore[arg-type]
    loader = DataLoader(
        todo, batch_size, num_workers=num_workers, multiprocessing_context="fork" if num_workers else None
    )
    with tqdm(total=len(pictures), initial=writer.done, desc="CLIP", unit="frame") as bar:
        for number, batch in enumerate(loader, start=1):
            size = len(next(iter(batch.values())))
            rows = pictures.rows[writer.done : writer.done + size]
            writer.add(rows, {key: clip.encode_images(batch[key]).cpu().numpy() for key in ARRAYS})
            bar.update(size)
            if number % _SAVE_EVERY == 0:
                writer.save()
    writer.finish()


@draccus.wrap()
def run(config: EmbedConfig) -> None:
    """Embeds, and says where the embeddings are."""
    if config.batch_size < 1 or config.num_workers < 0:
        raise ValueError("--batch_size must be 1 or more, --num_workers 0 or more")
    root = find_dataset(config.repo_id, config.dataset_dir)
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"{root} holds no LeRobotDataset: give its folder as --dataset_dir")
    has_card = (root / MANIFEST).exists()
    if has_card:
        check_format(root, json.loads((root / MANIFEST).read_text()))
    clip = load_clip(config.clip.model, config.clip.pretrained)
    pictures = DatasetPictures(config.repo_id, root)
    embed(root, pictures, clip, config.clip, batch_size=config.batch_size, num_workers=config.num_workers)
    if has_card:
        card.write(root, config.repo_id)
    print(f"embeddings are in {clip_dir(root)}")


def main() -> int:
    """Entry point of `lansar-embed`."""
    return run_command("lansar-embed", run, resumable=True)


if __name__ == "__main__":
    sys.exit(main())
