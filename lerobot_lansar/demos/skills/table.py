"""Moving blocks about on the table: turning, pushing, pushing into the drawer, setting down."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from ...calvin import COLORS, wrap_angle
from ...desk.scenes import BUTTON_Y, TABLE_Z
from ..moves import (
    CLOSED,
    FORWARD,
    OPEN,
    TABLE_FRONT,
    TRIES,
    YAWS,
    Skill,
    View,
    Waypoint,
    half_width,
    lying,
    on_table,
    pointing,
    retreat,
    stretch,
    travel,
    turned,
)
from .blocks import set_down_from_above, take

EDGE = 0.415
"""|x| (m) up to which blocks are set down on the table, which ends at 0.44."""


def rotate(color: str, direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Take the block where it lies, turn the wrist and let go; turn further if that was not enough."""
        wanted = direction * (1.3 + view.scatter(0.1))
        start = lying(view.block(color))[0]
        origin = view.block(color)[:3].copy()

        keep = partial(view.holds, color)
        for _ in range(TRIES):
            if view.lost(color):
                return
            done = wrap_angle(lying(view.block(color))[0] - start)
            left = wanted - done
            if not keep():
                yield from take(view, color, left)
                if not keep():
                    continue
            yaw = view.yaw
            end = float(np.clip(yaw + left, *YAWS))
            ground = view.tcp.copy()
            # away from the cabinet, which a turned hand would hit; the oracle lets the block move by 0.1 m
            place = np.array([ground[0], min(ground[1], max(origin[1] - 0.085, -0.11)), ground[2]])
            lean = stretch(place)
            yield view.go(place, CLOSED, pointing(end, *lean), tolerance=0.01, keep=keep)
            if not keep():
                continue
            yield view.go(place, OPEN, pointing(end, *lean), tolerance=0.02, hold=4)
            yield view.go(place + [0, 0, 0.09], OPEN, pointing(end, *lean), tolerance=0.02)

    return skill


def _shove(view: View, color: str, direction: np.ndarray, distance: float) -> Iterator[Waypoint]:
    """Sets the closed hand down beside a block and pushes it by `distance` (m) along `direction` (2,)."""
    block = view.block(color)
    behind = half_width(view, color, direction) + 0.03 + abs(view.scatter(0.01))
    side = np.array([-direction[1], direction[0]]) * view.scatter(0.004)
    z = block[2] + 0.007
    start = np.array([*(block[:2] - direction * behind + side), z])
    euler = pointing(FORWARD + view.style.yaw, *stretch(start))
    yield from travel(view, start + [0, 0, 0.08], view.style.idle_gripper, euler)
    yield view.go(start + [0, 0, 0.06], CLOSED, euler, tolerance=0.012)
    yield view.go(start, CLOSED, euler, slow=0.8, tolerance=0.008)
    end = np.array([*(start[:2] + direction * (distance + 0.03 + abs(view.scatter(0.01)))), z])
    yield view.go(end, CLOSED, euler, slow=0.8)
    yield view.go(view.tcp - [*(0.02 * direction), -0.08], CLOSED, euler, tolerance=0.03)


def _carry(view: View, color: str, place: np.ndarray) -> Iterator[Waypoint]:
    """Takes a block, carries it low over the table to `place` (2,) and sets it down."""
    if not view.holds(color):
        yield from take(view, color)
    if not view.holds(color):
        return
    euler = view.euler

    keep = partial(view.holds, color)
    ground = view.tcp[2]
    yield view.go(view.tcp + [0, 0, 0.06], CLOSED, euler, slow=0.8, tolerance=0.015, keep=keep)
    target = np.array([*place, ground + 0.004])
    lean = pointing(turned(euler[2]), *stretch(target))
    yield view.go(target + [0, 0, 0.055], CLOSED, lean, slow=0.9, tolerance=0.015, keep=keep)
    yield view.go(target, CLOSED, lean, slow=0.7, tolerance=0.008, keep=keep)
    yield view.go(target, OPEN, lean, tolerance=0.02, hold=4)
    yield view.go(target + [0, 0, 0.09], OPEN, lean, tolerance=0.02)


def push(color: str, direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Push the block sideways; carry it if the button's rim or another block is in the way."""
        begin = view.block(color)[0]
        for _ in range(TRIES):
            if view.lost(color):
                return
            pose = view.block(color)
            missing = 0.125 - direction * (pose[0] - begin)
            end = pose[0] + direction * max(missing, 0.03)
            if _way_is_free(view, color, pose, end) and abs(pose[2] - TABLE_Z) < 0.03:
                yield from _shove(view, color, np.array([direction, 0.0]), max(missing, 0.03))
            else:
                yield from retreat(view, OPEN)
                yield from _carry(view, color, _landing(view, color, begin + direction * np.arange(0.125, 0.34, 0.015)))

    return skill


def _way_is_free(view: View, color: str, pose: np.ndarray, end: float) -> bool:
    """Whether a block can be pushed along x to `end` (m), with room for a hand behind it."""
    half = half_width(view, color, np.array([0.0, 1.0]))
    width = half_width(view, color, np.array([1.0, 0.0]))
    direction = np.sign(end - pose[0])
    low, high = sorted((pose[0] - direction * (width + 0.06), end + direction * width))
    button = view.scene.button_x
    if abs(pose[1] - BUTTON_Y) < half + 0.045 and low < button + 0.042 and high > button - 0.042:
        return False
    for name in COLORS:
        other = view.block(name)
        if name != color and abs(other[2] - pose[2]) < 0.06:
            reach_y = half + half_width(view, name, np.array([0.0, 1.0])) + 0.01
            reach_x = half_width(view, name, np.array([1.0, 0.0]))
            if abs(other[1] - pose[1]) < reach_y and low < other[0] + reach_x and high > other[0] - reach_x:
                return False
    return bool(abs(end) < EDGE)


def _landing(view: View, color: str, xs: np.ndarray) -> np.ndarray:
    """A free place (2,) m on the table with x among `xs`, as near to the block as possible."""
    pose, radius = view.block(color), view.length(color) / 2
    best, lowest = np.array([xs[0], pose[1]]), np.inf
    for x in xs[np.abs(xs) <= EDGE]:
        for y in np.linspace(-0.14, -0.04, 6):
            if abs(x - view.scene.button_x) < radius + 0.05 and abs(y - BUTTON_Y) < radius + 0.05:
                continue
            place = np.array([x, y])
            room = min(float(np.linalg.norm(other[:2] - place)) for other in view.others(color))
            cost = abs(x - pose[0]) + abs(y - pose[1]) + 5 * max(0.0, 0.1 - room)
            if cost < lowest:
                best, lowest = place, cost
    return best


def push_into_drawer(view: View) -> Iterator[Waypoint]:
    """Push the block nearest to the open drawer over the table's edge; first carry it in front of the drawer."""
    for _ in range(TRIES + 2):
        color = _nearest_to_drawer(view)
        if color is None:  # the block is tipping over the edge: wait until it lands
            yield view.go(view.tcp.copy(), CLOSED, view.euler, hold=15)
            continue
        pose = view.block(color)
        to_edge = pose[1] - (TABLE_FRONT - 0.03)
        half = half_width(view, color, np.array([0.0, 1.0]))
        before_drawer = abs(pose[0] - view.scene.drawer_x) < 0.13
        room_behind = pose[1] + half + 0.045 < 0.0
        if before_drawer and room_behind and abs(pose[2] - TABLE_Z) < 0.03:
            yield from _shove(view, color, np.array([0.0, -1.0]), to_edge - 0.02)
        else:
            x = float(np.clip(pose[0], view.scene.drawer_x - 0.10, view.scene.drawer_x + 0.10))
            yield from retreat(view, OPEN)
            yield from _carry(view, color, np.array([x, -0.12]))


def _nearest_to_drawer(view: View) -> str | None:
    """The block on the table that is easiest to push into the drawer."""
    candidates = [color for color in COLORS if on_table(view.block(color)) or view.holds(color)]

    def effort(color: str) -> float:
        pose = view.block(color)
        aside = max(0.0, abs(pose[0] - view.scene.drawer_x) - 0.12)
        return float(pose[1] + 3 * aside - (1.0 if view.holds(color) else 0.0))

    return min(candidates, key=effort, default=None)


def put_down(view: View) -> Iterator[Waypoint]:
    """Set the block in the hand down on the table, or open the hand; serves no task."""
    color = view.held()
    if color is None:
        yield view.go(view.tcp.copy(), OPEN, view.euler, hold=5)
    else:
        place = np.array([*_landing(view, color, np.arange(-0.3, 0.36, 0.03)), TABLE_Z + 0.012])
        yield from set_down_from_above(view, color, place, view.yaw, 0.55)
