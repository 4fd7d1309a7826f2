"""The pictures of a replay's video: what was recorded beside what the desk did."""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..calvin import CAMERAS, TASKS
from .outcome import MEASURES, Outcome
from .recordings import Recording

_SCALE = 2
_WIDTH, _LOWER = (_SCALE * CAMERAS[camera] for camera in ("static", "gripper"))
_TOP = 68
_BACKGROUND, _TEXT, _FAINT, _GOOD = (24, 26, 30), (220, 220, 220), (150, 150, 150), (110, 230, 120)


def pictures(recording: Recording, outcomes: dict[str, Outcome]) -> Iterator[np.ndarray]:
    """One picture per frame: a column for the recorded pictures, if there are any, and one for each replay.

    After actions comes one more, of the state after the last one; what is not known of it stays as in the last frame.

    Args:
        recording: What was replayed.
        outcomes: Column's heading to how a replay went, with pictures of both cameras.

    Yields:
        (height, width, 3) uint8, both numbers even.
    """
    columns = len(outcomes) + bool(recording.pictures)
    for frame in range(length(recording, outcomes)):
        canvas = Image.new("RGB", (_WIDTH * columns, _TOP + _WIDTH + _LOWER), _BACKGROUND)
        draw = ImageDraw.Draw(canvas)
        what = f"{recording.task or 'no task'}: {recording.sentence}"
        draw.text((10, 8), what, _TEXT, _font(18))
        place = f"{recording.name}, scene {recording.scene}, frame {frame} of {len(recording)}"
        draw.text((_WIDTH * columns - 10, 11), place, _FAINT, _font(15), anchor="ra")
        left = 0
        if recording.pictures:
            _draw_column(
                canvas,
                left,
                "recorded",
                {camera: shown[min(frame, len(shown) - 1)] for camera, shown in recording.pictures.items()},
            )
            left += _WIDTH
        for heading, outcome in outcomes.items():
            seen = outcome.observations[min(frame, len(outcome.observations) - 1)]
            _draw_column(canvas, left, heading, {camera: seen[f"rgb_{camera}"] for camera in CAMERAS})
            _draw_state(draw, left + _LOWER + 14, recording.task, outcome, frame)
            left += _WIDTH
        yield np.asarray(canvas)


def length(recording: Recording, outcomes: dict[str, Outcome]) -> int:
    """How many pictures `pictures` makes."""
    return max(len(recording), *(len(outcome.observations) for outcome in outcomes.values()))


@cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def _draw_column(canvas: Image.Image, left: int, heading: str, shown: dict[str, np.ndarray]) -> None:
    """Draws a heading, the static camera's picture and below it the gripper camera's."""
    ImageDraw.Draw(canvas).text((left + 10, 40), heading, _TEXT, _font(16))
    for camera, top in (("static", _TOP), ("gripper", _TOP + _WIDTH)):
        if camera in shown:
            size = _SCALE * CAMERAS[camera]
            canvas.paste(Image.fromarray(shown[camera]).resize((size, size), Image.Resampling.NEAREST), (left, top))


def _draw_state(draw: ImageDraw.ImageDraw, left: int, task: str, outcome: Outcome, frame: int) -> None:
    """Draws the deviations of a frame and the verdict so far, beside the gripper camera's picture."""
    top = _TOP + _WIDTH + 12
    if frame < len(outcome.deviations) or not outcome.diverged:
        compared = outcome.deviations[min(frame, len(outcome.deviations) - 1)]
        for line, (measure, value) in enumerate(zip(MEASURES, compared, strict=True)):
            what, _, unit = measure.rpartition(" ")
            draw.text((left, top + 22 * line), f"{what}  {value:.1f} {unit}", _FAINT, _font(15))
    else:
        draw.text((left, top), "the simulation diverged", _TEXT, _font(15))
    if task not in TASKS:
        return
    done = outcome.fulfilled.get(task, frame + 1) <= frame
    verdict = "fulfilled" if done else "not fulfilled yet" if task in outcome.fulfilled else "not fulfilled"
    draw.text((left, top + 22 * len(MEASURES) + 8), verdict, _GOOD if done else _FAINT, _font(17))
