"""Moving blocks about on the table: turning, pushing, pushing into the drawer."""

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
    stretch,
    travel,
    under_way,
)
from .blocks import EDGE, into_drawer, landing, take


def rotate(color: str, direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Take the block where it lies, turn the wrist and let go; turn further if that was not enough."""
        wanted = direction * (1.3 + view.scatter(0.1))
        start = view.start.block(color)

        keep = partial(view.holds, color)
        for _ in range(2 * TRIES):
            if view.lost(color):
                return
            left = wanted - wrap_angle(lying(view.block(color))[0] - lying(start)[0])
            if not keep():
                yield from take(view, color, left)
                if not keep():
                    continue
            end = float(np.clip(view.yaw + left, *YAWS))
            # away from the cabinet, which a turned hand would hit; the oracle lets the block move by 0.1 m
            x = float(np.clip(view.tcp[0], start[0] - 0.05, start[0] + 0.05))
            front, back = max(start[1] - 0.085, -0.14), max(start[1] - 0.085, -0.11)
            place = np.array([x, np.clip(view.tcp[1], front, back), _ground(view, color)])
            yield from _over(view, color, place)
            yield view.go(place, CLOSED, pointing(end, *stretch(place)), tolerance=0.01, keep=keep)
            if keep():
                yield from _let_go(view, place, pointing(end, *stretch(place)))

    return skill


def _ground(view: View, color: str) -> float:
    """Height (m) of the TCP at which the block in the hand stands on the table."""
    return float(TABLE_Z + view.tcp[2] - view.block(color)[2])


def _over(view: View, color: str, place: np.ndarray) -> Iterator[Waypoint]:
    """Brings a block that is not held low over the table to above `place` (3,)."""
    if not on_table(view.block(color)) or view.tcp[2] > place[2] + 0.03:
        keep = partial(view.holds, color)
        yield from travel(view, place, CLOSED, pointing(view.yaw, *stretch(place)), keep)
        yield view.go(place + [0, 0, 0.055], CLOSED, pointing(view.yaw, *stretch(place)), tolerance=0.015, keep=keep)


def _let_go(view: View, place: np.ndarray, euler: np.ndarray) -> Iterator[Waypoint]:
    """Opens the hand at `place` (3,) and lifts it."""
    yield view.go(place, OPEN, euler, tolerance=0.02, hold=4)
    yield view.go(place + [0, 0, 0.09], OPEN, euler, tolerance=0.02)


def _shove(view: View, color: str, direction: np.ndarray, distance: float) -> Iterator[Waypoint]:
    """Sets the closed hand down beside a block and pushes it by `distance` (m) along `direction` (2,)."""
    block = view.block(color)
    behind = half_width(view, color, direction) + 0.03 + abs(view.scatter(0.01))
    side = np.array([-direction[1], direction[0]]) * view.scatter(0.004)
    z = block[2] + 0.007
    start = np.array([*(block[:2] - direction * behind + side), z])
    euler = pointing(FORWARD + view.style.yaw, *stretch(start))
    ahead = np.array([*(0.03 * direction), 0.0])
    if not under_way(view, start - ahead, start + ahead, euler, CLOSED):
        if not under_way(view, start + [0, 0, 0.06], start, euler, CLOSED):
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
    keep = partial(view.holds, color)
    target = np.array([*place, _ground(view, color) + 0.002])
    if on_table(view.block(color)):
        up = max(target[2] + 0.055, view.tcp[2])
        yield view.go((*view.tcp[:2], up), CLOSED, view.euler, slow=0.8, tolerance=0.015, keep=keep)
    else:
        yield from travel(view, target, CLOSED, view.euler, keep)
    euler = pointing(view.yaw, *stretch(target))
    yield view.go(target + [0, 0, 0.055], CLOSED, euler, slow=0.9, tolerance=0.015, keep=keep)
    yield view.go(target, CLOSED, euler, slow=0.7, tolerance=0.008, keep=keep)
    if keep():
        yield from _let_go(view, target, euler)


def push(color: str, direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Push the block sideways; carry it if the button's rim or another block is in the way."""
        begin = view.start.block(color)[0]
        for _ in range(TRIES):
            if view.lost(color):
                return
            pose = view.block(color)
            missing = 0.125 - direction * (pose[0] - begin)
            end = pose[0] + direction * max(missing, 0.03)
            can_be_pushed = abs(pose[2] - TABLE_Z) < 0.03 and not view.holds(color)
            if can_be_pushed and _way_is_free(view, color, pose, end):
                yield from _shove(view, color, np.array([direction, 0.0]), max(missing, 0.03))
            else:
                yield from _carry(view, color, landing(view, color, begin + direction * np.arange(0.125, 0.34, 0.015)))

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


def push_into_drawer(view: View) -> Iterator[Waypoint]:
    """Push the block nearest to the open drawer over the table's edge, or put it in from above."""
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
        if before_drawer and room_behind and abs(pose[2] - TABLE_Z) < 0.03 and not view.holds(color):
            yield from _shove(view, color, np.array([0.0, -1.0]), to_edge - 0.02)
        elif view.holds(color):
            yield from into_drawer(view, color)
        else:
            yield from take(view, color)


def _nearest_to_drawer(view: View) -> str | None:
    """The block that is easiest to bring into the drawer, of those that lay on the table when the command began."""
    candidates = [color for color in COLORS if on_table(view.block(color)) or view.holds(color)]
    candidates = [color for color in candidates if on_table(view.start.block(color))]

    def effort(color: str) -> float:
        pose = view.block(color)
        aside = max(0.0, abs(pose[0] - view.scene.drawer_x) - 0.12)
        return float(pose[1] + 3 * aside - (1.0 if view.holds(color) else 0.0))

    return min(candidates, key=effort, default=None)
