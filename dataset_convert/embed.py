"""CLIP embeddings of a dataset's pictures, computed once and stored beside it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from dataset_convert.calvin import CalvinSplit
from dataset_convert.writer import IMAGE_KEYS

if TYPE_CHECKING:
    from lerobot_lansar.policy.clip import Clip

_BATCH = 32


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


def embed_frames(
    root: Path, split: CalvinSplit, frames: np.ndarray, clip: "Clip", name: dict[str, str]
) -> None:
    """Writes ``clip/<image feature>.npy``, (total_frames, D) float16 ordered by absolute index, and
    ``clip/clip.json``.

    The pictures come from the source, so it works for datasets without videos and sees no compression.
    Windows overlap in the public data; every frame is encoded once all the same.

    Args:
        root: the dataset's folder, complete but for the embeddings.
        split: where the pictures are.
        frames: (total_frames,) int64 source frame of every row of the dataset.
        clip: of :func:`load_clip`.
        name: its {"model", "pretrained"}.
    """
    import torch

    from lerobot_lansar.policy.frames import clip_dir, dataset_fingerprint

    distinct, row = np.unique(frames, return_inverse=True)
    embeddings = {key: np.empty((len(distinct), clip.embed_dim), np.float16) for key in IMAGE_KEYS.values()}
    for start in tqdm(range(0, len(distinct), _BATCH), desc="CLIP", unit="batch"):
        batch = slice(start, start + _BATCH)
        pictures = split.read(distinct[batch], IMAGE_KEYS)
        for camera, key in IMAGE_KEYS.items():
            encoded = clip.encode_images(torch.from_numpy(pictures[camera]))
            embeddings[key][batch] = encoded.cpu().numpy().astype(np.float16)

    folder = clip_dir(root)
    folder.mkdir()
    for key, values in embeddings.items():
        np.save(folder / f"{key}.npy", values[row])
    description = {
        **name,
        "weights_sha256": clip.weights_sha256,
        "embed_dim": clip.embed_dim,
        "frames": len(frames),
        "fingerprint": dataset_fingerprint(root),
    }
    (folder / "clip.json").write_text(json.dumps(description, indent=2) + "\n")
