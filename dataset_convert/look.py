"""What drew a split's pictures: `.hydra/merged_config.yaml` of recordings made here, or of public data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lerobot_lansar.pictures import MAX_SIZE


@dataclass(frozen=True)
class Look:
    """What decides how the desk looks in a split's pictures.

    Attributes:
        renderer: `lansar-record`'s name of it; None if it is not known.
        assets: `"original"` or `"built-in"`; None if it is not known.
        image_size: Width and height of both cameras' pictures; 0: the cameras' own, as in `CAMERAS`.
    """

    renderer: str | None = None
    assets: str | None = None
    image_size: int = 0


PUBLIC = Look("gl", "original")
"""What calvin_env's GPU renderer gave CALVIN's public data, in the names of `lansar-record`."""


def read_look(folder: Path) -> Look:
    """What drew the pictures of the split in `folder`.

    Recordings made here say it themselves. A configuration of calvin_env's own stands for the public data.
    """
    try:
        stored = yaml.safe_load((folder / ".hydra" / "merged_config.yaml").read_text())
    except (FileNotFoundError, UnicodeDecodeError, yaml.YAMLError):
        return Look()
    if not isinstance(stored, dict):
        return Look()
    if "assets_used" in stored:
        size = stored.get("image_size", 0)
        is_size = isinstance(size, int) and 0 <= size <= MAX_SIZE
        return Look(_text(stored.get("renderer")), _text(stored["assets_used"]), size if is_size else 0)
    is_calvin_env = any("_target_" in part for part in map(stored.get, ("env", "robot")) if isinstance(part, dict))
    return PUBLIC if is_calvin_env else Look()


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
