"""CALVIN's facts, each in one place: units, layouts, cameras, tasks. Needs numpy only.

Everything else in this package and in `dataset_convert` takes them from here. They were read from calvin_env, the
original simulator, and from the files that it recorded.

    robot_obs (15,)   TCP xyz (m), TCP euler xyz (rad), opening width (m), 7 arm joints (rad), gripper command
    scene_obs (24,)   slide, drawer, button, switch (m), bulb, LED (0/1), then xyz (m) and euler xyz (rad) per block
    actions (7,)      TCP xyz (m), TCP euler xyz (rad), gripper command: the pose to go to
    rel_actions (7,)  the same as a difference to the TCP's pose, in units of 0.02 m and 0.05 rad, clipped to +-1

A gripper command is -1 (close) or +1 (open). Blocks come in red, blue, pink order everywhere in this package; CALVIN's
own files have them in `BLOCK_ORDER`.
"""

from dataclasses import dataclass

import numpy as np

CONTROL_HZ = 30
"""Control steps, and recorded frames, per second."""

STEPS_PER_COMMAND = 360
"""Control steps that a command may take in CALVIN's evaluation."""

CHAIN_LENGTH = 5
"""Commands in a chain of the long-horizon benchmark (LH-MTLC)."""

WINDOW_FRAMES = 64
"""Frames in a language window of CALVIN's data at most."""

# ---- scenes and blocks

COLORS = ("red", "blue", "pink")
"""The blocks, in the order in which this package writes them into `scene_obs`."""

BLOCK_ORDER = {
    "A": ("pink", "blue", "red"),
    "B": ("red", "blue", "pink"),
    "C": ("blue", "red", "pink"),
    "D": ("red", "blue", "pink"),
}
"""Scene to the order in which CALVIN loads its blocks and writes them into `scene_obs`: that of each scene's
configuration file, although CALVIN's documentation says red, blue, pink."""

SCENE_NAMES = tuple(BLOCK_ORDER)

SLIDE_TRAVEL = {"A": 0.28, "B": 0.304, "C": 0.24, "D": 0.28}
"""Scene to the position (m) at which its sliding door stops, fully open; it begins at 0."""

# ---- robot_obs and scene_obs

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")

ROBOT_OBS_NAMES = (
    *(f"tcp_{axis}" for axis in _POSE),
    "gripper_width",
    *(f"joint_{number}" for number in range(1, 8)),
    "gripper_action",
)
FURNITURE_NAMES = ("slider", "drawer", "button", "switch", "lightbulb", "led")
SCENE_OBS_NAMES = (*FURNITURE_NAMES, *(f"{color}_block_{axis}" for color in COLORS for axis in _POSE))

TCP_POSE = slice(0, 6)
"""TCP xyz (m) and euler xyz (rad) in `robot_obs`, and the pose in an absolute action."""
GRIPPER_WIDTH = 6
ARM_JOINTS = slice(7, 14)
GRIPPER_ACTION = 14

SLIDE, DRAWER, BUTTON, SWITCH, BULB, LED = range(6)
FURNITURE = slice(0, 6)
"""Joints (m) and lights (0/1) in `scene_obs`, in the order of `FURNITURE_NAMES`."""
BLOCKS = slice(6, 24)


def block_pose(index: int) -> slice:
    """Where `scene_obs` holds xyz (m) and euler xyz (rad) of its `index`-th block."""
    return slice(6 + 6 * index, 12 + 6 * index)


def block_columns(order: tuple[str, ...]) -> list[int]:
    """Columns that bring a `scene_obs` with blocks in red, blue, pink order into `order`: (24,)."""
    columns = list(range(24))
    return [*columns[FURNITURE], *(c for color in order for c in columns[block_pose(COLORS.index(color))])]


# ---- actions

CONTROL_MODES = ("rel", "abs")
"""Relative and absolute actions; the environment's observation `control_mode` is a place in this tuple."""

ACTION_NAMES = {"rel": (*(f"delta_{axis}" for axis in _POSE), "gripper"), "abs": (*_POSE, "gripper")}
"""Control mode to the names of an action's 7 numbers, by which datasets say what their actions are."""

POSITION_UNIT = 0.02
"""Metres that 1 in a relative action stands for."""
ANGLE_UNIT = 0.05
"""Radians that 1 in a relative action stands for."""
POSE_UNITS = np.array([POSITION_UNIT] * 3 + [ANGLE_UNIT] * 3)
"""Both of them for a pose's 6 numbers."""
POSE_UNITS.flags.writeable = False


def wrap_angle[Angles](angle: Angles) -> Angles:
    """Angles (rad) brought into [-pi, pi): the one convention of this package. A number, an array or a tensor."""
    return (angle + np.pi) % (2 * np.pi) - np.pi  # type: ignore[operator, return-value]


HOME_EULER = np.array([np.pi, 0.0, np.pi / 2])
"""Euler angles (rad) of a hand at rest: it points down, and the gripper camera looks at the cabinet."""
HOME_EULER.flags.writeable = False


def continuous_euler(euler: np.ndarray) -> np.ndarray:
    """Euler angles (..., 3) within half a turn of `HOME_EULER`: roll in [0, 2 pi), pitch in [-pi, pi), yaw in
    [-pi/2, 3 pi/2).

    CALVIN's own angles jump from pi to -pi, and the roll of a hand that points down lies exactly there. Datasets
    written here and the environment's observation have these angles instead, in states and in absolute actions alike,
    so that no pose that the arm reaches jumps. Angles that need no change keep every bit.
    """
    turns = np.floor((euler - (HOME_EULER - np.pi)) / (2 * np.pi))
    return (euler - 2 * np.pi * turns).astype(euler.dtype)


def relative_action(action: np.ndarray, robot_obs: np.ndarray) -> np.ndarray:
    """The relative form of absolute actions, as the simulator defines it.

    Args:
        action: (..., 7) absolute.
        robot_obs: (..., 15) the state that each is taken in.

    Returns:
        (..., 7): differences to the TCP's pose, angles the short way round, in `POSE_UNITS`, clipped to +-1;
        the gripper command unchanged.
    """
    position = (action[..., :3] - robot_obs[..., :3]) / POSITION_UNIT
    rotation = wrap_angle(action[..., 3:6] - robot_obs[..., 3:6]) / ANGLE_UNIT
    return np.concatenate([np.clip(position, -1, 1), np.clip(rotation, -1, 1), action[..., 6:]], axis=-1)


# ---- cameras

CAMERAS = {"static": 200, "gripper": 84}
"""Camera to the width and height of its pictures, in pixels."""

# ---- tasks


@dataclass(frozen=True)
class Task:
    """One of CALVIN's 34 tasks.

    Attributes:
        name: CALVIN's name.
        kind: What it is an instance of: its name without colour, side and place.
        color: The block that it names.
        side: `"left"` or `"right"`.
        place: `"table"`, `"slider"` or `"drawer"`: where a block is lifted from or placed.
    """

    name: str
    kind: str
    color: str | None = None
    side: str | None = None
    place: str | None = None


def _tasks() -> list[Task]:
    sides, places = ("right", "left"), ("table", "slider", "drawer")
    return [
        *(Task(f"rotate_{c}_block_{side}", "rotate_block", c, side) for c in COLORS for side in sides),
        *(Task(f"push_{c}_block_{side}", "push_block", c, side) for c in COLORS for side in sides),
        *(Task(f"move_slider_{side}", "move_slider", side=side) for side in ("left", "right")),
        *(Task(name, name) for name in ("open_drawer", "close_drawer")),
        *(Task(f"lift_{c}_block_{place}", "lift_block", c, place=place) for c in COLORS for place in places),
        *(Task(f"place_in_{place}", "place_block", place=place) for place in ("slider", "drawer")),
        *(Task(name, name) for name in ("stack_block", "unstack_block")),
        *(Task(f"turn_{on}_lightbulb", f"turn_{on}_lightbulb") for on in ("on", "off")),
        *(Task(f"turn_{on}_led", f"turn_{on}_led") for on in ("on", "off")),
        Task("push_into_drawer", "push_into_drawer"),
    ]


TASKS: dict[str, Task] = {task.name: task for task in _tasks()}
"""The 34 tasks by name; a task's number in a dataset is its place here."""


def _task_groups() -> dict[str, tuple[str, ...]]:
    kinds = {
        "rotate": ("rotate_block",),
        "push": ("push_block", "push_into_drawer"),
        "slider": ("move_slider",),
        "drawer": ("open_drawer", "close_drawer"),
        "lift": ("lift_block",),
        "place": ("place_block",),
        "stack": ("stack_block", "unstack_block"),
        "lights": ("turn_on_lightbulb", "turn_off_lightbulb", "turn_on_led", "turn_off_led"),
    }
    return {group: tuple(t.name for t in TASKS.values() if t.kind in kinds[group]) for group in kinds}


TASK_GROUPS: dict[str, tuple[str, ...]] = _task_groups()
"""Names for several tasks at once; each of the 34 is in one group. A task's number in LeRobot's results is its place
in its group."""
