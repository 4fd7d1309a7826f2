"""Draws the pictures of the desk in README.md and docs/desk.md.

python scripts/draw_desks.py                 docs/images/desks.png: the built-in desks by both cameras
python scripts/draw_desks.py --assets=DIR    docs/images/looks.jpg as well: all renderers
    --frame=FILE.npz                         docs/images/public_frame.png: a frame of CALVIN's public data of scene D,
                                             as recorded, as renderer gl draws it, and the difference
"""

from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lerobot_lansar.calvin import FURNITURE
from lerobot_lansar.desk import SCENES, Desk
from lerobot_lansar.desk.scenes import SWITCH_TRAVEL

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"


@dataclass
class Options:
    """What to draw."""

    # The `data` folder of a calvin_env checkout; without it, only the built-in desks are drawn.
    assets: Path | None = None
    # A frame of CALVIN's public data, scene D; with --assets.
    frame: Path | None = None


def posed(scene: str, assets: Path | None = None, renderer: str = "gl") -> Desk:
    """A desk with drawer and door partly open, and the lights on."""
    desk = Desk(scene, assets, cameras=(), renderer=renderer)
    state = desk.reset(seed=3)["scene_obs"]
    state[FURNITURE] = [0.1, 0.15, 0.0, SWITCH_TRAVEL, 1.0, 1.0]
    desk.reset(scene_obs=state)
    return desk


def column(scene: str) -> np.ndarray:
    """The static camera's picture of a built-in scene above the gripper camera's."""
    with posed(scene) as desk:
        return np.vstack([desk.render("static", 300), desk.render("gripper", 300)])


def looks(assets: Path) -> Image.Image:
    """One row per scene, one column per renderer, on both kinds of assets."""
    kinds = [
        ("built in, gl", None, "gl"),
        ("built in, tiny", None, "tiny"),
        ("CALVIN's files, tiny", assets, "tiny"),
        ("CALVIN's files, pybullet_tiny", assets, "pybullet_tiny"),
        ("CALVIN's files, gl", assets, "gl"),
        ("CALVIN's files, pybullet_gl", assets, "pybullet_gl"),
    ]
    sheet = Image.new("RGB", (200 * len(kinds), 22 + 200 * len(SCENES)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (title, folder, renderer) in enumerate(kinds):
        draw.text((200 * i + 6, 4), title, "black", ImageFont.load_default(13))
        for k, scene in enumerate(SCENES):
            with posed(scene, folder, renderer) as desk:
                sheet.paste(Image.fromarray(desk.render("static")), (200 * i, 22 + 200 * k))
    return sheet


def public_frame(assets: Path, file: Path) -> Image.Image:
    """Both cameras of a recorded frame, side by side: recorded, drawn here, ten times the difference around gray."""
    frame = np.load(file)
    with Desk("D", assets) as desk:
        obs = desk.reset(frame["robot_obs"], frame["scene_obs"])
    rows = []
    for key in ("rgb_static", "rgb_gripper"):
        recorded, drawn = frame[key].astype(int), obs[key].astype(int)
        shown = np.hstack([recorded, drawn, np.clip(128 + 10 * (drawn - recorded), 0, 255)]).astype(np.uint8)
        rows.append(np.asarray(Image.fromarray(shown).resize((900, 300), Image.Resampling.NEAREST)))
    return Image.fromarray(np.vstack(rows))


if __name__ == "__main__":
    options = draccus.parse(Options)
    IMAGES.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([column(scene) for scene in SCENES])).save(IMAGES / "desks.png")
    if options.assets:
        looks(options.assets).save(IMAGES / "looks.jpg", quality=88)
        if options.frame:
            public_frame(options.assets, options.frame).save(IMAGES / "public_frame.png")
