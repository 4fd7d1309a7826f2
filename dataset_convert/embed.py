"""`lansar-embed`: CLIP embeddings of a dataset's pictures, computed once and stored beside it.

A pass of its own over a finished dataset; `lansar-convert --embed=true` runs the same one with pictures from the
source, which were never compressed and serve a dataset without pictures too.
"""

import functools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import draccus
import numpy as np
from tqdm import tqdm

from dataset_convert import card
from dataset_convert.calvin import CalvinSplit
from dataset_convert.hub import find_dataset
from dataset_convert.layout import MANIFEST
from lerobot_lansar.clip.store import IMAGE_FEATURES, EmbeddingWriter, clip_dir, dataset_fingerprint
from lerobot_lansar.command import run_command

if TYPE_CHECKING:
    from lerobot_lansar.clip.model import Clip

ARRAYS = {feature: f"rgb_{camera}" for camera, feature in IMAGE_FEATURES.items()}
"""LeRobot feature -> CALVIN array of the pictures that are embedded."""

_SAVE_EVERY = 20  # batches


@dataclass
class ClipOptions:
    """Which CLIP embeds the pictures."""

    # open_clip's model name
    model: str = "ViT-B-32"
    # open_clip's tag of the weights, or a weights file; empty: untrained
    pretrained: str = "openai"


@dataclass
class EmbedConfig:
    """Stores CLIP embeddings of a LeRobotDataset's pictures in its folder `clip`."""

    # name of the dataset, you/name
    repo_id: str
    # its folder; by default where LeRobot looks for a dataset of that name, or its download from the hub
    dataset_dir: Path | None = None
    clip: ClipOptions = field(default_factory=ClipOptions)
    # pictures of each camera at a time
    batch_size: int = 128
    # processes that decode pictures beside the one that embeds them
    num_workers: int = 0


class Pictures(Protocol):
    """Distinct pictures, and the rows of the dataset that show each: a torch dataset.

    Attributes:
        rows: (n,) arrays of row numbers, one per item.
        name: Says where the pictures are from.
    """

    rows: list[np.ndarray]
    name: str

    def __len__(self) -> int: ...

    def __getitem__(self, item: int) -> dict[str, Any]:
        """Feature -> uint8 (H, W, 3), or float (3, H, W) in [0, 1]."""
        ...


class SourcePictures:
    """The pictures as they are in the CALVIN folder. Windows overlap there; every frame occurs once here.

    Args:
        split: Where they are.
        root: The converted dataset.
    """

    name = "source"

    def __init__(self, split: CalvinSplit, root: Path):
        episodes = json.loads((root / MANIFEST).read_text())["episodes"]
        frames = np.concatenate([np.arange(episode["start"], episode["end"]) for episode in episodes])
        self.split = split
        self.frames, first = np.unique(frames, return_inverse=True)
        order = np.argsort(first, kind="stable")
        self.rows = np.split(order, np.cumsum(np.bincount(first))[:-1])

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, item: int) -> dict[str, Any]:
        read = self.split.read([int(self.frames[item])], ARRAYS.values())
        return {key: read[array][0] for key, array in ARRAYS.items()}


class DatasetPictures:
    """The pictures of a LeRobotDataset, decoded by LeRobot.

    Raises:
        ValueError: It lacks one of the two cameras.
    """

    name = "dataset"

    def __init__(self, repo_id: str, root: Path):
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
        ValueError: There is no such model, or its weights cannot be had.
    """
    import torch

    from lerobot_lansar.clip.model import Clip, ClipConfig

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return Clip(ClipConfig(model=model, pretrained=pretrained), device)
    except Exception as error:  # open_clip, the hub and torch have each their own for a name, a download, a file
        raise ValueError(f"--clip.model={model} --clip.pretrained={pretrained}: {error}") from error


def embed(
    root: Path,
    pictures: Pictures,
    clip: "Clip",
    options: ClipOptions,
    *,
    batch_size: int = 128,
    num_workers: int = 0,
) -> None:
    """Writes `clip/<image feature>.npy`, (total_frames, D) float16 ordered by absolute index, and `clip/clip.json`.

    `clip.json` says which CLIP it was, of which frames (`fingerprint`), and each array's SHA-256. The folder
    appears complete; a pass that was interrupted, or killed at any time, goes on where it was last saved.

    Args:
        root: The dataset's folder.
        pictures: What to embed.
        clip: Of `load_clip`.
        options: Its name.
        batch_size: Pictures of each camera at a time.
        num_workers: Processes that read pictures.

    Raises:
        ValueError: There are embeddings of another CLIP, or of other frames.
    """
    from torch.utils.data import DataLoader, Subset

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
    clip = load_clip(config.clip.model, config.clip.pretrained)
    pictures = DatasetPictures(config.repo_id, root)
    embed(root, pictures, clip, config.clip, batch_size=config.batch_size, num_workers=config.num_workers)
    if (root / MANIFEST).exists():
        card.write(root, config.repo_id)
    print(f"embeddings are in {clip_dir(root)}")


def main() -> int:
    """Entry point of `lansar-embed`."""
    return run_command("lansar-embed", run, resumable=True)


if __name__ == "__main__":
    sys.exit(main())
