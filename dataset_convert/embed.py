"""``lansar-embed``: CLIP embeddings of a dataset's pictures, computed once and stored beside it.

A pass of its own over a finished dataset; ``lansar-convert --embed=true`` runs the same one with pictures from the
source, which were never compressed and serve a dataset without pictures too.
"""

import functools
import json
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import draccus
import numpy as np
from draccus.utils import DraccusException
from tqdm import tqdm

from dataset_convert.calvin import CalvinSplit
from dataset_convert.convert import ClipOptions
from dataset_convert.hub import find_dataset
from dataset_convert.shards import sha256

if TYPE_CHECKING:
    from lerobot_lansar.policy.clip import Clip

CAMERAS = {"observation.images.static": "rgb_static", "observation.images.gripper": "rgb_gripper"}
"""LeRobot feature -> CALVIN array of the pictures that are embedded."""

PARTIAL = Path(".cache") / "huggingface" / "lansar_clip"
"""Where a pass works until it is done: the hub's client never uploads what lies in this folder of a dataset."""

_STATE = "state.json"  # how far a pass came
_SAVE_EVERY = 20  # batches


@dataclass
class EmbedConfig:
    """Stores CLIP embeddings of a LeRobotDataset's pictures in its folder ``clip``."""

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
        name: says where the pictures are from.
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
        split: where they are.
        root: the converted dataset.
    """

    name = "source"

    def __init__(self, split: CalvinSplit, root: Path):
        from dataset_convert.finish import MANIFEST

        episodes = json.loads((root / MANIFEST).read_text())["episodes"]
        frames = np.concatenate([np.arange(episode["start"], episode["end"]) for episode in episodes])
        self.split = split
        self.frames, first = np.unique(frames, return_inverse=True)
        order = np.argsort(first, kind="stable")
        self.rows = np.split(order, np.cumsum(np.bincount(first))[:-1])

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, item: int) -> dict[str, Any]:
        read = self.split.read([int(self.frames[item])], CAMERAS.values())
        return {key: read[array][0] for key, array in CAMERAS.items()}


class DatasetPictures:
    """The pictures of a LeRobotDataset, decoded by LeRobot.

    Raises:
        ValueError: it lacks one of the two cameras.
    """

    name = "dataset"

    def __init__(self, repo_id: str, root: Path):
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        self.dataset = LeRobotDataset(repo_id, root=root)
        missing = CAMERAS.keys() - set(self.dataset.meta.camera_keys)
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
        return {key: found[key] for key in CAMERAS}


@functools.cache
def load_clip(model: str, pretrained: str) -> "Clip":
    """Loads a CLIP, on the GPU if there is one.

    Args:
        model: open_clip model name.
        pretrained: open_clip's tag or a weights file; "" for an untrained model.

    Raises:
        ValueError: there is no such model, or its weights cannot be had.
    """
    import torch

    from lerobot_lansar.policy.clip import Clip, ClipConfig

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return Clip(ClipConfig(model=model, pretrained=pretrained), device)
    except (
        Exception
    ) as error:  # open_clip, the hub and torch have each their own for a name, a download, a file
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
    """Writes ``clip/<image feature>.npy``, (total_frames, D) float16 ordered by absolute index, and ``clip/clip.json``.

    ``clip.json`` says which CLIP it was, of which frames (``fingerprint``), and each array's SHA-256. The folder
    appears complete; a pass that was interrupted, or killed at any time, goes on where it was last saved.

    Args:
        root: the dataset's folder.
        pictures: what to embed.
        clip: of :func:`load_clip`.
        options: its name.
        batch_size: pictures of each camera at a time.
        num_workers: processes that read pictures.

    Raises:
        ValueError: there are embeddings of another CLIP, or of other frames.
    """
    from torch.utils.data import DataLoader, Subset

    from lerobot_lansar.policy.frames import clip_dir, dataset_fingerprint

    total = sum(len(rows) for rows in pictures.rows)
    description = {
        "model": options.model,
        "pretrained": Path(options.pretrained).name,
        "weights_sha256": clip.weights_sha256,
        "embed_dim": clip.embed_dim,
        "frames": total,
        "fingerprint": dataset_fingerprint(root),
        "pictures": pictures.name,
    }
    folder = clip_dir(root)
    partial = root / PARTIAL
    if folder.exists():
        _check_same(folder, description)
        (folder / _STATE).unlink(missing_ok=True)  # a pass was killed after its last step but one
        print(f"{folder} already holds these embeddings", file=sys.stderr)
        return
    done = _begin(partial, description, total)
    arrays = {key: np.load(partial / f"{key}.npy", mmap_mode="r+") for key in CAMERAS}
    todo: Any = Subset(pictures, range(done, len(pictures)))  # type: ignore[arg-type]
    loader = DataLoader(
        todo, batch_size, num_workers=num_workers, multiprocessing_context="fork" if num_workers else None
    )
    with tqdm(total=len(pictures), initial=done, desc="CLIP", unit="frame") as bar:
        for number, batch in enumerate(loader, start=1):
            size = len(next(iter(batch.values())))
            rows = pictures.rows[done : done + size]
            repeats = [len(of) for of in rows]
            for key, array in arrays.items():
                encoded = clip.encode_images(batch[key]).cpu().numpy().astype(np.float16)
                array[np.concatenate(rows)] = np.repeat(encoded, repeats, axis=0)
            done += size
            bar.update(size)
            if number % _SAVE_EVERY == 0:
                _save(partial, arrays, description, done)
    _save(partial, arrays, description, done)
    del arrays
    hashes = {f"{key}.npy": sha256(partial / f"{key}.npy") for key in CAMERAS}
    (partial / "clip.json").write_text(json.dumps({**description, "files": hashes}, indent=2) + "\n")
    partial.rename(folder)
    # Last: without its state an unfinished pass would be begun again.
    (folder / _STATE).unlink()


def _check_same(folder: Path, wanted: dict[str, Any]) -> None:
    file = folder / "clip.json"
    found = json.loads(file.read_text()) if file.is_file() else {}
    for name in ("weights_sha256", "fingerprint"):
        if found.get(name) != wanted[name]:
            what = "another CLIP" if name == "weights_sha256" else "other frames"
            raise ValueError(
                f"{folder} holds embeddings of {what} ({found.get('model')} {found.get('pretrained')}): delete that "
                f"folder to make those of {wanted['model']} {wanted['pretrained']}"
            )


def _begin(partial: Path, description: dict[str, Any], total: int) -> int:
    """How many pictures an earlier pass has done; new arrays if it was another one."""
    state = partial / _STATE
    if state.is_file():
        saved = json.loads(state.read_text())
        if saved["description"] == description:
            return saved["done"]
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for key in CAMERAS:
        shape = (total, description["embed_dim"])
        np.lib.format.open_memmap(partial / f"{key}.npy", "w+", np.float16, shape)
    return 0


def _save(partial: Path, arrays: dict[str, Any], description: dict[str, Any], done: int) -> None:
    for array in arrays.values():
        array.flush()
    temporary = partial / "state.tmp"
    temporary.write_text(json.dumps({"description": description, "done": done}))
    temporary.rename(partial / _STATE)


def main() -> int:
    """Runs the command; returns 0, 2 after an error the user can mend, or 130 after Ctrl-C."""
    try:
        config = draccus.parse(EmbedConfig)
        if config.batch_size < 1 or config.num_workers < 0:
            raise ValueError("--batch_size must be 1 or more, --num_workers 0 or more")
        root = find_dataset(config.repo_id, config.dataset_dir)
        if not (root / "meta" / "info.json").is_file():
            raise FileNotFoundError(f"{root} holds no LeRobotDataset: give its folder as --dataset_dir")
        clip = load_clip(config.clip.model, config.clip.pretrained)
        pictures = DatasetPictures(config.repo_id, root)
        embed(root, pictures, clip, config.clip, batch_size=config.batch_size, num_workers=config.num_workers)
        if (root / "meta" / "calvin_source.json").exists():
            from dataset_convert import card

            card.write(root, config.repo_id)
    except (OSError, ValueError, DraccusException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on where it stopped", file=sys.stderr)
        return 130
    print(f"embeddings are in {root / 'clip'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
