"""Taking, lifting, carrying, setting down and stacking blocks."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import permutations

import numpy as np
from scipy.spatial.transform import Rotation

from ...calvin import COLORS, GRIPPER_WIDTH
from ...desk.scenes import BLOCK_SIDE, BUTTON_Y, CABINET_FLOOR, DOOR_WIDTH, DRAWER_Z, TABLE_Z
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
    half_height,
    in_cabinet,
    lying,
    on_table,
    pointing,
    stretch,
    travel,
    turned,
    under_way,
)
from .furniture import push_door

EDGE = 0.415
"""|x| (m) up to which blocks are set down on the table, which ends at 0.44."""

# ---- taking


def _hold(view: View, color: str, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """TCP position (3,) m and euler (3,) rad from which the fingers close on a block where it lies."""
    position = view.block(color)[:3] + [0.0, 0.0, 0.002]
    if in_cabinet(position):
        lean = 0.0
        if position[1] > 0.02:  # behind the door
            # beside the wall or the door's edge the hand stays farther inside than its fingertips
            low, high = _finger_room(view, open_part(view, position[0]))
            lean = float(np.clip(10 * (position[0] - np.clip(position[0], low, high)), -0.3, 0.3))
        deep = np.clip(position[1] - 0.085, 0.0, 0.04)  # so deep inside the hand itself would touch the door
        position[1] -= 0.3 * deep
        # a leaning hand that is also turned has one finger lower than the other: turn it half as far as the block
        yaw = FORWARD + (yaw - FORWARD) / 2 if abs(yaw - FORWARD) < 0.8 else yaw
        position[2] += 0.05 * abs(np.sin(yaw - FORWARD)) * np.sin(INTO_CABINET) + 0.03 * abs(np.sin(lean))
        return position, pointing(yaw, lean, INTO_CABINET + 5 * deep)
    if abs(position[2] - TABLE_Z) > 0.025:  # in the drawer, or on another block
        position[2] += 0.008
    elif position[1] > -0.07 and 0.4 < abs(yaw - FORWARD) < 0.9:  # a turned hand would hit the cabinet
        yaw = FORWARD + (yaw - FORWARD) / 2
    return position, pointing(yaw, *stretch(position))


def _finger_room(view: View, part: tuple[float, float]) -> tuple[float, float]:
    """Range of x (m) in which an open hand fits into that part of the cabinet.

    It needs 0.075 m to either side for its fingers, beside a wall, and 0.095 m for the hand itself, beside the door.
    """
    left, right = view.scene.cabinet
    low = part[0] + (0.075 if part[0] == left else 0.095)
    high = part[1] - (0.075 if part[1] == right else 0.095)
    middle = (low + high) / 2
    return min(low, middle), max(high, middle)


def _make_room(view: View, color: str) -> Iterator[Waypoint]:
    """Pushes the door away from a block in the cabinet if the hand has too little room beside it."""
    x = view.block(color)[0]
    low, high = _finger_room(view, open_part(view, x))
    away = -1.0 if x > view.scene.slide_x - view.slide + DOOR_WIDTH / 2 else 1.0
    left = view.scene.slide_travel - view.slide if away < 0 else view.slide
    if abs(x - np.clip(x, low, high)) > 0.02 and left > 0.03:
        yield from push_door(view, away)


def take(view: View, color: str, turn: float = 0.0) -> Iterator[Waypoint]:
    """Moves the open hand around a block and closes it; `turn` (rad) is how far the wrist must turn afterwards."""
    yaws = grasp_yaws(view, color)
    yaws = [yaw for yaw in yaws if YAWS[0] <= yaw + turn <= YAWS[1]] or yaws
    in_there = in_cabinet(view.block(color))
    if in_there:
        yield from _make_room(view, color)
    yaw = yaws[0] + (0.0 if in_there else view.scatter(0.08))
    lead = 0.2 if in_there else 0.08 + abs(view.scatter(0.03))
    position, euler = _hold(view, color, yaw)
    if not under_way(view, position - 0.8 * lead * approach(euler), position, euler, OPEN):
        yield from travel(view, position - lead * approach(euler), OPEN, euler)
        yield view.go(position - 0.8 * lead * approach(euler), OPEN, euler, tolerance=0.012)
        position, euler = _hold(view, color, yaw)
        yield view.go(position - 0.03 * approach(euler), OPEN, euler, slow=0.9, tolerance=0.01)
    position, euler = _hold(view, color, yaw)
    yield view.go(position, OPEN, euler, slow=0.7, tolerance=0.012)
    yield view.go(view.tcp.copy(), CLOSED, euler, hold=4, tolerance=0.02)


def lift(color: str) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Take the block and lift it; take it again if it slipped."""
        for _ in range(TRIES):
            if view.lost(color):
                return
            if not view.holds(color):
                yield from take(view, color)
            back = view.euler
            out = -approach(back) if in_cabinet(view.tcp) else np.array([0.0, 0.0, 1.0])
            high = 0.22 if view.tcp[2] < TABLE_Z - 0.05 else 0.13
            yield view.go(view.tcp + high * out, CLOSED, back, slow=0.8, keep=partial(view.holds, color))

    return skill


def unstack_block(view: View) -> Iterator[Waypoint]:
    """Take the upper block and lift it."""
    top = top_of_stack(view.start) or top_of_stack(view)
    for _ in range(TRIES):
        if top is None or view.lost(top):
            return
        if not view.holds(top):
            yield from take(view, top)
        yield view.go(
            view.tcp + [0, 0, 0.12],
            CLOSED,
            view.euler,
            slow=0.8,
            keep=partial(view.holds, top),
        )


def top_of_stack(view: View) -> str | None:
    """The block directly on top of another one, if any."""
    pairs = permutations(COLORS, 2)
    return next((upper for upper, lower in pairs if view.lies_on(upper, lower, height=0.07)), None)


# ---- carrying and setting down


def _set_down(
    view: View, color: str, way: list[tuple[np.ndarray, float, float]], euler: np.ndarray
) -> Iterator[Waypoint]:
    """Carries the block in the hand along `way` (position, slow, tolerance), lets go at its end and backs off."""
    keep = partial(view.holds, color)
    yield from travel(view, way[0][0], CLOSED, euler, keep)
    for position, slow, tolerance in way:
        yield view.go(position, CLOSED, euler, slow=slow, tolerance=tolerance, keep=keep)
    if keep():
        yield view.go(view.tcp.copy(), OPEN, euler, tolerance=0.02, hold=4)
        yield view.go(view.tcp - 0.1 * approach(euler), OPEN, euler, tolerance=0.02)


def set_down_from_above(view: View, color: str, place: np.ndarray, yaw: float, height: float) -> Iterator[Waypoint]:
    """Sets the block in the hand down at `place` (3,) m, straight down from `height` (m)."""
    above = np.array([place[0], place[1], height])
    return _set_down(view, color, [(above, 0.9, 0.008), (place, 0.7, 0.008)], pointing(yaw, *stretch(place)))


def _as_held(view: View, color: str, euler: np.ndarray) -> tuple[np.ndarray, float]:
    """How the block in the hand hangs from a hand with that `euler`, which may lean or be turned otherwise than now.

    Returns:
        Position of its centre relative to the TCP (3,) m, and half of its vertical extent (m).
    """
    turn = Rotation.from_euler("xyz", euler) * Rotation.from_euler("xyz", view.euler).inv()
    pose = view.block(color)
    return turn.apply(pose[:3] - view.tcp), half_height(view, color, turn)


def landing(view: View, color: str, xs: np.ndarray) -> np.ndarray:
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


def put_down(view: View) -> Iterator[Waypoint]:
    """Set the block in the hand down on the table, or open the hand; serves no task."""
    color = view.held()
    if color is None:
        yield view.go(view.tcp.copy(), OPEN, view.euler, hold=5)
    else:
        place = np.array([*landing(view, color, np.arange(-0.3, 0.36, 0.03)), TABLE_Z + 0.012])
        yield from set_down_from_above(view, color, place, view.yaw, 0.55)


def let_go(view: View, color: str) -> Iterator[Waypoint]:
    """Opens the hand where the held block stands, or puts the block down on the table if it stands on nothing."""
    if not _stands(view, color):
        yield from put_down(view)
        return
    yield view.go(view.tcp.copy(), OPEN, view.euler, tolerance=0.02, hold=4)
    yield from leave(view)


def leave(view: View, but: str | None = None) -> Iterator[Waypoint]:
    """Raises the open hand from around a block other than `but`, which it would take along if it closed."""
    around = [color for color in COLORS if np.linalg.norm(view.block(color)[:3] - view.tcp) < 0.06]
    if around and but not in around and view.robot_obs[GRIPPER_WIDTH] > 0.02:
        yield view.go(view.tcp - 0.1 * approach(view.euler), OPEN, view.euler, tolerance=0.02)


def _stands(view: View, color: str) -> bool:
    """Whether a block stands on the table or on another block, to within 0.01 m."""
    pose = view.block(color)
    bottom = pose[2] - half_height(view, color)
    tops = [view.block(c)[2] + half_height(view, c) for c in COLORS if c != color and view.lies_on(color, c)]
    if -0.20 < pose[1] < 0.02:
        tops.append(TABLE_Z - BLOCK_SIDE / 2)
    return any(abs(bottom - top) < 0.01 for top in tops)


def _carrying(carry: Callable[[View, str], Iterator[Waypoint]]) -> Skill:
    """A skill that carries the block held when the command began somewhere; it takes that one again if it slipped."""

    def skill(view: View) -> Iterator[Waypoint]:
        begun = view.start
        color = min(COLORS, key=lambda c: float(np.linalg.norm(begun.block(c)[:3] - begun.tcp)))
        for _ in range(2 * TRIES):
            if view.lost(color):
                return
            if view.holds(color):
                yield from carry(view, color)
                continue
            # wait for the block to come to rest
            yield view.go(view.tcp.copy(), OPEN, view.euler, tolerance=0.05, hold=8)
            if not view.lost(color):
                yield from take(view, color)

    return skill


def into_drawer(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block over the drawer, lower it and let go."""
    y = (-0.157 - view.drawer + TABLE_FRONT) / 2
    places = [np.array([view.scene.drawer_x + x, y, 0.0]) for x in (0.0, 0.05, -0.05, 0.1, -0.1)]
    place = _freest(view, color, places) + [view.scatter(0.03), view.scatter(0.015), DRAWER_Z + 0.03]
    yield from set_down_from_above(view, color, place, view.yaw, 0.55)


place_in_drawer = _carrying(into_drawer)


@_carrying
def place_in_slider(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block in front of the cabinet's open part, reach in with a leaning hand and let it drop."""
    x = float(np.clip(_shelf_place(view, color) + view.scatter(0.01), *_finger_room(view, open_part(view))))
    # the long side of the block points inwards
    yaw = FORWARD + float(np.clip(view.yaw - FORWARD, -0.3, 0.3))
    euler = pointing(yaw, 0.0, INTO_CABINET)
    hang, half = _as_held(view, color, euler)
    inside = np.array([x, 0.086, CABINET_FLOOR + half - hang[2] + 0.012])
    way = [(np.array([x, -0.10, 0.60]), 1.0, 0.015), (inside, 0.8, 0.012)]
    yield from _set_down(view, color, way, euler)


def _shelf_place(view: View, color: str) -> float:
    """x (m) in the cabinet's open part where a block is put: in the middle, or else where it is farther from others.

    Of two places that are nearly as good, it is the one at the wall.
    """
    part = open_part(view)
    low, high = _finger_room(view, part)
    by_wall, by_door = (low, high) if part[0] == view.scene.cabinet[0] else (high, low)

    def room(x: float) -> float:
        return min(float(np.linalg.norm(other[:2] - [x, 0.086])) for other in view.others(color))

    middle = (low + high) / 2
    if room(middle) > 0.11:
        return middle
    return by_wall if room(by_wall) > room(by_door) - 0.02 else by_door


def has_shelf_room(view: View) -> bool:
    """Whether the cabinet is open so far that a block can be put in beside the door."""
    low, high = open_part(view)
    return high - low > 0.17


def open_part(view: View, x: float | None = None) -> tuple[float, float]:
    """Range of x (m) that the cabinet's door leaves open: the side on which `x` is; without `x` the wider side."""
    left, right = view.scene.cabinet
    door = view.scene.slide_x - view.slide
    sides = ((left, door), (door + DOOR_WIDTH, right))
    if x is not None:
        return sides[int(x > door + DOOR_WIDTH / 2)]
    return max(sides, key=lambda side: side[1] - side[0])


def _freest(view: View, color: str, places: list[np.ndarray]) -> np.ndarray:
    """The first of `places` with room for a block and a hand, or else the one farthest from the other blocks."""
    rooms = [min(float(np.linalg.norm(other[:2] - place[:2])) for other in view.others(color)) for place in places]
    for place, room in zip(places, rooms, strict=True):
        if room > 0.11:
            return place
    return places[int(np.argmax(rooms))]


@_carrying
def stack_block(view: View, color: str) -> Iterator[Waypoint]:
    """Carry the block over another one, align it with that one, lower it and let go."""
    base = best_base(view, color)
    if base is None:
        return
    below = view.block(base)
    now = view.yaw
    yaws = [turned(lying(below)[0] + k * np.pi / 2) for k in range(4)]
    yaws = [yaw for yaw in yaws if YAWS[0] <= yaw <= YAWS[1]]
    yaw = min(yaws, key=lambda y: abs(y - now) + 2 * abs(np.sin(y - FORWARD)))
    hang, _ = _as_held(view, color, pointing(yaw, *stretch(below[:3])))
    place = below[:3] - [hang[0], hang[1], 0.0] + [0.0, 0.0, BLOCK_SIDE + 0.006 - min(hang[2], 0.0)]
    yield from set_down_from_above(view, color, place, yaw, 0.57)


def best_base(view: View, color: str) -> str | None:
    """The block to stack on: the nearest to the hand of those on the table with nothing on them."""

    def is_free(base: str) -> bool:
        (third,) = set(COLORS) - {base, color}
        return on_table(view.block(base)) and not view.lies_on(third, base, height=0.09)

    bases = [c for c in COLORS if c != color and is_free(c)]
    return min(bases, key=lambda c: float(np.linalg.norm(view.block(c)[:2] - view.tcp[:2])), default=None)
