"""Moving the desk's parts: drawer, door, switch and button."""

from collections.abc import Iterator

import numpy as np

from ...calvin import SWITCH
from ...desk.scenes import BUTTON_TRAVEL, BUTTON_Y
from ..moves import CLOSED, FORWARD, TRIES, Skill, View, Waypoint, travel

HANDLE_Z = 0.365
"""Height (m) at which the hand pulls and pushes the drawer's handle."""


def open_drawer(view: View) -> Iterator[Waypoint]:
    """Reach behind the handle's bar from above and pull; pull again if the drawer did not come far enough."""
    x = view.scene.drawer_x + view.scatter(0.06)
    for _ in range(TRIES):
        gap = -0.211 - view.drawer
        yield from travel(view, (x, gap, 0.53), view.style.idle_gripper)
        yield view.go((x, gap, 0.52 + view.scatter(0.02)), tolerance=0.015)
        yield view.go((x, gap, HANDLE_Z), slow=0.8, tolerance=0.01)
        yield view.go((x, gap - 0.24, HANDLE_Z + view.scatter(0.005)), slow=0.8)


def close_drawer(view: View) -> Iterator[Waypoint]:
    """Go in front of the handle's bar and push."""
    x = view.scene.drawer_x + view.scatter(0.07)
    for _ in range(TRIES):
        front = -0.2612 - view.drawer - 0.05
        yield from travel(view, (x, front, 0.50), view.style.idle_gripper)
        yield view.go((x, front, 0.48 + view.scatter(0.03)), tolerance=0.02)
        yield view.go((x, front, HANDLE_Z), slow=0.9, tolerance=0.015)
        yield view.go((x, -0.2612 + 0.03, HANDLE_Z + view.scatter(0.005)), slow=0.8)


def press_button(view: View) -> Iterator[Waypoint]:
    """Press the LED's button from above; release it and press again if the light did not change."""
    for _ in range(TRIES):
        x, y = view.scene.button_x + view.scatter(0.012), BUTTON_Y + view.scatter(0.012)
        yield from travel(view, (x, y, 0.56), view.style.idle_gripper)
        yield view.go((x, y, 0.54 + view.scatter(0.015)), tolerance=0.015)
        yield view.go((x, y, 0.483 - BUTTON_TRAVEL), slow=0.7, tolerance=0.006)
        yield view.go((x, y, 0.54))


def slide(direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        """Go beside the door's handle and push it along the cabinet."""
        for _ in range(TRIES):
            yield from push_door(view, direction)

    return skill


def push_door(view: View, direction: float) -> Iterator[Waypoint]:
    """Pushes the door to its end on the left (-1) or right (+1), once, and backs off."""
    # the handle is 0.042 m wide, centred at this x
    handle = view.scene.slide_x + 0.14 - view.slide
    beside = handle - direction * (0.021 + 0.05 + abs(view.scatter(0.015)))
    end = view.scene.slide_x + 0.14 - (view.scene.slide_travel if direction < 0 else 0.0)
    z = 0.53 + view.scatter(0.006)
    yield from travel(view, (beside, -0.07, 0.58), view.style.idle_gripper)
    yield view.go((beside, -0.06, 0.58), tolerance=0.02)
    yield view.go((beside, -0.012, z), slow=0.9)
    yield view.go((end + direction * 0.05, -0.012, z), slow=0.85)
    yield view.go((view.tcp[0] - direction * 0.03, -0.09, 0.58))


def _lever(view: View) -> np.ndarray:
    """Centre of the switch's bar, (3,) m; the bar slides up the cabinet's front, which leans back by 30 degrees."""
    way = view.scene_obs[SWITCH]
    return np.array([view.scene.switch_x, 0.019 + 0.5 * way, 0.528 + 0.866 * way])


def _reaching(view: View) -> np.ndarray:
    """Euler angles (3,) of a hand whose fingers point forward and outward; one pointing down cannot reach the lever."""
    return np.array([np.pi - 0.5 * np.sign(view.scene.switch_x), -0.6, FORWARD])


def turn_on_lightbulb(view: View) -> Iterator[Waypoint]:
    """Reach under the lever with a tilted hand and push it up along the cabinet's front."""
    tilt = _reaching(view)
    for _ in range(TRIES):
        x, lever = view.scatter(0.02), _lever(view)
        before = lever + [x, -0.08, -0.02]
        yield from travel(view, before + [0, -0.04, 0], view.style.idle_gripper, tilt)
        yield view.go(before, CLOSED, tilt, tolerance=0.02)
        yield view.go(lever + [x, -0.01, -0.035], CLOSED, tilt, slow=0.9)
        for up in np.linspace(0.0, 0.12, 6):
            yield view.go(lever + [x, 0.55 * up, up - 0.03], CLOSED, tilt, slow=0.8)
        yield view.go(view.tcp + [0, -0.08, 0], CLOSED, tilt, tolerance=0.03)


def turn_off_lightbulb(view: View) -> Iterator[Waypoint]:
    """Reach over the lever with a tilted hand and press it down along the cabinet's front."""
    tilt = _reaching(view)
    for _ in range(TRIES):
        x, lever = view.scatter(0.02), _lever(view)
        yield from travel(view, lever + [x, -0.09, 0.09], view.style.idle_gripper, tilt)
        yield view.go(lever + [x, -0.03, 0.09], CLOSED, tilt, tolerance=0.02)
        yield view.go(lever + [x, 0.005, 0.045], CLOSED, tilt, slow=0.9)
        for down in np.linspace(0.0, 0.11, 6):
            yield view.go(lever + [x, 0.005 - 0.55 * down, 0.03 - down], CLOSED, tilt, slow=0.8)
        yield view.go(view.tcp + [0, -0.08, 0.02], CLOSED, tilt, tolerance=0.03)
