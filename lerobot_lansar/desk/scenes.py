"""The four CALVIN scenes as data: where the desk's parts are, how large the blocks are and where they start.

Everything is in metres in the world frame, after CALVIN's global scaling of 0.8. The four desks are the same piece
of furniture with its parts in different places, so a scene is a handful of numbers.
"""

from dataclasses import dataclass, replace

from ..calvin import BLOCK_ORDER, SLIDE_TRAVEL
from .errors import DeskError

BLOCK_LENGTHS = {"small": 0.04, "middle": 0.056, "big": 0.08}
"""A block's extent along its own x axis (m); its other two sides are `BLOCK_SIDE`."""
BLOCK_SIDE = 0.04

TABLE_Z = 0.46
"""Height of a block's centre on the table (m); on the cabinet's floor it is 1 mm more."""
CABINET_FLOOR = 0.441
"""Height of the cabinet's floor (m): 1 mm above the table, as in CALVIN. The benchmark's blocks start lying on it."""
DRAWER_Z = 0.362
"""Height of a block's centre in the drawer (m)."""
REACH = 0.41
"""Blocks can be pushed up to this |x| and still lie on the table, which ends at 0.44 (m)."""

BUTTON_Y = -0.12
"""World y of the button in every scene (m)."""
DOOR_WIDTH = 0.28
"""Width of the cabinet's sliding door (m); its left edge is at the scene's `slide_x` minus the joint."""

DRAWER_TRAVEL = 0.22
SWITCH_TRAVEL = 0.088
BUTTON_TRAVEL = 0.02
"""Upper limits of three joints in every scene (m)."""


@dataclass(frozen=True)
class Area:
    """A horizontal rectangle in which block centres start, at a height of `TABLE_Z` (m)."""

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Scene:
    """One of CALVIN's desks.

    Attributes:
        name: The letter by which users call it.
        blocks: Colour to block size (small, middle, big), in CALVIN's order for this scene (`calvin.BLOCK_ORDER`).
        areas: Where blocks start, by CALVIN's names.
        button_x, switch_x, light_x, led_x, slide_x, drawer_x: World x of each part at joint value 0.
        cabinet: World x range of the cabinet's inside; its floor is the link `plank_link`.
        slide_travel: Upper limit of the sliding door (m).
        wood, dark_wood, metal: Colours (rgb in [0, 1]) of the built-in desk.
        layout: Colour to the pose that the block starts in, xyz (m) and euler (rad); None: at random in `areas`.
    """

    name: str
    blocks: dict[str, str]
    areas: dict[str, Area]
    button_x: float
    switch_x: float
    light_x: float
    led_x: float
    slide_x: float
    drawer_x: float
    cabinet: tuple[float, float]
    slide_travel: float
    wood: tuple[float, float, float]
    dark_wood: tuple[float, float, float]
    metal: tuple[float, float, float]
    layout: dict[str, tuple[float, ...]] | None = None


_BEHIND = (0.05, 0.12)
_FRONT = (-0.15, -0.03)


def _blocks(name: str, **sizes: str) -> dict[str, str]:
    return {color: sizes[color] for color in BLOCK_ORDER[name]}


def _areas(table: tuple[float, float], left: tuple[float, float], right: tuple[float, float]) -> dict[str, Area]:
    return {
        "table": Area(table, _FRONT),
        "slider_left": Area(left, _BEHIND),
        "slider_right": Area(right, _BEHIND),
    }


SCENES = {
    "A": Scene(
        name="A",
        blocks=_blocks("A", red="middle", blue="big", pink="small"),
        areas=_areas((-0.20, 0.35), (-0.32, -0.16), (-0.05, 0.13)),
        button_x=-0.28,
        switch_x=0.30,
        light_x=0.30,
        led_x=-0.28,
        slide_x=-0.10,
        drawer_x=0.10,
        cabinet=(-0.36, 0.16),
        slide_travel=SLIDE_TRAVEL["A"],
        wood=(0.46, 0.27, 0.19),
        dark_wood=(0.36, 0.20, 0.14),
        metal=(0.36, 0.37, 0.40),
    ),
    "B": Scene(
        name="B",
        blocks=_blocks("B", red="small", blue="big", pink="middle"),
        areas=_areas((-0.35, 0.15), (-0.12, 0.06), (0.15, 0.33)),
        button_x=0.28,
        switch_x=-0.32,
        light_x=-0.32,
        led_x=0.28,
        slide_x=0.088,
        drawer_x=0.18,
        cabinet=(-0.18, 0.34),
        slide_travel=SLIDE_TRAVEL["B"],
        wood=(0.87, 0.78, 0.62),
        dark_wood=(0.78, 0.67, 0.50),
        metal=(0.45, 0.46, 0.48),
    ),
    "C": Scene(
        name="C",
        blocks=_blocks("C", red="big", blue="small", pink="middle"),
        areas=_areas((0.00, 0.35), (-0.12, 0.06), (0.15, 0.30)),
        button_x=-0.12,
        switch_x=-0.32,
        light_x=-0.32,
        led_x=-0.12,
        slide_x=0.06,
        drawer_x=0.10,
        cabinet=(-0.18, 0.34),
        slide_travel=SLIDE_TRAVEL["C"],
        wood=(0.66, 0.50, 0.27),
        dark_wood=(0.49, 0.37, 0.21),
        metal=(0.25, 0.26, 0.28),
    ),
    "D": Scene(
        name="D",
        blocks=_blocks("D", red="middle", blue="small", pink="big"),
        areas=_areas((0.00, 0.35), (-0.32, -0.16), (-0.05, 0.13)),
        button_x=-0.12,
        switch_x=0.30,
        light_x=0.30,
        led_x=-0.12,
        slide_x=-0.10,
        drawer_x=0.18,
        cabinet=(-0.36, 0.16),
        slide_travel=SLIDE_TRAVEL["D"],
        wood=(0.62, 0.44, 0.27),
        dark_wood=(0.50, 0.33, 0.19),
        metal=(0.33, 0.34, 0.36),
    ),
}


EVALUATION_LAYOUT: dict[str, tuple[float, ...]] = {
    "red": (0.05, -0.12, TABLE_Z, 0.0, 0.0, 1.57),
    "blue": (0.05, -0.12, 0.51, 0.0, 0.0, 0.0),
    "pink": (0.10, 0.08, TABLE_Z, 0.0, 0.0, 1.57),
}
"""Where calvin_env's evaluation configuration of scene D puts the blocks (m, rad); blue falls on red."""


def can_be_pushed(side: str | None, x: float) -> bool:
    """Whether a block at `x` still lies on the table after a push of 0.11 m to a side, "right" (+x) or "left"."""
    return bool(abs(x + (0.11 if side == "right" else -0.11)) <= REACH)


def beside_door(scene: Scene, slide: float, x: float) -> bool:
    """Whether a finger, 0.045 m from the block's middle, fits between the door's edge and a block at `x` behind it."""
    door = scene.slide_x - slide
    return bool(x < door - 0.045 or x > door + DOOR_WIDTH + 0.045)


def get_scene(name: str) -> Scene:
    """The scene called `name`: A, B, C, D, or `D_eval`, which is D with the blocks in `EVALUATION_LAYOUT`.

    Raises:
        DeskError: There is no such scene.
    """
    if name == "D_eval":
        return replace(SCENES["D"], layout=EVALUATION_LAYOUT)
    if name not in SCENES:
        raise DeskError(f"scene {name!r} is unknown; choose one of {', '.join(SCENES)}, D_eval")
    return SCENES[name]
