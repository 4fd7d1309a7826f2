"""How a hand does each task: generators of waypoints that look at the desk's present state before each one.

Positions in metres in the world frame, angles in radians. "Down" is euler (pi, 0, yaw). Distances come from the desk's
measured geometry: handle and lever sizes, button height, block sizes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from ..desk import COLORS
from ..desk.scenes import BLOCK_LENGTHS, BUTTON_TRAVEL, Scene

OPEN, CLOSED = 1.0, -1.0
ABOVE = 0.58
"""A height (m) at which the hand passes over everything on the table."""
HANDLE_Z = 0.365
"""Height (m) at which the hand pulls and pushes the drawer's handle."""


@dataclass(frozen=True)
class Waypoint:
    """Where the TCP goes next.

    Attributes:
        position: (3,) m.
        euler: (3,) rad.
        gripper: -1 closed, +1 open.
        slow: Fraction of the episode's speed: under 1 while touching things.
        tolerance: How near counts as there (m).
        hold: Control steps to stay after arriving.
    """

    position: np.ndarray
    euler: np.ndarray
    gripper: float
    slow: float = 1.0
    tolerance: float = 0.012
    hold: int = 0


@dataclass
class View:
    """What a skill sees: the scene's fixed numbers and the latest ``robot_obs`` (15,) and ``scene_obs`` (24,)."""

    scene: Scene
    robot_obs: np.ndarray
    scene_obs: np.ndarray
    rng: np.random.Generator
    yaw: float = field(init=False)

    def __post_init__(self) -> None:
        self.yaw = np.pi / 2 + self.rng.uniform(-0.12, 0.12)

    def block(self, color: str) -> np.ndarray:
        """Pose of a block: xyz (m), euler (rad); (6,)."""
        index = 6 + 6 * COLORS.index(color)
        return self.scene_obs[index : index + 6]

    def go(
        self,
        x: float,
        y: float,
        z: float,
        gripper: float = CLOSED,
        euler: np.ndarray | None = None,
        **options: float,
    ) -> Waypoint:
        """A waypoint, gripper down unless ``euler`` says otherwise."""
        if euler is None:
            euler = np.array([np.pi, 0.0, self.yaw])
        return Waypoint(np.array([x, y, z]), euler, gripper, **options)  # type: ignore[arg-type]


Skill = Callable[[View], Iterator[Waypoint]]


def open_drawer(view: View) -> Iterator[Waypoint]:
    """Reach behind the handle's bar from above and pull; pull again if the drawer stopped short."""
    x = view.scene.drawer_x + view.rng.uniform(-0.05, 0.05)
    for _ in range(3):
        gap = -0.211 - view.scene_obs[1]
        yield view.go(x, gap, 0.52 + view.rng.uniform(0, 0.04), tolerance=0.015)
        yield view.go(x, gap, HANDLE_Z, slow=0.8, tolerance=0.01)
        yield view.go(x, gap - 0.24, HANDLE_Z, slow=0.7)


def close_drawer(view: View) -> Iterator[Waypoint]:
    """Go in front of the handle's bar and push."""
    x = view.scene.drawer_x + view.rng.uniform(-0.06, 0.06)
    for _ in range(3):
        front = -0.2612 - view.scene_obs[1]
        yield view.go(x, front - 0.05, 0.50 + view.rng.uniform(0, 0.04), tolerance=0.02)
        yield view.go(x, front - 0.05, HANDLE_Z, slow=0.9, tolerance=0.015)
        yield view.go(x, -0.2612 + 0.03, HANDLE_Z, slow=0.7)


def press_button(view: View) -> Iterator[Waypoint]:
    """Press the LED's button from above; let go and press again if the light did not change."""
    x, y = view.scene.button_x + view.rng.uniform(-0.01, 0.01), -0.12 + view.rng.uniform(-0.01, 0.01)
    for _ in range(4):
        yield view.go(x, y, 0.55 + view.rng.uniform(-0.01, 0.02), tolerance=0.015)
        yield view.go(x, y, 0.483 - BUTTON_TRAVEL, slow=0.7, tolerance=0.006)
        yield view.go(x, y, 0.54)


def _slide(direction: float) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        for _ in range(3):
            # the handle is 0.042 m wide around this x and moves to -x as the joint grows
            handle = view.scene.slide_x + 0.14 - view.scene_obs[0]
            beside = handle - direction * (0.021 + 0.045 + view.rng.uniform(0, 0.01))
            end = view.scene.slide_x + 0.14 - (view.scene.slide_travel if direction < 0 else 0.0)
            yield view.go(beside, -0.06, 0.58, tolerance=0.02)
            yield view.go(beside, -0.012, 0.53, slow=0.9)
            yield view.go(end + direction * 0.05, -0.012, 0.53, slow=0.8)

    return skill


def _lever(view: View) -> np.ndarray:
    """Middle of the switch's bar, (3,) m: it slides up the cabinet's front, which leans back by 30 degrees."""
    travel = view.scene_obs[3]
    return np.array([view.scene.switch_x, 0.019 + 0.5 * travel, 0.528 + 0.866 * travel])


def _reaching(view: View) -> np.ndarray:
    """Fingers forward and outward: how the arm reaches the lever, which a hand pointing straight down does not."""
    return np.array([np.pi - 0.5 * np.sign(view.scene.switch_x), -0.6, np.pi / 2])


def turn_on_lightbulb(view: View) -> Iterator[Waypoint]:
    """Reach under the lever with a tilted hand and push it up along the cabinet's front."""
    x, tilt = view.rng.uniform(-0.02, 0.02), _reaching(view)
    for _ in range(3):
        lever = _lever(view)
        yield view.go(lever[0] + x, lever[1] - 0.08, lever[2] - 0.02, euler=tilt, tolerance=0.02)
        yield view.go(lever[0] + x, lever[1] - 0.01, lever[2] - 0.035, euler=tilt, slow=0.9)
        for up in np.linspace(0.0, 0.12, 6):
            yield view.go(lever[0] + x, lever[1] + 0.55 * up, lever[2] - 0.03 + up, euler=tilt, slow=0.8)


def turn_off_lightbulb(view: View) -> Iterator[Waypoint]:
    """Reach over the lever with a tilted hand and press it down along the cabinet's front."""
    x, tilt = view.rng.uniform(-0.02, 0.02), _reaching(view)
    for _ in range(3):
        lever = _lever(view)
        yield view.go(lever[0] + x, lever[1] - 0.03, lever[2] + 0.09, euler=tilt, tolerance=0.02)
        yield view.go(lever[0] + x, lever[1] + 0.005, lever[2] + 0.045, euler=tilt, slow=0.9)
        for down in np.linspace(0.0, 0.11, 6):
            yield view.go(
                lever[0] + x, lever[1] + 0.005 - 0.55 * down, lever[2] + 0.03 - down, euler=tilt, slow=0.8
            )


def _lift_from_table(color: str) -> Skill:
    def skill(view: View) -> Iterator[Waypoint]:
        for _ in range(4):
            x, y, z = view.block(color)[:3]
            grasp = np.array([np.pi, 0.0, _across(view, color)])
            yield view.go(x, y, z + 0.07 + view.rng.uniform(0, 0.02), OPEN, grasp, tolerance=0.01)
            x, y, z = view.block(color)[:3]
            yield view.go(x, y, z + 0.002, OPEN, grasp, slow=0.8, tolerance=0.007)
            yield view.go(x, y, z + 0.002, CLOSED, grasp, hold=5)
            yield view.go(x, y, z + 0.14, CLOSED, grasp, slow=0.8)

    return skill


def _across(view: View, color: str) -> float:
    """The hand's yaw that closes the fingers on the block's short sides, nearest to the hand's present yaw."""
    yaw, now = view.block(color)[5], view.robot_obs[5]
    period = np.pi / 2 if view.scene.blocks[color] == "small" else np.pi
    assert BLOCK_LENGTHS["small"] < BLOCK_LENGTHS["middle"]
    return float(yaw + period * np.round((now - yaw) / period))


SKILLS: dict[str, Skill] = {
    "open_drawer": open_drawer,
    "close_drawer": close_drawer,
    "move_slider_left": _slide(-1.0),
    "move_slider_right": _slide(1.0),
    "turn_on_lightbulb": turn_on_lightbulb,
    "turn_off_lightbulb": turn_off_lightbulb,
    "turn_on_led": press_button,
    "turn_off_led": press_button,
    **{f"lift_{color}_block_table": _lift_from_table(color) for color in COLORS},
}
"""The tasks that can be demonstrated, and how."""
