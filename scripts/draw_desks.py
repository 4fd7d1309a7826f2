"""Draws docs/images/desks.png: the four built-in desks seen by both cameras."""

from pathlib import Path

import numpy as np
from PIL import Image

from lerobot_lansar.desk import SCENES, Desk

FILE = Path(__file__).resolve().parents[1] / "docs" / "images" / "desks.png"


def column(scene: str) -> np.ndarray:
    """Static above gripper picture of one scene, drawer and door half open, lights on."""
    with Desk(scene, cameras=()) as desk:
        state = desk.reset(seed=3)["scene_obs"]
        state[:6] = [0.1, 0.15, 0.0, 0.088, 1.0, 1.0]
        desk.reset(scene_obs=state)
        static, gripper = desk.render("static", 300), desk.render("gripper", 300)
    return np.vstack([static, gripper])


if __name__ == "__main__":
    FILE.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([column(scene) for scene in SCENES])).save(FILE)
