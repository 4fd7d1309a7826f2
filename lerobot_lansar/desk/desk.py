"""The CALVIN desk: a Panda in front of a piece of furniture, simulated by PyBullet."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as p

from ..calvin import CAMERAS, COLORS, FURNITURE, block_pose
from ..cameras import Camera, gripper_camera_pose, intrinsics, static_camera_pose
from .assets import Assets, find_assets
from .cameras import INTRINSICS, gripper_view, static_view
from .errors import DeskError, SimulationError
from .furniture import Furniture, load_blocks
from .oracle import BlockState, Snapshot, Touch, completed_tasks
from .render import RENDERERS, Renderer, load_egl, open_renderer
from .robot import Robot
from .scenes import TABLE_Z, Scene, get_scene

SUBSTEPS = 8
"""Simulation steps of 1/240 s per control step of 1/30 s."""

_LARGEST_STATE = 1e9  # of a finite state (m, rad): policies read float32 and square it
MAX_MAGNITUDE = 100.0
"""Largest absolute value accepted in an action or state."""

Observation = dict[str, np.ndarray]

_PARKING = 100.0  # where blocks wait while contact caches are cleared (m)


@dataclass(frozen=True)
class SavedState:
    """A resumable state: the reset state and all actions since. It can be pickled."""

    scene: str
    assets: str
    robot_obs: np.ndarray | None
    scene_obs: np.ndarray
    continued: bool
    actions: tuple[tuple[np.ndarray, str], ...]


class Desk:
    """One simulated desk in a Bullet client of its own.

    `robot_obs` (15,) float64 is CALVIN's: TCP xyz (m), TCP euler xyz (rad), gripper opening width (m), seven arm
    joints (rad), last gripper action (-1 close, +1 open). `scene_obs` (24,) float64: slide, drawer, button, switch
    joints (m), light bulb, LED (0/1), then xyz (m) and euler xyz (rad) of the red, the blue and the pink block. Blocks
    have this order in every scene; in CALVIN's own files the order depends on the scene.

    Args:
        scene: `"A"`, `"B"`, `"C"`, `"D"`, or `"D_eval"`: D with calvin_env's fixed evaluation layout.
        assets: None for the built-in desk, or the `data` folder of a calvin_env checkout for the original files.
        cameras: Cameras whose pictures observations hold: any of `"static"` (200x200) and `"gripper"` (84x84).
        renderer: `"gl"` (ours, with the look of CALVIN's public data), `"tiny"` (ours, with TinyRenderer's look),
            `"pybullet_gl"` or `"pybullet_tiny"` (PyBullet's own). It is set up when the first picture is drawn.
        depth: Whether observations also hold `depth_<camera>`.

    Attributes:
        scene: The scene's numbers.
        assets: `"built-in"` or `"original"`.

    Raises:
        DeskError: Unknown scene, camera or renderer, missing asset files, no driver for `pybullet_gl`.
    """

    def __init__(
        self,
        scene: str = "D",
        assets: str | Path | None = None,
        cameras: Sequence[str] = ("static", "gripper"),
        renderer: str = "gl",
        depth: bool = False,
    ):
        _check_cameras(cameras)
        if renderer not in RENDERERS:
            raise DeskError(f"renderer {renderer!r} is unknown; choose among {', '.join(RENDERERS)}")
        self.scene: Scene = get_scene(scene)
        self.cameras = tuple(cameras)
        self.renderer = renderer
        self.depth = depth
        self._assets_folder = assets
        self._actions: list[tuple[np.ndarray, str]] = []
        self._client = -1
        self._open()
        try:
            self.reset()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        """Starts a Bullet client and loads all bodies."""
        self._renderer: Renderer | None = None
        self._diverged = False
        files = find_assets(self.scene, self._assets_folder)
        self.assets = files.kind
        self._client = p.connect(p.DIRECT)
        self._require_open()
        try:
            self._load(files)
        except BaseException:
            self.close()
            raise

    def _load(self, files: Assets) -> None:
        client = self._client
        self._egl_plugin = (
            load_egl(client) if self.renderer == "pybullet_gl" else None
        )  # it draws only what is loaded later
        p.setGravity(0, 0, -9.8, physicsClientId=client)
        self._robot = Robot(client, files)
        self._blocks = load_blocks(client, files, self.scene)
        self._furniture = Furniture(client, files)
        plane = p.loadURDF(str(files.plane), physicsClientId=client)
        # only after loading: before, it has no effect and the motion depends on how the bodies were loaded
        p.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        self._names = {self._robot.body: "robot", self._furniture.body: "desk", plane: "plane"}
        self._names |= {block.body: color for color, block in self._blocks.items()}
        self._desk_links = {index: name for name, index in self._furniture.links.items()}

    # ---- public

    def reset(
        self,
        robot_obs: Sequence[float] | np.ndarray | None = None,
        scene_obs: Sequence[float] | np.ndarray | None = None,
        seed: int | None = 0,
        continued: bool = False,
    ) -> Observation:
        """Puts the desk into a state; nothing that happened before has any influence.

        Args:
            robot_obs: (15,), of which joints, opening width and gripper action are used; None: CALVIN's home pose,
                hand open.
            scene_obs: (24,) with blocks in red, blue, pink order; None: everything closed and off, blocks at random
                as in CALVIN, or where the scene's layout puts them.
            seed: Determines the blocks' random poses; None: different ones every time.
            continued: The state is from the middle of an episode, so a button that is down has already toggled the
                LED. Otherwise it does so in the first step, as in CALVIN.

        Returns:
            The observation after one simulation step, as in CALVIN.

        Raises:
            DeskError: A state has the wrong shape, or a value that is not finite or exceeds `MAX_MAGNITUDE`.
        """
        self._require_open()
        robot_state = None if robot_obs is None else _vector(robot_obs, 15, "robot_obs")
        scene_state = self._random_scene(seed) if scene_obs is None else _vector(scene_obs, 24, "scene_obs")
        if self._diverged:  # Bullet's caches would keep the values that are not finite
            self.close()
            self._open()
        self._clear_contacts()
        self._put(robot_state, scene_state, continued)
        self._history = SavedState(self.scene.name, self.assets, robot_state, scene_state, continued, ())
        self._actions = []
        return self.observe()

    def step(self, action: Sequence[float] | np.ndarray, control_mode: str = "rel") -> Observation:
        """Executes one action for 1/30 s.

        Args:
            action: (7,). `"rel"`: TCP translation in units of 0.02 m, rotation (euler) in units of 0.05 rad, both
                added to a target pose that is kept from step to step; values beyond +-1 are not clipped, as in CALVIN.
                `"abs"`: TCP xyz (m) and euler xyz (rad). In both the gripper opens if the last number is positive and
                closes otherwise.
            control_mode: `"rel"` or `"abs"`.

        Raises:
            DeskError: The mode is unknown, or the action has the wrong shape, or a value that is not finite or
                exceeds `MAX_MAGNITUDE`.
            SimulationError: The physics diverged; reset before going on.
        """
        self._require_open()
        if control_mode not in ("rel", "abs"):
            raise DeskError(f"control_mode {control_mode!r} is unknown; it is 'rel' or 'abs'")
        self._advance(_vector(action, 7, "action"), control_mode)
        return self.observe()

    def save(self) -> SavedState:
        """The present state for `restore`, on this desk or another one with the same scene and assets."""
        self._require_open()
        return replace(self._history, actions=tuple(self._actions))

    def restore(self, state: SavedState) -> Observation:
        """Goes back to a saved state; from there the same actions lead to the same states, bit for bit.

        Bullet's own saved states lack the memory of its contact solver, so this resets the desk and repeats the
        actions: about 1 ms each.

        Raises:
            DeskError: The state was saved with another scene or other assets.
        """
        if (state.scene, state.assets) != (self.scene.name, self.assets):
            raise DeskError(
                f"the state was saved in scene {state.scene} with {state.assets} assets; this desk is scene "
                f"{self.scene.name} with {self.assets} assets"
            )
        self.reset(state.robot_obs, state.scene_obs, continued=state.continued)
        for action, control_mode in state.actions:
            self._advance(action, control_mode)
        return self.observe()

    def observe(self) -> Observation:
        """The present state: `robot_obs`, `scene_obs`, and per camera `rgb_<camera>` (size, size, 3) uint8 and, with
        `depth`, `depth_<camera>` (size, size) float32 m.

        Raises:
            SimulationError: The physics diverged; reset before going on.
        """
        self._require_open()
        obs = {"robot_obs": self._robot.observe(), "scene_obs": self._scene_obs()}
        if not all((np.abs(state) < _LARGEST_STATE).all() for state in obs.values()):  # not true for NaN
            self._diverged = True
            raise SimulationError("the simulation diverged: a state is no longer finite; reset the desk to go on")
        for camera in self.cameras:
            obs[f"rgb_{camera}"], inverse_depth = self._draw(camera)
            if self.depth:
                obs[f"depth_{camera}"] = _depth(camera, inverse_depth)
        return obs

    def render(self, camera: str = "static", size: int | None = None) -> np.ndarray:
        """A picture of the present state, (size, size, 3) uint8; `size` in pixels, the camera's own by default."""
        return self._draw(camera, size)[0]

    def render_depth(self, camera: str = "static", size: int | None = None) -> np.ndarray:
        """Distance along the camera's axis, (size, size) float32 m; where there is nothing, that of the far plane."""
        return _depth(camera, self._draw(camera, size)[1])

    def camera(self, name: str = "static", size: int | None = None) -> Camera:
        """What a camera sees, and from where it draws the present state.

        Args:
            name: `"static"` or `"gripper"`.
            size: Width and height of the picture, pixels; the camera's own by default.
        """
        self._require_open()
        _check_cameras((name,))
        size = _pixels(name, size)
        pose = static_camera_pose() if name == "static" else gripper_camera_pose(self._robot.observe())
        return Camera(name, size, intrinsics(name, size), pose)

    def snapshot(self) -> Snapshot:
        """The present state as the task oracle needs it."""
        self._require_open()
        contacts: dict[str, set[Touch]] = {name: set() for name in ("robot", *COLORS)}
        for contact in p.getContactPoints(physicsClientId=self._client) or ():
            a, b = (self._touch(contact[1 + i], contact[3 + i]) for i in (0, 1))
            for this, other in ((a, b), (b, a)):
                if this[0] in contacts:
                    contacts[this[0]].add(other)
        slide, drawer, _, _ = self._furniture.joints()
        return Snapshot(
            slide=slide,
            drawer=drawer,
            bulb=self._furniture.bulb,
            led=self._furniture.led,
            blocks={color: self._block_state(color, frozenset(contacts[color])) for color in COLORS},
            touched_by_robot=frozenset(body for body, _ in contacts["robot"]),
        )

    def completed_tasks(self, start: Snapshot) -> set[str]:
        """Names of the tasks that are fulfilled between `start` and now."""
        return completed_tasks(start, self.snapshot())

    def solve_ik(self, position: Any, euler: Any, rounds: int = 40) -> np.ndarray:
        """Arm joints (7,) rad that bring the TCP to a pose, found by repeating Bullet's IK.

        It moves the arm: use it between episodes, to choose a start state, and reset the desk afterwards.
        """
        for _ in range(rounds):
            joints = self._robot.joints_for(np.asarray(position), np.asarray(euler))
            for joint, value in enumerate(joints):
                p.resetJointState(self._robot.body, joint, value, physicsClientId=self._client)
        return joints

    def close(self) -> None:
        """Disconnects the Bullet client; calling it again does nothing."""
        if self._client >= 0:
            p.disconnect(physicsClientId=self._client)
            self._client = -1

    def __enter__(self) -> "Desk":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- private

    def _require_open(self) -> None:
        if self._client < 0:
            raise DeskError("this desk is closed, or Bullet had no client left for it; make a new one")

    def _draw(self, camera: str, size: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """A picture (size, size, 3) uint8 and its inverse depth (size, size) float32, 1/m."""
        self._require_open()
        _check_cameras((camera,))
        if self._renderer is None:
            lights = self._furniture.light_colors()
            self._renderer = open_renderer(self.renderer, self._client, lights, self._egl_plugin)
        fixed = camera == "static"
        view = static_view() if fixed else gripper_view(*self._robot.camera_pose())
        colors = self._furniture.light_colors()
        return self._renderer.draw(INTRINSICS[camera], view, _pixels(camera, size), colors, fixed)

    def _advance(self, action: np.ndarray, control_mode: str) -> None:
        self._actions.append((action, control_mode))
        self._robot.command(action, relative=control_mode == "rel")
        for _ in range(SUBSTEPS):
            p.stepSimulation(physicsClientId=self._client)
        self._furniture.update_lights()

    def _put(self, robot_state: np.ndarray | None, scene_state: np.ndarray, continued: bool) -> None:
        self._furniture.reset(scene_state[FURNITURE], continued)
        for index, color in enumerate(COLORS):
            pose = scene_state[block_pose(index)]
            self._blocks[color].place(pose[:3], pose[3:])
        self._robot.reset(robot_state)
        p.stepSimulation(physicsClientId=self._client)

    def _clear_contacts(self) -> None:
        """One step with all bodies apart: without it, Bullet keeps contacts across a reset."""
        self._robot.reset(None)
        self._furniture.reset(np.zeros(6))
        for index, block in enumerate(self._blocks.values()):
            block.place((_PARKING + index, 0, _PARKING), (0, 0, 0))
        p.stepSimulation(physicsClientId=self._client)

    def _scene_obs(self) -> np.ndarray:
        return np.concatenate([self._furniture.observe(), *(self._blocks[c].observe() for c in COLORS)])

    def _block_state(self, color: str, contacts: frozenset[Touch]) -> BlockState:
        block = self._blocks[color]
        (position, orientation), (linear, angular) = block.pose(), block.velocity()
        return BlockState(
            position=np.array(position),
            orientation=np.array(orientation),
            linear_velocity=np.array(linear),
            angular_velocity=np.array(angular),
            contacts=contacts,
        )

    def _touch(self, body: int, link: int) -> Touch:
        name = self._names[body]
        return name, self._desk_links[link] if name == "desk" else ""

    def _random_scene(self, seed: int | None) -> np.ndarray:
        """Everything closed and off; blocks as in the scene's layout, or at random, no two of them touching."""
        if self.scene.layout is not None:
            return np.array([0.0] * 6 + [x for color in COLORS for x in self.scene.layout[color]])
        rng = np.random.default_rng(seed)
        areas = list(self.scene.areas.values())
        while True:
            poses = []
            for _ in COLORS:
                area = areas[rng.integers(len(areas))]
                x, y, yaw = rng.uniform(*area.x), rng.uniform(*area.y), rng.uniform(-np.pi, np.pi)
                poses.append([x, y, TABLE_Z, 0.0, 0.0, yaw])
            # the longest block's half diagonal is 0.045 m
            if all(np.hypot(a[0] - b[0], a[1] - b[1]) > 0.09 for a, b in itertools.combinations(poses, 2)):
                return np.array([0.0] * 6 + [x for pose in poses for x in pose])


def _check_cameras(cameras: Sequence[str]) -> None:
    for camera in cameras:
        if camera not in CAMERAS:
            raise DeskError(f"camera {camera!r} is unknown; choose among {', '.join(CAMERAS)}")


def _pixels(camera: str, size: int | None) -> int:
    """Width and height of a camera's picture of that size; the camera's own by default."""
    pixels = CAMERAS[camera] if size is None else size
    if not isinstance(pixels, int | np.integer) or pixels < 1:
        raise DeskError(f"size must be a positive number of pixels, got {size!r}")
    return int(pixels)


def _depth(camera: str, inverse_depth: np.ndarray) -> np.ndarray:
    far = np.float32(INTRINSICS[camera].far)
    return 1 / np.maximum(inverse_depth, 1 / far)


def _vector(values: Any, length: int, name: str) -> np.ndarray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DeskError(f"{name} must be {length} numbers, got {values!r}") from None
    if array.shape != (length,):
        raise DeskError(f"{name} must have shape ({length},), got {array.shape}")
    if not np.isfinite(array).all():
        raise DeskError(f"{name} must be finite, got {array.tolist()}")
    if np.abs(array).max() > MAX_MAGNITUDE:
        raise DeskError(f"{name} must lie within +-{MAX_MAGNITUDE:g} in every component, got {array.tolist()}")
    return array
