"""Draws docs/images/tasks.jpg: six moments of a demonstration of each of the 34 tasks, in the four scenes in turn.

python scripts/draw_tasks.py [--assets=DIR] [--output=FILE]
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from lerobot_lansar.calvin import TASKS
from lerobot_lansar.demos.demonstrator import Demonstration, demonstrate
from lerobot_lansar.desk import Desk

SIZE, MOMENTS, COLUMNS, LABEL = 112, 6, 2, 18
IN_TURN = "BADC"
"""Scenes; this order has the switch tasks in A and D, where the arm stays in the picture."""


def demonstration(desk: Desk, task: str, seed: int) -> Demonstration:
    """The first demonstration of `task` that succeeds."""
    for attempt in range(20):
        found = demonstrate(desk, task, np.random.default_rng([seed, attempt]))
        if found is not None:
            return found
    raise RuntimeError(f"{task} failed 20 times")


def strip(found: Demonstration, title: str) -> Image.Image:
    """A title above pictures of the static camera, from the first frame to the last."""
    picture = Image.new("RGB", (SIZE * MOMENTS, SIZE + LABEL), "white")
    ImageDraw.Draw(picture).text((3, 2), title, "black", ImageFont.load_default(12))
    for column, t in enumerate(np.linspace(0, len(found) - 1, MOMENTS).round().astype(int)):
        frame = Image.fromarray(found.frames["rgb_static"][t]).resize((SIZE, SIZE), Image.Resampling.LANCZOS)
        picture.paste(frame, (column * SIZE, LABEL))
    return picture


def main() -> None:
    """Draws all tasks onto one sheet."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--assets")
    parser.add_argument("--output", type=Path, default=Path("docs/images/tasks.jpg"))
    options = parser.parse_args()
    desks = [Desk(scene, options.assets, cameras=["static"]) for scene in IN_TURN]
    strips = []
    for number, task in enumerate(tqdm(TASKS, desc="drawing", unit="task")):
        desk = desks[number % len(desks)]
        found = demonstration(desk, task, number)
        strips.append(strip(found, f"{task}, scene {desk.scene.name}, {len(found)} frames"))
    rows = -(-len(strips) // COLUMNS)
    width, height = strips[0].size
    sheet = Image.new("RGB", (COLUMNS * (width + 8) - 8, rows * (height + 4)), "white")
    for number, picture in enumerate(strips):
        column, row = divmod(number, rows)
        sheet.paste(picture, (column * (width + 8), row * (height + 4)))
    sheet.save(options.output, quality=82, optimize=True)
    print(f"{options.output}: {options.output.stat().st_size / 1e3:.0f} KB")


if __name__ == "__main__":
    main()
