"""Draws the pictures of docs/desk.md.

python scripts/draw_desks.py                 docs/images/desks.png: the built-in desks by both cameras
python scripts/draw_desks.py --assets=DIR    docs/images/looks.jpg too: every look, and PyBullet's own
"""

from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lerobot_lansar.desk import SCENES, Desk

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"


@dataclass
class Options:
    """Where CALVIN's files are."""

    # The `data` folder of a calvin_env checkout.
    assets: Path | None = None


def posed(scene: str, assets: Path | None = None, renderer: str = "fast") -> Desk:
    """A desk with drawer and door half open, and the lights on."""
    desk = Desk(scene, assets, cameras=(), renderer=renderer)
    state = desk.reset(seed=3)["scene_obs"]
    state[:6] = [0.1, 0.15, 0.0, 0.088, 1.0, 1.0]
    desk.reset(scene_obs=state)
    return desk


def column(scene: str) -> np.ndarray:
    """Static above gripper picture of one built-in scene."""
    with posed(scene) as desk:
        return np.vstack([desk.render("static", 300), desk.render("gripper", 300)])


def looks(assets: Path) -> Image.Image:
    """One row per scene: ours and PyBullet's, in TinyRenderer's and in the OpenGL look, on both kinds of assets."""
    kinds = [
        ("built in, fast", None, "fast"),
        ("built in, fast_gl", None, "fast_gl"),
        ("CALVIN's files, fast", assets, "fast"),
        ("CALVIN's files, tiny (original)", assets, "tiny"),
        ("CALVIN's files, fast_gl", assets, "fast_gl"),
        ("CALVIN's files, egl (original)", assets, "egl"),
    ]
    sheet = Image.new("RGB", (200 * len(kinds), 22 + 200 * len(SCENES)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (title, folder, renderer) in enumerate(kinds):
        draw.text((200 * i + 6, 4), title, "black", ImageFont.load_default(13))
        for k, scene in enumerate(SCENES):
            with posed(scene, folder, renderer) as desk:
                sheet.paste(Image.fromarray(desk.render("static")), (200 * i, 22 + 200 * k))
    return sheet


if __name__ == "__main__":
    options = draccus.parse(Options)
    IMAGES.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([column(scene) for scene in SCENES])).save(IMAGES / "desks.png")
    if options.assets:
        looks(options.assets).save(IMAGES / "looks.jpg", quality=88)
