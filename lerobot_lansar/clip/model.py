"""CLIP through open_clip: pictures and commands in, embeddings out (Eq 3.2-3.4).

Embeddings are CLIP's own outputs, not divided by their norm. Conversion and policy both use this class, so the stored
and the freshly computed embedding of a picture agree (on a GPU to the precision of TF32, which LeRobot's commands
allow).
"""

import contextlib
import functools
import hashlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import ClipConfig

CLIP_MODELS = Path(__file__).parent / "clip_models"
"""Models that come with this package: `MODEL.json`, a configuration in open_clip's format, and `MODEL-TAG.safetensors`,
trained weights in float16 (scripts/train_clip.py)."""


@functools.cache
def _open_clip() -> Any:
    """open_clip with our models added. Imported late: it is slow, and not always needed."""
    import open_clip

    from . import keypoints  # noqa: F401  (timm finds lansar-desk's image encoder by its name)

    open_clip.add_model_config(CLIP_MODELS)
    return open_clip


@contextlib.contextmanager
def _quiet_logging() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def _model_config(model: str) -> dict[str, Any]:
    config = _open_clip().get_model_config(model)
    if config is None:
        raise ValueError(
            f"clip.model={model!r} is not known to open_clip. Examples: ViT-B-32, ViT-L-14, "
            'lansar-desk; all names: python -c "import open_clip; print(open_clip.list_models())"'
        )
    return config


def embedding_size(model: str) -> int:
    """D of a model, without building it.

    Raises:
        ValueError: An unknown model name.
    """
    return int(_model_config(model)["embed_dim"])


def _packaged_weights(config: ClipConfig) -> Path | None:
    """The weights file of a tag that comes with this package."""
    file = CLIP_MODELS / f"{config.model}-{config.pretrained}.safetensors"
    return file if config.pretrained and file.is_file() else None


def weights_are_public(config: ClipConfig) -> bool:
    """True for a tag: such weights can be had by name, so checkpoints need not contain them."""
    known = _open_clip().get_pretrained_cfg(config.model, config.pretrained) or _packaged_weights(config)
    return bool(config.pretrained and known)


def _sha256(weights: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


class ImageEncoder(nn.Module):
    """The image half of a CLIP.

    Its normalisation layers keep their statistics when it is trained: a policy's batch is a few demonstrations.

    Args:
        visual: open_clip's image encoder.
        preprocess: What open_clip says of its pictures: size, mean, std.

    Attributes:
        size: Height and width of the pictures that it sees.
    """

    visual: Any
    mean: Tensor
    std: Tensor

    def __init__(self, visual: nn.Module, preprocess: dict[str, Any]) -> None:
        super().__init__()
        self.visual = visual
        size = preprocess["size"]
        self.size: tuple[int, int] = (size, size) if isinstance(size, int) else tuple(size)
        for name in ("mean", "std"):
            self.register_buffer(name, torch.tensor(preprocess[name]).view(3, 1, 1), persistent=False)

    def train(self, mode: bool = True) -> "ImageEncoder":
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()
        return self

    def resize(self, images: Tensor | np.ndarray) -> Tensor:
        """Brings pictures to the size that the encoder sees.

        Args:
            images: uint8 (B, H, W, 3), or float (B, 3, H, W) in [0, 1].

        Returns:
            (B, 3, S, S) float32 in [0, 1], on the encoder's device.

        Raises:
            ValueError: Another shape or dtype.
        """
        x = torch.as_tensor(images)
        if x.dtype == torch.uint8 and x.ndim == 4 and x.shape[-1] == 3:
            x = x.to(self.mean.device).permute(0, 3, 1, 2).float() / 255
        elif not (x.is_floating_point() and x.ndim == 4 and x.shape[1] == 3):
            raise ValueError(
                f"images must be uint8 (B, H, W, 3) or float (B, 3, H, W) in [0, 1], got {x.dtype} {tuple(x.shape)}."
            )
        x = x.to(self.mean.device, torch.float32)
        if tuple(x.shape[-2:]) == self.size:
            return x
        # CALVIN's pictures are square, so a plain resize is open_clip's resize and centre crop.
        return F.interpolate(x, self.size, mode="bicubic", align_corners=False, antialias=True).clamp(0, 1)

    def normalize(self, pictures: Tensor) -> Tensor:
        """(B, 3, S, S) in [0, 1] -> what the encoder reads."""
        return (pictures - self.mean) / self.std

    def forward(self, images: Tensor | np.ndarray) -> Tensor:
        """Pictures as `resize` takes them -> (B, D).

        Raises:
            ValueError: This encoder has other outputs beside the embedding.
        """
        found = self.visual(self.normalize(self.resize(images)))
        if not isinstance(found, Tensor):
            raise ValueError(
                "this CLIP's image encoder gives more than an embedding: it cannot be trained with a policy"
            )
        return found


class Clip:
    """The image and the text encoder of one CLIP, frozen, in float32.

    Args:
        config: Model and weights.
        device: Where the encoders run.
        weights: A state dict to use instead of `config.pretrained` (from a checkpoint).
        load: False: the weights stay random, since others will replace them.

    Attributes:
        embed_dim: D.
        images: The image encoder, which shares its weights with `model`.

    Raises:
        ValueError: An unknown model name, or a `pretrained` that is neither a tag nor an existing file.
    """

    def __init__(
        self,
        config: ClipConfig,
        device: str | torch.device = "cpu",
        weights: dict[str, Tensor] | None = None,
        load: bool = True,
    ) -> None:
        open_clip = _open_clip()
        self.config = config
        self.embed_dim = embedding_size(config.model)
        tag = open_clip.get_pretrained_cfg(config.model, config.pretrained) if config.pretrained else {}
        pretrained = str(_packaged_weights(config) or config.pretrained)
        load = load and bool(pretrained) and weights is None
        if load and not tag and not Path(pretrained).is_file():
            files = CLIP_MODELS.glob(f"{config.model}-*.safetensors")
            ours = sorted(file.stem.removeprefix(f"{config.model}-") for file in files)
            tags = ", ".join([*open_clip.list_pretrained_tags_by_model(config.model), *ours]) or "it has none"
            raise ValueError(
                f"clip.pretrained={config.pretrained!r} is neither a weights file nor a tag of {config.model} ({tags})."
            )
        # open_clip warns about random weights; here that is intended, or a checkpoint follows.
        with torch.random.fork_rng(devices=[]), _quiet_logging():
            # The same random weights every time, without touching the caller's generators, those of GPUs included.
            torch.default_generator.manual_seed(0)
            model = open_clip.create_model(
                config.model,
                pretrained=pretrained if load else None,
                # Some tags (ViT-B-32/openai) were trained with another activation than their model's file says;
                # open_clip only warns, and the embeddings would be wrong.
                force_quick_gelu=bool(tag.get("quick_gelu", False)),
                force_preprocess_cfg={key: tag[key] for key in ("mean", "std") if key in tag},
            )
        if weights is not None:
            model.load_state_dict(weights)
        # Small convolutions are half as fast again on a CPU with the channels last.
        self.model: Any = model.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)
        self.device = torch.device(device)
        self.tokenizer = open_clip.get_tokenizer(config.model)
        self.images = ImageEncoder(model.visual, open_clip.get_model_preprocess_cfg(model)).to(device)

    @functools.cached_property
    def weights_sha256(self) -> str:
        """SHA-256 over names and values of all weights: identifies the CLIP that made an embedding."""
        return _sha256(self.model.state_dict())

    @functools.cached_property
    def text_sha256(self) -> str:
        """The same of the text encoder alone: identifies the CLIP that made a sentence's embedding."""
        weights = self.model.state_dict()
        return _sha256({n: v for n, v in weights.items() if not n.startswith(("visual.", "logit_"))})

    def to(self, device: str | torch.device) -> None:
        """Moves everything to another device."""
        self.device = torch.device(device)
        self.model.to(device)
        self.images.to(device)

    @torch.no_grad()
    def encode_images(self, images: Tensor | np.ndarray) -> Tensor:
        """Embeds pictures, (B, D) float32 on this CLIP's device; see `ImageEncoder.resize` for what it takes."""
        with self._full_precision():
            return self.model.encode_image(self.images.normalize(self.images.resize(images)))

    @torch.no_grad()
    def encode_texts(self, texts: list[str]) -> Tensor:
        """Embeds commands: (B, D) float32 on this CLIP's device."""
        with self._full_precision():
            return self.model.encode_text(self.tokenizer(texts).to(self.device))

    def _full_precision(self) -> torch.autocast:
        """Makes embeddings the same inside and outside a mixed-precision run."""
        return torch.autocast(self.device.type, enabled=False)
