"""Random start states in which a given task is feasible, for single-task episodes and demonstrations."""

import itertools

import numpy as np

from ..calvin import BULB, COLORS, DRAWER, LED, SLIDE, SWITCH, TASKS, Task, block_pose
from .desk import Desk
from .errors import DeskError
from .oracle import SURFACES, TABLE, has_stack
from .scenes import (
    BLOCK_LENGTHS,
    BLOCK_SIDE,
    BUTTON_Y,
    DRAWER_TRAVEL,
    DRAWER_Z,
    SWITCH_TRAVEL,
    TABLE_Z,
    Scene,
    beside_door,
    can_be_pushed,
)

_CLEARANCE = 0.10  # between block centres (m): no two blocks touch, and a hand fits between most of them
_TRIES = 200
_NEAR = 0.02  # how near IK must bring the TCP to a start pose, and how far settling may move a block (m)


def sample_start(desk: Desk, task: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random state of `desk` in which `task` is feasible, and not yet fulfilled.

    Joints and lights that do not matter to the task are random. Blocks lie in the scene's areas with yaw in
    pi/2 +- pi/8 (both as in CALVIN's benchmark). The TCP is anywhere in a box above the table. For `place_*` and
    `stack_block` a block is in the hand, for `unstack_block` one block stands on another.

    Args:
        desk: Used to solve inverse kinematics and to let the blocks settle; left in the returned state.
        task: One of `TASKS`.
        rng: The only source of randomness.

    Returns:
        `robot_obs` (15,) and `scene_obs` (24,), arguments for `Desk.reset`.

    Raises:
        DeskError: Unknown task, or no feasible state found.
    """
    if task not in TASKS:
        raise DeskError(f"task {task!r} is unknown; choose one of: {', '.join(TASKS)}")
    cameras, desk.cameras = desk.cameras, ()
    try:
        for _ in range(_TRIES):
            start = _try(desk, TASKS[task], rng)
            if start is not None:
                return start
    finally:
        desk.cameras = cameras
    raise DeskError(f"found no start state for task {task!r} in scene {desk.scene.name} in {_TRIES} tries")


def _try(desk: Desk, task: Task, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    furniture = _furniture(desk.scene, task, rng)
    held = _held_color(task, rng)
    poses = _blocks(desk.scene, task, held, furniture, rng)
    if poses is None:
        return None
    robot = _arm(desk, held is not None, rng)
    if robot is None:
        return None
    if held is not None:
        # between the fingers, long side across them
        poses[held] = np.array([*robot[:3], 0.0, 0.0, robot[5]])
    chosen = np.concatenate([furniture, *(poses[color] for color in COLORS)])
    obs = desk.reset(robot, chosen)
    for _ in range(4):
        obs = desk.step([*robot[:6], robot[14]], control_mode="abs")
    robot_obs, scene_obs = obs["robot_obs"].copy(), obs["scene_obs"].copy()
    if not _is_feasible(desk, task, held, chosen, scene_obs):
        return None
    desk.reset(robot_obs, scene_obs)
    return robot_obs, scene_obs


def _is_feasible(desk: Desk, task: Task, held: str | None, chosen: np.ndarray, settled: np.ndarray) -> bool:
    """Whether `task` is feasible after settling: `scene_obs` (24,) as it was `chosen`, and as it has `settled`."""
    snapshot = desk.snapshot()
    if snapshot.touched_by_robot != (frozenset() if held is None else {held}):
        return False
    if held is not None and snapshot.blocks[held].bodies != {"robot"}:
        return False
    if any(np.linalg.norm((settled - chosen)[block_pose(i)][:3]) > _NEAR for i in range(len(COLORS))):
        return False
    if task.color is not None:
        x = settled[block_pose(COLORS.index(task.color))][0]
        if task.kind == "push_block" and not can_be_pushed(task.side, x):
            return False
        if task.place == "slider" and not beside_door(desk.scene, settled[SLIDE], x):
            return False
        return snapshot.blocks[task.color].contacts == {SURFACES.get(task.place, TABLE)}
    if task.kind == "unstack_block":
        return has_stack(snapshot)
    compared = [SLIDE, DRAWER, SWITCH, BULB, LED]  # not the button, which may still be moving
    return bool(np.allclose(settled[compared], chosen[compared], atol=5e-3))


def _held_color(task: Task, rng: np.random.Generator) -> str | None:
    if task.kind in ("place_block", "stack_block"):
        return COLORS[rng.integers(3)]
    return None


def _furniture(scene: Scene, task: Task, rng: np.random.Generator) -> np.ndarray:
    """The first part of `scene_obs`, (6,); slide and drawer are at an end of their travel three times out of four."""
    bulb, led = (bool(rng.integers(2)) for _ in range(2))
    bulb = {"turn_on_lightbulb": False, "turn_off_lightbulb": True}.get(task.name, bulb)
    led = {"turn_on_led": False, "turn_off_led": True}.get(task.name, led)
    slide = _joint(rng, scene.slide_travel, 0.17, {"move_slider_left": 0, "move_slider_right": 1}.get(task.name))
    needed = {"open_drawer": 0, "close_drawer": 1}.get(task.name)
    drawer = _joint(rng, DRAWER_TRAVEL, 0.14, needed)
    if task.place == "drawer" or task.kind == "push_into_drawer":
        drawer = DRAWER_TRAVEL
    if task.place == "slider":
        slide = scene.slide_travel * rng.integers(2)
    return np.array([slide, drawer, 0.0, SWITCH_TRAVEL * bulb, float(bulb), float(led)])


def _joint(rng: np.random.Generator, travel: float, needed: float, end: int | None) -> float:
    """A joint value (m) at or near `end` (0 or 1, None: either), at least `needed` m from the other end."""
    end = int(rng.integers(2)) if end is None else end
    slack = (travel - needed) * rng.uniform() if rng.uniform() < 0.25 else 0.0
    return slack if end == 0 else travel - slack


def _blocks(
    scene: Scene, task: Task, held: str | None, furniture: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray] | None:
    """Colour to block pose (6,), or None if two blocks, or a block and the button, are too close together."""
    open_side = "slider_right" if furniture[SLIDE] > scene.slide_travel / 2 else "slider_left"
    places = {c: str(rng.choice(list(scene.areas))) for c in COLORS}
    if task.color is not None:
        places[task.color] = {"slider": open_side, "drawer": "drawer"}.get(str(task.place), "table")
    if task.kind == "push_into_drawer":
        pushed = COLORS[rng.integers(3)]
        places = {c: "drawer_edge" if c == pushed else str(rng.choice(list(scene.areas)[1:])) for c in COLORS}
    if task.kind == "stack_block":
        places[next(c for c in COLORS if c != held)] = "table"
    poses = {c: _on(scene, places[c], rng) for c in COLORS if c != held}
    if task.kind == "unstack_block":
        top, bottom = rng.permutation(COLORS)[:2]
        poses[bottom] = _on(scene, "table", rng)
        poses[top] = poses[bottom] + [0, 0, BLOCK_SIDE, 0, 0, 0]
        others = [poses[c] for c in COLORS if c != top]
    else:
        others = list(poses.values())
    if any(np.linalg.norm(a[:2] - b[:2]) < _CLEARANCE for a, b in itertools.combinations(others, 2)):
        return None
    longest = max(BLOCK_LENGTHS.values()) / 2
    button = scene.button_x, BUTTON_Y
    if any((np.abs(pose[:2] - button) < longest + 0.04).all() for pose in others):
        return None  # partly on the button's rim
    return poses


def _on(scene: Scene, place: str, rng: np.random.Generator) -> np.ndarray:
    """A block pose (6,) in the drawer, on the table close to it (`drawer_edge`), or in one of the scene's areas."""
    yaw = np.pi / 2 + rng.uniform(-np.pi / 8, np.pi / 8)
    if place == "drawer":
        xyz = [scene.drawer_x + rng.uniform(-0.11, 0.11), rng.uniform(-0.32, -0.25), DRAWER_Z]
    elif place == "drawer_edge":
        xyz = [scene.drawer_x + rng.uniform(-0.10, 0.10), rng.uniform(-0.12, -0.06), TABLE_Z]
    else:
        area = scene.areas[place]
        xyz = [rng.uniform(*area.x), rng.uniform(*area.y), TABLE_Z]
    return np.array([*xyz, 0.0, 0.0, yaw])


def _arm(desk: Desk, holding: bool, rng: np.random.Generator) -> np.ndarray | None:
    """`robot_obs` (15,) of a random pose above the table, gripper down, or None when the arm cannot reach it."""
    position = np.array([rng.uniform(-0.32, 0.38), rng.uniform(-0.36, -0.06), rng.uniform(0.51, 0.70)])
    euler = np.array([np.pi + rng.normal(0, 0.1), rng.normal(0, 0.1), np.pi / 2 + rng.uniform(-0.7, 0.7)])
    if holding:
        euler[:2] = np.pi, 0.0
    desk.reset(None, _away())
    joints = desk.solve_ik(position, euler)
    opened = bool(rng.uniform() < 0.7) and not holding
    width = 0.039 if holding else 0.08 if opened else 0.0
    robot = np.array([*position, *euler, width, *joints, 1.0 if opened else -1.0])
    reached = desk.reset(robot, _away())["robot_obs"]
    if np.linalg.norm(reached[:3] - position) > _NEAR:
        return None
    return np.array([*reached[:6], width, *joints, robot[14]])


def _away() -> np.ndarray:
    """A `scene_obs` (24,) whose blocks are out of the arm's reach."""
    return np.array([0.0] * 6 + [v for i in range(3) for v in (3.0 + i, 3.0, 0.02, 0.0, 0.0, 0.0)])
