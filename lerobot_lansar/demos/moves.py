"""What skills are built from: waypoints, a skill's view of the desk, and the few moves that all skills share.

Positions in metres in the world frame, angles in radians. A hand that points straight down has euler (pi, 0, yaw);
`pointing` gives the euler angles of a leaning hand.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..calvin import COLORS, DRAWER, GRIPPER_ACTION, GRIPPER_WIDTH, SLIDE, TCP_POSE, block_pose
from ..desk.robot import BASE_POSITION
from ..desk.scenes import BLOCK_LENGTHS, BLOCK_SIDE, TABLE_Z, Scene

OPEN, CLOSED = 1.0, -1.0
FORWARD = np.pi / 2
"""Yaw (rad) of a hand at rest: the gripper camera looks at the cabinet."""
YAWS = (FORWARD - 2.0, FORWARD + 2.5)
"""Range of yaws (rad) that the arm reaches everywhere over the table; its last joint turns no further."""
INTO_CABINET = 0.5
"""How far (rad) a hand leans forward to reach past the cabinet's lid and door."""
TABLE_FRONT = -0.18
"""y of the table's front edge (m), from under which the drawer comes out."""
TRIES = 4
"""How often a skill starts over before it gives up."""
FALLEN = 0.30
"""A block whose centre is below this height (m) has fallen off the desk."""

Skill = Callable[["View"], Iterator["Waypoint"]]


@dataclass(frozen=True)
class Waypoint:
    """Where the TCP goes next.

    Attributes:
        position: (3,) m.
        euler: (3,) rad.
        gripper: -1 closed, +1 open.
        slow: Fraction of the episode's speed; below 1 while touching things.
        tolerance: Distance (m) at which the hand counts as arrived.
        hold: Control steps to stay after arriving.
        keep: Called at every step; once it returns False, the waypoint is given up and the skill looks at the desk
            again.
    """

    position: np.ndarray
    euler: np.ndarray
    gripper: float
    slow: float = 1.0
    tolerance: float = 0.012
    hold: int = 0
    keep: Callable[[], bool] | None = None

    @property
    def careful(self) -> bool:
        """Whether the hand is reaching for something, touching it, or opening or closing around it."""
        return self.slow < 1 or self.hold > 0


@dataclass(frozen=True)
class Style:
    """How a demonstrator moves in one episode.

    Attributes:
        speed: Fraction of the top speed, 0.0095 m per control step and 0.024 rad.
        cruise: Height (m) of the TCP while it travels over the table.
        yaw: Deviation (rad) of the hand's yaw where any yaw will do.
        idle_gripper: Open or closed while the hand travels and either will do.
        pauses: Probability of waiting up to 8 steps at a waypoint.
        spread: How far contact points and approach heights scatter, 0 to 1.
    """

    speed: float = 0.9
    cruise: float = 0.58
    yaw: float = 0.0
    idle_gripper: float = CLOSED
    pauses: float = 0.0
    spread: float = 0.0

    @classmethod
    def sample(cls, rng: np.random.Generator, variety: float) -> "Style":
        """A random style; `variety` from 0 (always the same) to 1."""
        return cls(
            speed=0.9 + variety * rng.uniform(-0.25, 0.1),
            cruise=0.58 + variety * rng.uniform(-0.01, 0.06),
            yaw=variety * rng.uniform(-0.2, 0.2),
            idle_gripper=CLOSED if rng.uniform() < 1 - 0.5 * variety else OPEN,
            pauses=0.08 * variety,
            spread=variety,
        )


@dataclass
class View:
    """What a skill sees: the scene's geometry, the latest `robot_obs` (15,) and `scene_obs` (24,), and the observation
    when the command began (None: the present one)."""

    scene: Scene
    robot_obs: np.ndarray
    scene_obs: np.ndarray
    rng: np.random.Generator
    style: Style = field(default_factory=Style)
    begun: Mapping[str, np.ndarray] | None = None

    def __post_init__(self) -> None:
        if self.begun is None:
            self.begun = {"robot_obs": self.robot_obs, "scene_obs": self.scene_obs}

    @property
    def start(self) -> "View":
        """The same as it was when the command began."""
        assert self.begun is not None
        return replace(self, robot_obs=self.begun["robot_obs"], scene_obs=self.begun["scene_obs"])

    @property
    def tcp(self) -> np.ndarray:
        """TCP position, (3,) m."""
        return self.robot_obs[TCP_POSE][:3]

    @property
    def euler(self) -> np.ndarray:
        """TCP euler angles, (3,) rad."""
        return self.robot_obs[TCP_POSE][3:].copy()

    @property
    def yaw(self) -> float:
        """The hand's yaw (rad), in the interval of `turned`."""
        return turned(self.euler[2])

    @property
    def slide(self) -> float:
        """Position of the cabinet's door (m): it moves to -x as this grows."""
        return float(self.scene_obs[SLIDE])

    @property
    def drawer(self) -> float:
        """How far the drawer is open (m)."""
        return float(self.scene_obs[DRAWER])

    def block(self, color: str) -> np.ndarray:
        """Pose of a block: xyz (m), euler (rad); (6,)."""
        return self.scene_obs[block_pose(COLORS.index(color))]

    def length(self, color: str) -> float:
        """A block's longest side (m)."""
        return BLOCK_LENGTHS[self.scene.blocks[color]]

    def others(self, color: str) -> list[np.ndarray]:
        """Poses of the other blocks."""
        return [self.block(other) for other in COLORS if other != color]

    def holds(self, color: str) -> bool:
        """Whether the closed hand has the block between its fingers."""
        return color == self.held()

    def lost(self, color: str) -> bool:
        """Whether the block fell off the desk."""
        return bool(self.block(color)[2] < FALLEN)

    def lies_on(self, upper: str, lower: str, height: float = np.inf) -> bool:
        """Whether a block's centre is above another's: by 0.03 m to `height` (m), and less than 0.05 m to the side.

        A height of 0.07 admits the block directly on top, however both lie; 0.09 admits the one on that block too.
        """
        way = self.block(upper)[:3] - self.block(lower)[:3]
        return bool(0.03 < way[2] < height and np.linalg.norm(way[:2]) < 0.05)

    def held(self) -> str | None:
        """The block between the fingers of the closed hand, if any: the nearest one."""
        away = {color: float(np.linalg.norm(self.block(color)[:3] - self.tcp)) for color in COLORS}
        nearest = min(COLORS, key=away.__getitem__)
        closed = self.robot_obs[GRIPPER_ACTION] < 0 and self.robot_obs[GRIPPER_WIDTH] > 0.02
        return nearest if closed and away[nearest] < 0.045 else None

    def scatter(self, spread: float) -> float:
        """A random number within +-`spread` (m or rad), scaled by the style's own spread."""
        return float(self.rng.uniform(-spread, spread) * self.style.spread)

    def go(
        self,
        position: np.ndarray | tuple[float, float, float],
        gripper: float = CLOSED,
        euler: np.ndarray | None = None,
        **options: float | Callable[[], bool] | None,
    ) -> Waypoint:
        """A waypoint; without `euler` the hand points down, and leans outward where the arm has to stretch."""
        xyz = np.asarray(position, float)
        if euler is None:
            euler = pointing(FORWARD + self.style.yaw, *stretch(xyz))
        return Waypoint(xyz, euler, gripper, **options)  # type: ignore[arg-type]


def pointing(yaw: float, lean_x: float = 0.0, lean_y: float = 0.0) -> np.ndarray:
    """Euler angles (3,) of a hand that points down with `yaw` and then leans outward by (lean_x, lean_y) rad."""
    down = Rotation.from_euler("xyz", [np.pi, 0.0, yaw])
    return (Rotation.from_rotvec([lean_y, -lean_x, 0.0]) * down).as_euler("xyz")


def approach(euler: np.ndarray) -> np.ndarray:
    """The direction in which the fingers point, (3,)."""
    return Rotation.from_euler("xyz", euler).apply([0.0, 0.0, 1.0])


def stretch(position: np.ndarray) -> np.ndarray:
    """How far (rad, along x and y) the hand must lean outward for the arm to reach a point at table height.

    With the hand straight down the arm reaches 0.76 m from its base; with the hand leaning by 0.55 rad, 0.88 m.
    """
    way = position[:2] - np.array(BASE_POSITION[:2])
    distance = float(np.linalg.norm(way))
    return way / distance * np.clip((distance - 0.74) / 0.12, 0, 1) * 0.5


def turned(yaw: float) -> float:
    """The same yaw in [FORWARD - 2.2, FORWARD + 4.1), which the last joint passes through without turning back."""
    return float((yaw - FORWARD + 2.2) % (2 * np.pi) - 2.2 + FORWARD)


def in_cabinet(position: np.ndarray) -> bool:
    """Whether a TCP at this position is inside the cabinet."""
    return bool(position[1] > -0.02 and position[2] < 0.64)


def retreat(view: View, gripper: float, keep: Callable[[], bool] | None = None) -> Iterator[Waypoint]:
    """Out of the cabinet the way the fingers came in, or up from anything low."""
    options = {"tolerance": 0.03, "keep": keep}
    if in_cabinet(view.tcp):
        back = view.tcp - 0.12 * approach(view.euler)
        yield view.go(back, gripper, view.euler, **options)
        yield view.go((view.tcp[0], -0.10, max(view.tcp[2], 0.60)), gripper, view.euler, **options)
    elif view.tcp[2] < view.style.cruise - 0.03:
        above = (view.tcp[0], min(view.tcp[1], -0.05), view.style.cruise)
        yield view.go(above, gripper, view.euler, **options)


def travel(
    view: View,
    position: np.ndarray | tuple[float, float, float],
    gripper: float,
    euler: np.ndarray | None = None,
    keep: Callable[[], bool] | None = None,
) -> Iterator[Waypoint]:
    """Travels over everything to above `position`; ends at cruising height, or at `position` if that is higher."""
    x, y, z = position
    if in_cabinet(view.tcp) and y > -0.02 and abs(view.tcp[0] - x) < 0.08:
        return
    if np.linalg.norm(view.tcp[:2] - [x, y]) > 0.04 or in_cabinet(view.tcp):
        yield from retreat(view, gripper, keep)
        yield view.go((x, y, max(z, view.style.cruise)), gripper, euler, tolerance=0.03, keep=keep)


def under_way(view: View, start: np.ndarray, end: np.ndarray, euler: np.ndarray, gripper: float) -> bool:
    """Whether the hand is already on the straight way from `start` to `end`, (3,) each, and need not go to `start`.

    That is within 0.012 m and 0.15 rad, and with the hand open or closed as commanded by `gripper`.
    """
    way = end - start
    along = np.clip((view.tcp - start) @ way / (way @ way), 0.0, 1.0)
    aside = np.linalg.norm(view.tcp - start - along * way)
    turn = (Rotation.from_euler("xyz", view.euler).inv() * Rotation.from_euler("xyz", euler)).magnitude()
    opened = view.robot_obs[GRIPPER_WIDTH] > 0.07 if gripper > 0 else view.robot_obs[GRIPPER_WIDTH] < 0.01
    return bool(aside < 0.012 and turn < 0.15 and opened)


def lying(pose: np.ndarray) -> tuple[float, bool]:
    """Yaw (rad) of a block's long axis, and whether that axis is horizontal; of another axis if it is not."""
    axes = Rotation.from_euler("xyz", pose[3:]).as_matrix()
    horizontal = bool(abs(axes[2, 0]) < 0.7)
    axis = axes[:, 0] if horizontal else axes[:, 1]
    return float(np.arctan2(axis[1], axis[0])), horizontal


def on_table(pose: np.ndarray) -> bool:
    """Whether a block lies on the table top in front of the cabinet."""
    return bool(abs(pose[2] - TABLE_Z) < 0.035 and -0.20 < pose[1] < 0.02)


def half_width(view: View, color: str, direction: np.ndarray) -> float:
    """Half of a lying block's extent along a horizontal direction (m)."""
    yaw, horizontal = lying(view.block(color))
    length = view.length(color) if horizontal else BLOCK_SIDE
    along = abs(np.cos(yaw) * direction[0] + np.sin(yaw) * direction[1])
    across = abs(-np.sin(yaw) * direction[0] + np.cos(yaw) * direction[1])
    return float(length * along + BLOCK_SIDE * across) / 2


def half_height(view: View, color: str, turn: Rotation | None = None) -> float:
    """Half of a block's vertical extent (m), after turning it by `turn`."""
    orientation = Rotation.from_euler("xyz", view.block(color)[3:])
    axes = (orientation if turn is None else turn * orientation).as_matrix()
    return float(np.abs(axes[2]) @ [view.length(color), BLOCK_SIDE, BLOCK_SIDE]) / 2


def _finger_meets(other: np.ndarray, pose: np.ndarray, yaw: float) -> bool:
    """Whether an open finger of a hand with that yaw, around the block at `pose`, would come down on another block."""
    if abs(other[2] - pose[2]) > 0.03:
        return False
    apart = 0.05 * np.array([np.sin(yaw), -np.cos(yaw)])
    reach = BLOCK_SIDE / 2 + 0.015
    return any(bool(np.linalg.norm(other[:2] - pose[:2] - side * apart) < reach) for side in (1, -1))


def grasp_yaws(view: View, color: str) -> list[float]:
    """Yaws (rad) at which the fingers can close on a block, the most convenient first; only those in `YAWS`.

    The fingers fit over sides of up to 0.056 m.
    """
    pose = view.block(color)
    yaw, horizontal = lying(pose)
    only_short = horizontal and view.length(color) > 0.06
    yaws = {turned(yaw + k * np.pi / 2) for k in range(4) if k % 2 == 0 or not only_short}
    now = view.yaw

    def inconvenience(candidate: float) -> float:
        # the hand is 0.2 m wide across its fingers: near the cabinet it must stay parallel to it
        sideways = abs(np.sin(candidate - FORWARD)) * (3.0 if pose[1] > -0.10 else 0.5)
        long_side = 0.5 * (horizontal and abs(np.sin(candidate - yaw)) > 0.5 and view.length(color) > BLOCK_SIDE)
        blocked = 2.0 * any(_finger_meets(other, pose, candidate) for other in view.others(color))
        return abs(candidate - now) + sideways + long_side + blocked

    return sorted((y for y in yaws if YAWS[0] <= y <= YAWS[1]), key=inconvenience)
