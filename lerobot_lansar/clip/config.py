"""Which CLIP: the two options that policy, converter and embeddings share. Imports neither torch nor open_clip."""

from dataclasses import dataclass


@dataclass
class ClipConfig:
    """Which CLIP."""

    # An open_clip model name (ViT-B-32), or one that comes with this package (lansar-desk).
    model: str = "ViT-B-32"
    # A tag of that model (openai; v1 for lansar-desk), a local weights file, or nothing for random weights from a fixed
    # seed.
    pretrained: str = "openai"
