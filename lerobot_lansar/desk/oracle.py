"""CALVIN's 34 tasks: which of them were fulfilled between two moments.

A task is a relation between the state when a command began and the state now. Both are :class:`Snapshot`: plain data,
so the oracle needs no simulator. Contacts name what is touched: ``("robot", "")``, ``("desk", <link>)``,
``("plane", "")`` or ``(<block colour>, "")``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .scenes import COLORS

Touch = tuple[str, str]

TABLE, PLANK, DRAWER = ("desk", "base_link"), ("desk", "plank_link"), ("desk", "drawer_link")
AT_REST = 1.0
"""Every component of a block's linear (m/s) and angular (rad/s) velocity stays under this while it is stacked."""


@dataclass(frozen=True)
class BlockState:
    """Position (3,) m, orientation xyzw (4,), velocities (3,) m/s and rad/s, and what the block touches."""

    position: np.ndarray
    orientation: np.ndarray
    linear_velocity: np.ndarray
    angular_velocity: np.ndarray
    contacts: frozenset[Touch]

    @property
    def bodies(self) -> frozenset[str]:
        """Names of the bodies touched."""
        return frozenset(body for body, _ in self.contacts)

    @property
    def surfaces(self) -> frozenset[Touch]:
        """Contacts other than the robot's."""
        return frozenset(touch for touch in self.contacts if touch[0] != "robot")

    @property
    def resting(self) -> bool:
        """No velocity component reaches :data:`AT_REST`."""
        return bool(np.all(np.abs([self.linear_velocity, self.angular_velocity]) < AT_REST))


@dataclass(frozen=True)
class Snapshot:
    """What the oracle needs of one moment.

    Attributes:
        slide, drawer: Joint positions (m).
        bulb, led: Whether each light is on.
        blocks: Colour to state.
        touched_by_robot: Names of the bodies that any robot link touches.
    """

    slide: float
    drawer: float
    bulb: bool
    led: bool
    blocks: dict[str, BlockState]
    touched_by_robot: frozenset[str]


Task = Callable[[Snapshot, Snapshot], bool]


def _rotate(color: str, degrees: float) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        if not e.surfaces or np.linalg.norm(e.position - s.position) > 0.1:
            return False
        turn = Rotation.from_quat(e.orientation) * Rotation.from_quat(s.orientation).inv()
        x, y, z = turn.as_euler("xyz", degrees=True)
        signed = z * np.sign(degrees)
        return bool(abs(x) < 30 and abs(y) < 30 and abs(degrees) < signed < 180)

    return fulfilled


def _push(color: str, distance: float) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        moved = (e.position[0] - s.position[0]) * np.sign(distance)
        stays = bool(s.surfaces) and bool(e.surfaces) and s.surfaces <= e.surfaces
        return bool(stays and moved > abs(distance))

    return fulfilled


def _lift(color: str, height: float, surface: Touch) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        risen = e.position[2] - s.position[2]
        return bool(risen > height and e.bodies == {"robot"} and surface in s.contacts)

    return fulfilled


def _place(surface: Touch) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        if len(start.touched_by_robot) != 1:
            return False
        (held,) = start.touched_by_robot
        if held not in start.blocks or start.blocks[held].bodies != {"robot"}:
            return False
        e = end.blocks[held]
        return surface in e.contacts and "robot" not in e.bodies and held not in end.touched_by_robot

    return fulfilled


def _push_into_drawer(start: Snapshot, end: Snapshot) -> bool:
    # The hand may still touch the block at the end: the original's recorded verdicts say so.
    return any(
        start.blocks[color].contacts == {TABLE} and DRAWER in end.blocks[color].contacts
        for color in start.blocks
    )


def _on_blocks_only(block: BlockState) -> bool:
    return bool(block.bodies) and block.bodies <= set(COLORS) and block.resting


def _stack(start: Snapshot, end: Snapshot) -> bool:
    return any(
        not (start.blocks[color].bodies & set(COLORS)) and _on_blocks_only(end.blocks[color])
        for color in start.blocks
    )


def _unstack(start: Snapshot, end: Snapshot) -> bool:
    return any(
        _on_blocks_only(start.blocks[color]) and not (end.blocks[color].bodies & set(COLORS))
        for color in start.blocks
    )


def _joint(name: str, change: float) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        return bool((getattr(end, name) - getattr(start, name)) * np.sign(change) > abs(change))

    return fulfilled


def _light(name: str, on: bool) -> Task:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        return getattr(start, name) != on and getattr(end, name) == on

    return fulfilled


def _tasks() -> dict[str, Task]:
    tasks: dict[str, Task] = {}
    for color in COLORS:
        tasks[f"rotate_{color}_block_right"] = _rotate(color, -60)
        tasks[f"rotate_{color}_block_left"] = _rotate(color, 60)
    for color in COLORS:
        tasks[f"push_{color}_block_right"] = _push(color, 0.1)
        tasks[f"push_{color}_block_left"] = _push(color, -0.1)
    tasks["move_slider_left"] = _joint("slide", 0.15)
    tasks["move_slider_right"] = _joint("slide", -0.15)
    tasks["open_drawer"] = _joint("drawer", 0.12)
    tasks["close_drawer"] = _joint("drawer", -0.12)
    for color in COLORS:
        for surface, touch, height in (
            ("table", TABLE, 0.05),
            ("slider", PLANK, 0.03),
            ("drawer", DRAWER, 0.05),
        ):
            tasks[f"lift_{color}_block_{surface}"] = _lift(color, height, touch)
    tasks["place_in_slider"] = _place(PLANK)
    tasks["place_in_drawer"] = _place(DRAWER)
    tasks["stack_block"] = _stack
    tasks["unstack_block"] = _unstack
    tasks["turn_on_lightbulb"] = _light("bulb", True)
    tasks["turn_off_lightbulb"] = _light("bulb", False)
    tasks["turn_on_led"] = _light("led", True)
    tasks["turn_off_led"] = _light("led", False)
    tasks["push_into_drawer"] = _push_into_drawer
    return tasks


TASKS: dict[str, Task] = _tasks()
"""The 34 tasks by CALVIN's names, each a function of the start and the end snapshot."""


def completed_tasks(start: Snapshot, end: Snapshot) -> set[str]:
    """Names of the tasks that are fulfilled between ``start`` and ``end``."""
    return {name for name, fulfilled in TASKS.items() if fulfilled(start, end)}
