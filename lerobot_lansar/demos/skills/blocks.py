"""Taking, carrying, setting down, stacking, turning and pushing blocks."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from ...calvin import COLORS
from ...desk.scenes import BLOCK_SIDE
from ...desk.starts import DOOR_WIDTH, DRAWER_Z, TABLE_Z
from ..moves import (
    CLOSED,
    FORWARD,
    INTO_CABINET,
    OPEN,
    TABLE_FRONT,
    TRIES,
    YAWS,
    Skill,
    View,
    Waypoint,
    approach,
    grasp_yaws,
    in_cabinet,
    lying,
    pointing,
    retreat,
    stretch,
    travel,
    turned,
)

EDGE = 0.415
"""|x| (m) up to which blocks are set down on the table, which ends at 0.44."""


# ---- taking


def _hold(view: View, color: str, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """TCP position (3,) m and euler (3,) rad that take a block where it lies."""
    position = view.block(color)[:3] + [0.0, 0.0, 0.002]
    if in_cabinet(position):
        position[0] = np.clip(position[0], *_finger_room(view, position[0]))
        deep = np.clip(position[1] - 0.085, 0.0, 0.04)  # there the hand itself would touch the door
        position[1] -= 0.3 * deep
        # a leaning hand that is turned has one finger lower than the other: turn it half as far as the block is
        yaw = FORWARD + (yaw - FORWARD) / 2 if abs(yaw - FORWARD) < 0.8 else yaw
        position[2] += 0.05 * abs(np.sin(yaw - FORWARD)) * np.sin(INTO_CABINET)
        return position, pointing(yaw, 0.0, INTO_CABINET + 5 * deep)
    if abs(position[2] - TABLE_Z) > 0.025:  # in the drawer, or on another block
        position[2] += 0.008
    return position, pointing(yaw, *stretch(position))


def _finger_room(view: View, x: float) -> tuple[float, float]:
    """x (m) between which an open hand fits into the cabinet.

    Its fingers reach out 0.067 m to either side, which counts beside a wall; the hand, 0.095 m, beside the door.
    """
    low, high = open_part(view, x)
    left, right = view.scene.cabinet
    low += 0.075 if low == left else 0.095
    high -= 0.075 if high == right else 0.095
    middle = (low + high) / 2
    return min(low, middle), max(high, middle)


def _draw_in(view: View, color: str) -> Iterator[Waypoint]:
    """Slides a block that stands too near to a wall or to the door's edge inwards, with a fingertip on its top."""
    for _ in range(4):
        x, y = view.block(color)[:2]
        low, high = _finger_room(view, x)
        slack = 0.037 - _half_width(view, color, np.array([1.0, 0.0]))
        aim = float(np.clip(x, low - slack, high + slack))
        if abs(aim - x) < 0.002 or y > 0.16:
            return
        inwards = np.sign(aim - x)
        aim += 0.02 * inwards
        # the hand's end on the side of the door or wall turns out of the cabinet
        lean = _hold(view, color, FORWARD)[1]
        euler = pointing(FORWARD + inwards, 0.0, -lean[1])
        top = np.array([x, y, view.block(color)[2] + BLOCK_SIDE / 2 + 0.016])
        yield from travel(view, top - 0.14 * approach(euler), CLOSED, euler)
        yield view.go(top - 0.05 * approach(euler), CLOSED, euler, tolerance=0.01)
        yield view.go(top - [0, 0, 0.002], CLOSED, euler, slow=0.8, tolerance=0.012)
        yield view.go(top + [(aim - x) / 4, -0.005, -0.03], CLOSED, euler, slow=0.6, tolerance=0.03)
        yield view.go(top + [aim - x, -0.01, -0.03], CLOSED, euler, slow=0.6, tolerance=0.015)
        yield view.go(view.tcp - 0.1 * approach(euler), CLOSED, euler, tolerance=0.03)


def _take(view: View, color: str, turn: float = 0.0) -> Iterator[Waypoint]:
    """Brings the open hand around a block and closes it; `turn` (rad) is how far the wrist must turn afterwards."""
    if in_cabinet(view.block(color)):
        yield from _draw_in(view, color)
    yaws = grasp_yaws(view, color)
    yaws = [yaw for yaw in yaws if YAWS[0] <= yaw + turn <= YAWS[1]] or yaws
    yaw = yaws[0] + view.scatter(0.08)
    position, euler = _hold(view, color, yaw)
    lead = 0.2 if in_cabinet(position) else 0.08 + abs(view.scatter(0.03))
    gripper = OPEN if view.held() else view.style.idle_gripper
    yield from travel(view, position - lead * approach(euler), gripper, euler)
    yield view.go(position - 0.8 * lead * approach(euler), OPEN, euler, tolerance=0.012)
    position, euler = _hold(view, color, yaw)
    yield view.go(position - 0.03 * approach(euler), OPEN, euler, slow=0.9, tolerance=0.01)
    position, euler = _hold(view, color, yaw)
    yield view.go(position, OPEN, euler, slow=0.7, tolerance=0.006)
    yield view.go(view.tcp.copy(), CLOSED, euler, hold=4, tolerance=0.02)


def lift(color: str) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Take the block and raise it; take it again if it slipped."""
        for _ in range(TRIES):
            if view.lost(color):
                return
            if not view.holds(color):
                yield from _take(view, color)
            back = view.robot_obs[3:6].copy()
            out = -approach(back) if in_cabinet(view.tcp) else np.array([0.0, 0.0, 1.0])
            high = 0.22 if view.tcp[2] < TABLE_Z - 0.05 else 0.13
            yield view.go(view.tcp + high * out, CLOSED, back, slow=0.8, keep=partial(view.holds, color))

    return skill


def unstack_block(view: View) -> Iterator[Waypoint]:
    """Take the upper block and raise it."""
    for _ in range(TRIES):
        top = _top_of_stack(view) or view.held()
        if top is None or view.lost(top):
            return
        if not view.holds(top):
            yield from _take(view, top)
        yield view.go(
            view.tcp + [0, 0, 0.12],
            CLOSED,
            view.robot_obs[3:6].copy(),
            slow=0.8,
            keep=partial(view.holds, top),
        )


def _top_of_stack(view: View) -> str | None:
    for upper in COLORS:
        for below in view.others(upper):
            gap = view.block(upper)[:3] - below[:3]
            if 0.03 < gap[2] < 0.07 and np.linalg.norm(gap[:2]) < 0.05:
                return upper
    return None


# ---- bringing


def _set_down(
    view: View, color: str, way: list[tuple[np.ndarray, float, float]], euler: np.ndarray
) -> Iterator[Waypoint]:
    """Carries the block in the hand along `way` (position, slow, tolerance), lets go at its end and draws back."""
    keep = partial(view.holds, color)
    yield from travel(view, way[0][0], CLOSED, euler, keep)
    for position, slow, tolerance in way:
        yield view.go(position, CLOSED, euler, slow=slow, tolerance=tolerance, keep=keep)
    if keep():
        yield view.go(view.tcp.copy(), OPEN, euler, tolerance=0.02, hold=4)
        yield view.go(view.tcp - 0.1 * approach(euler), OPEN, euler, tolerance=0.02)


def _from_above(view: View, color: str, place: np.ndarray, yaw: float, over: float) -> Iterator[Waypoint]:
    """Sets the block in the hand down at `place`, which the hand reaches straight from height `over`."""
    above = np.array([place[0], place[1], over])
    return _set_down(view, color, [(above, 0.9, 0.008), (place, 0.7, 0.008)], pointing(yaw, *stretch(place)))


def _bringing(bring: Callable[[View, str], Iterator[Waypoint]]) -> Skill:
    """A skill that brings the block in the hand somewhere, and takes it again where it slipped."""

    def skill(view: View) -> Iterator[Waypoint]:
        nearest = min(COLORS, key=lambda c: float(np.linalg.norm(view.block(c)[:3] - view.tcp)))
        color = view.held() or nearest
        for _ in range(2 * TRIES):
            if view.lost(color):
                return
            if view.holds(color):
                yield from bring(view, color)
                continue
            # once it has come to rest
            yield view.go(view.tcp.copy(), OPEN, view.robot_obs[3:6].copy(), tolerance=0.05, hold=8)
            if not view.lost(color):
                yield from _take(view, color)

    return skill


@_bringing
def place_in_drawer(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block over the drawer, lower it and let go."""
    y = (-0.157 - view.drawer + TABLE_FRONT) / 2
    places = [np.array([view.scene.drawer_x + x, y, 0.0]) for x in (0.0, 0.05, -0.05, 0.1, -0.1)]
    place = _freest(view, color, places) + [view.scatter(0.03), view.scatter(0.015), DRAWER_Z + 0.03]
    yield from _from_above(view, color, place, turned(view.robot_obs[5]), 0.55)


@_bringing
def place_in_slider(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block before the cabinet's open side, reach in with a leaning hand and let go."""
    low, high = open_part(view)
    middle, room = (low + high) / 2, max((high - low) / 2 - 0.07, 0.0)
    places = [np.array([middle + s * room, 0.088, 0.0]) for s in (0.0, 0.5, -0.5, 1.0, -1.0)]
    x = _freest(view, color, places)[0]
    x = float(np.clip(x + view.scatter(0.02), middle - room, middle + room))
    before = np.array([x, -0.10, 0.60 + abs(view.scatter(0.02))])
    inside = np.array([x, 0.082 + view.scatter(0.01), 0.525])
    way = [(before, 1.0, 0.015), (inside, 0.9, 0.01), (np.array([x, 0.088, 0.480]), 0.7, 0.008)]
    # the long side of the block points inwards
    yaw = FORWARD + float(np.clip(turned(view.robot_obs[5]) - FORWARD, -0.3, 0.3))
    yield from _set_down(view, color, way, pointing(yaw, 0.0, INTO_CABINET))


def open_part(view: View, x: float | None = None) -> tuple[float, float]:
    """x range (m) of the cabinet that the door leaves open: the side on which `x` is, or else the wider one."""
    left, right = view.scene.cabinet
    door = view.scene.slide_x - view.scene_obs[0]
    sides = ((left, door), (door + DOOR_WIDTH, right))
    if x is not None:
        return sides[int(x > door + DOOR_WIDTH / 2)]
    return max(sides, key=lambda side: side[1] - side[0])


def _freest(view: View, color: str, places: list[np.ndarray]) -> np.ndarray:
    """The first place with room for a block and a hand, or the one farthest from the other blocks."""
    rooms = [min(float(np.linalg.norm(other[:2] - place[:2])) for other in view.others(color)) for place in places]
    for place, room in zip(places, rooms, strict=True):
        if room > 0.11:
            return place
    return places[int(np.argmax(rooms))]


@_bringing
def stack_block(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block over another one, turn it the same way, lower it and let go."""
    base = _best_base(view, color)
    if base is None:
        return
    below = view.block(base)
    now = turned(view.robot_obs[5])
    yaws = [turned(lying(below)[0] + k * np.pi / 2) for k in range(4)]
    yaws = [yaw for yaw in yaws if YAWS[0] <= yaw <= YAWS[1]]
    yaw = min(yaws, key=lambda y: abs(y - now) + 2 * abs(np.sin(y - FORWARD)))
    # the block may hang off the fingers' middle
    hang = view.block(color)[:3] - view.tcp
    place = below[:3] - [hang[0], hang[1], 0.0] + [0.0, 0.0, BLOCK_SIDE + 0.006 - min(hang[2], 0.0)]
    if abs(yaw - now) > 0.3:  # what hangs off turns with the hand
        place[:2] = below[:2]
    yield from _from_above(view, color, place, yaw, 0.57)


def _best_base(view: View, color: str) -> str | None:
    """The block to stack on: on the table, nothing on it, nearest to the hand."""
    bases = [c for c in COLORS if c != color and on_table(view.block(c)) and not _covered(view, c, color)]
    return min(bases, key=lambda c: float(np.linalg.norm(view.block(c)[:2] - view.tcp[:2])), default=None)


def on_table(pose: np.ndarray) -> bool:
    """Whether a block lies on the table top in front of the cabinet."""
    return bool(abs(pose[2] - TABLE_Z) < 0.035 and -0.20 < pose[1] < 0.02)


def _covered(view: View, color: str, in_hand: str) -> bool:
    pose = view.block(color)
    above = [view.block(c) - pose for c in COLORS if c not in (color, in_hand)]
    return any(0.03 < gap[2] < 0.09 and np.linalg.norm(gap[:2]) < 0.05 for gap in above)


# ---- turning and pushing


def rotate(color: str, direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Take the block where it lies, turn the wrist and let go; turn on if that was not far enough."""
        wanted = direction * (1.3 + view.scatter(0.1))
        start = lying(view.block(color))[0]
        origin = view.block(color)[:3].copy()

        keep = partial(view.holds, color)
        for _ in range(TRIES):
            if view.lost(color):
                return
            done = (lying(view.block(color))[0] - start + np.pi) % (2 * np.pi) - np.pi
            left = wanted - done
            if not keep():
                yield from _take(view, color, left)
                if not keep():
                    continue
            yaw = turned(view.robot_obs[5])
            end = float(np.clip(yaw + left, *YAWS))
            ground = view.tcp.copy()
            # away from the cabinet, which a turned hand would hit; the oracle allows 0.1 m
            place = np.array([ground[0], min(ground[1], max(origin[1] - 0.085, -0.11)), ground[2]])
            lean = stretch(place)
            yield view.go(place, CLOSED, pointing(end, *lean), tolerance=0.01, keep=keep)
            if not keep():
                continue
            yield view.go(place, OPEN, pointing(end, *lean), tolerance=0.02, hold=4)
            yield view.go(place + [0, 0, 0.09], OPEN, pointing(end, *lean), tolerance=0.02)

    return skill


def _half_width(view: View, color: str, direction: np.ndarray) -> float:
    """Half of a lying block's extent along a horizontal direction (m)."""
    yaw, horizontal = lying(view.block(color))
    length = view.length(color) if horizontal else BLOCK_SIDE
    along = abs(np.cos(yaw) * direction[0] + np.sin(yaw) * direction[1])
    across = abs(-np.sin(yaw) * direction[0] + np.cos(yaw) * direction[1])
    return float(length * along + BLOCK_SIDE * across) / 2


def _shove(view: View, color: str, direction: np.ndarray, distance: float) -> Iterator[Waypoint]:
    """Sets the closed hand down beside a block and pushes it along `direction` (2,)."""
    block = view.block(color)
    behind = _half_width(view, color, direction) + 0.03 + abs(view.scatter(0.01))
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
        yield from _take(view, color)
    if not view.holds(color):
        return
    euler = view.robot_obs[3:6].copy()

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
        """Push the block along; carry it where the button's rim or another block is in the way."""
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
    """Whether a block can be pushed along x to `end`, and a hand fits behind it."""
    half = _half_width(view, color, np.array([0.0, 1.0]))
    width = _half_width(view, color, np.array([1.0, 0.0]))
    direction = np.sign(end - pose[0])
    low, high = sorted((pose[0] - direction * (width + 0.06), end + direction * width))
    if abs(pose[1] + 0.12) < half + 0.045 and low < view.scene.button_x + 0.042 and high > view.scene.button_x - 0.042:
        return False
    for name in COLORS:
        other = view.block(name)
        if name != color and abs(other[2] - pose[2]) < 0.06:
            reach_y = half + _half_width(view, name, np.array([0.0, 1.0])) + 0.01
            reach_x = _half_width(view, name, np.array([1.0, 0.0]))
            if abs(other[1] - pose[1]) < reach_y and low < other[0] + reach_x and high > other[0] - reach_x:
                return False
    return bool(abs(end) < EDGE)


def _landing(view: View, color: str, xs: np.ndarray) -> np.ndarray:
    """A free place (2,) on the table with x among `xs`, as near to the block as can be."""
    pose, radius = view.block(color), view.length(color) / 2
    best, least = np.array([xs[0], pose[1]]), np.inf
    for x in xs[np.abs(xs) <= EDGE]:
        for y in np.linspace(-0.14, -0.04, 6):
            if abs(x - view.scene.button_x) < radius + 0.05 and abs(y + 0.12) < radius + 0.05:
                continue
            place = np.array([x, y])
            room = min(float(np.linalg.norm(other[:2] - place)) for other in view.others(color))
            cost = abs(x - pose[0]) + abs(y - pose[1]) + 5 * max(0.0, 0.1 - room)
            if cost < least:
                best, least = place, cost
    return best


def push_into_drawer(view: View) -> Iterator[Waypoint]:
    """Push the block nearest to the open drawer over the table's edge; first fetch it in front of the drawer."""
    for _ in range(TRIES + 2):
        color = _nearest_to_drawer(view)
        if color is None:  # one that tips over the edge takes a moment to land
            yield view.go(view.tcp.copy(), CLOSED, view.robot_obs[3:6].copy(), hold=15)
            continue
        pose = view.block(color)
        to_edge = pose[1] - (TABLE_FRONT - 0.03)
        half = _half_width(view, color, np.array([0.0, 1.0]))
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
    lying_there = [color for color in COLORS if on_table(view.block(color)) or view.holds(color)]

    def effort(color: str) -> float:
        pose = view.block(color)
        aside = max(0.0, abs(pose[0] - view.scene.drawer_x) - 0.12)
        return float(pose[1] + 3 * aside - (1.0 if view.holds(color) else 0.0))

    return min(lying_there, key=effort, default=None)


def put_down(view: View) -> Iterator[Waypoint]:
    """Set the block in the hand down on the table, or open the hand; no task of its own."""
    color = view.held()
    if color is None:
        yield view.go(view.tcp.copy(), OPEN, view.robot_obs[3:6].copy(), hold=5)
    else:
        place = np.array([*_landing(view, color, np.arange(-0.3, 0.36, 0.03)), TABLE_Z + 0.012])
        yield from _from_above(view, color, place, turned(view.robot_obs[5]), 0.55)
