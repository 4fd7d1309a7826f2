"""CALVIN's success oracle: which of the 34 tasks were fulfilled between two moments.

A task compares the state in which a command began with the state now. Both are a `Snapshot`: plain data, so the
oracle needs no simulator. A contact is named by the body and link touched: `("robot", "")`, `("desk", <link>)`,
`("plane", "")` or `(<block colour>, "")`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..calvin import COLORS, TASKS, Task

Touch = tuple[str, str]
"""Body and link that a block or the robot touches."""

TABLE, PLANK, DRAWER = ("desk", "base_link"), ("desk", "plank_link"), ("desk", "drawer_link")
AT_REST = 1.0
"""A block rests if all components of its linear (m/s) and angular (rad/s) velocity are below this."""


@dataclass(frozen=True)
class BlockState:
    """One block: position (3,) m, quaternion xyzw (4,), velocities (3,) m/s and (3,) rad/s, contacts."""

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
        """Whether every component of its velocities is below `AT_REST`."""
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

    @property
    def held(self) -> str | None:
        """Colour of the block that nothing but the robot touches; None if there is none."""
        return next((color for color, block in self.blocks.items() if block.bodies == {"robot"}), None)


Condition = Callable[[Snapshot, Snapshot], bool]
"""Whether a task is fulfilled, given the snapshots at its start and now."""


def _rotate(color: str, degrees: float) -> Condition:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        if not e.surfaces or np.linalg.norm(e.position - s.position) > 0.1:
            return False
        turn = Rotation.from_quat(e.orientation) * Rotation.from_quat(s.orientation).inv()
        x, y, z = turn.as_euler("xyz", degrees=True)
        signed = z * np.sign(degrees)
        return bool(abs(x) < 30 and abs(y) < 30 and abs(degrees) < signed < 180)

    return fulfilled


def _push(color: str, distance: float) -> Condition:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        moved = (e.position[0] - s.position[0]) * np.sign(distance)
        stays = bool(s.surfaces) and bool(e.surfaces) and s.surfaces <= e.surfaces
        return bool(stays and moved > abs(distance))

    return fulfilled


def _lift(color: str, height: float, surface: Touch) -> Condition:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        s, e = start.blocks[color], end.blocks[color]
        risen = e.position[2] - s.position[2]
        return bool(risen > height and e.bodies == {"robot"} and surface in s.contacts)

    return fulfilled


def _place(surface: Touch) -> Condition:
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
    # the hand may still touch the block at the end, as in the original
    return any(start.blocks[c].contacts == {TABLE} and DRAWER in end.blocks[c].contacts for c in COLORS)


def is_stacked(block: BlockState) -> bool:
    """Whether a block rests on other blocks and touches nothing else."""
    return bool(block.bodies) and block.bodies <= set(COLORS) and block.resting


def has_stack(snapshot: Snapshot) -> bool:
    """Whether any block is stacked."""
    return any(is_stacked(block) for block in snapshot.blocks.values())


def _touches_block(block: BlockState) -> bool:
    return bool(block.bodies & set(COLORS))


def _stack(start: Snapshot, end: Snapshot) -> bool:
    return any(not _touches_block(start.blocks[c]) and is_stacked(end.blocks[c]) for c in COLORS)


def _unstack(start: Snapshot, end: Snapshot) -> bool:
    return any(is_stacked(start.blocks[c]) and not _touches_block(end.blocks[c]) for c in COLORS)


def _joint(name: str, change: float) -> Condition:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        return bool((getattr(end, name) - getattr(start, name)) * np.sign(change) > abs(change))

    return fulfilled


def _light(name: str, on: bool) -> Condition:
    def fulfilled(start: Snapshot, end: Snapshot) -> bool:
        return getattr(start, name) != on and getattr(end, name) == on

    return fulfilled


SURFACES: dict[str | None, Touch] = {"table": TABLE, "slider": PLANK, "drawer": DRAWER}
"""`Task.place` to the part of the desk on which blocks lie there."""


def _condition(task: Task) -> Condition:
    """CALVIN's condition for a task, with its thresholds in metres and degrees."""
    color, sign = str(task.color), 1 if task.side == "right" else -1
    conditions: dict[str, Callable[[], Condition]] = {
        "rotate_block": lambda: _rotate(color, -60 * sign),
        "push_block": lambda: _push(color, 0.1 * sign),
        "move_slider": lambda: _joint("slide", -0.15 * sign),
        "open_drawer": lambda: _joint("drawer", 0.12),
        "close_drawer": lambda: _joint("drawer", -0.12),
        "lift_block": lambda: _lift(color, 0.03 if task.place == "slider" else 0.05, SURFACES[task.place]),
        "place_block": lambda: _place(SURFACES[task.place]),
        "stack_block": lambda: _stack,
        "unstack_block": lambda: _unstack,
        "turn_on_lightbulb": lambda: _light("bulb", True),
        "turn_off_lightbulb": lambda: _light("bulb", False),
        "turn_on_led": lambda: _light("led", True),
        "turn_off_led": lambda: _light("led", False),
        "push_into_drawer": lambda: _push_into_drawer,
    }
    return conditions[task.kind]()


_CONDITIONS = {task.name: _condition(task) for task in TASKS.values()}


def is_fulfilled(task: str, start: Snapshot, end: Snapshot) -> bool:
    """Whether the task of that name is fulfilled between `start` and `end`."""
    return _CONDITIONS[task](start, end)


def completed_tasks(start: Snapshot, end: Snapshot) -> set[str]:
    """Names of the tasks that are fulfilled between `start` and `end`."""
    return {task for task in TASKS if is_fulfilled(task, start, end)}
