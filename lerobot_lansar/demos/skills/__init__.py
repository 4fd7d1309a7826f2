"""How a hand does each of the 34 tasks: generators of waypoints that look at the desk's present state before each one.

A skill goes on until the demonstrator stops it because the oracle is satisfied, or until it has tried often enough.
Distances come from the desk's measured geometry: handle and lever sizes, button height, block sizes.
"""

from ...calvin import COLORS
from ..moves import Skill
from . import blocks, furniture

SKILLS: dict[str, Skill] = {
    **{f"rotate_{color}_block_right": blocks.rotate(color, -1.0) for color in COLORS},
    **{f"rotate_{color}_block_left": blocks.rotate(color, 1.0) for color in COLORS},
    **{f"push_{color}_block_right": blocks.push(color, 1.0) for color in COLORS},
    **{f"push_{color}_block_left": blocks.push(color, -1.0) for color in COLORS},
    "move_slider_left": furniture.slide(-1.0),
    "move_slider_right": furniture.slide(1.0),
    "open_drawer": furniture.open_drawer,
    "close_drawer": furniture.close_drawer,
    **{
        f"lift_{color}_block_{place}": blocks.lift(color) for color in COLORS for place in ("table", "slider", "drawer")
    },
    "place_in_slider": blocks.place_in_slider,
    "place_in_drawer": blocks.place_in_drawer,
    "stack_block": blocks.stack_block,
    "unstack_block": blocks.unstack_block,
    "turn_on_lightbulb": furniture.turn_on_lightbulb,
    "turn_off_lightbulb": furniture.turn_off_lightbulb,
    "turn_on_led": furniture.press_button,
    "turn_off_led": furniture.press_button,
    "push_into_drawer": blocks.push_into_drawer,
}
"""How each of the 34 tasks is done."""
