"""The CALVIN desk: a Panda in front of a piece of furniture, simulated by PyBullet."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as p

from ..calvin import CAMERAS, COLORS, FURNITURE, block_pose
from .assets import Assets, open_assets
from .cameras import INTRINSICS, gripper_view, static_view
from .errors import DeskError, SimulationError
from .furniture import Table, load_blocks
from .oracle import BlockState, Snapshot, Touch, completed_tasks
from .render import RENDERERS, Preparation, Renderer
from .robot import Robot
from .scenes import Scene, get_scene

SUBSTEPS = 8
"""Simulation steps of 1/240 s per control step of 1/30 s."""

LARGEST = 100.0
"""No number of an action or a state may be larger: relative units, metres or radians."""

Observation = dict[str, np.ndarray]

_PARKING = 100.0  # where blocks wait while contact caches are cleared (m)


@dataclass(frozen=True)
class SavedState:
    """How a desk came to where it was: the state it was reset to and the actions since. It can be pickled."""

    scene: str
    assets: str
    robot_obs: np.ndarray | None
    scene_obs: np.ndarray
    actions: tuple[tuple[np.ndarray, str], ...]


class Desk:
    """One simulated desk in a Bullet client of its own.

    `robot_obs` (15,) float64 is CALVIN's: TCP xyz (m), TCP euler xyz (rad), gripper opening width (m), seven arm
    joints (rad), last gripper action (-1 close, +1 open). `scene_obs` (24,) float64: slide, drawer, button, switch
    joints (m), light bulb, LED (0/1), then xyz (m) and euler xyz (rad) of the red, the blue and the pink block: this
    order in every scene, whereas CALVIN's own files follow each scene's configuration.

    Args:
        scene: `"A"`, `"B"`, `"C"`, `"D"`, or `"D_eval"`: D with calvin_env's fixed evaluation layout.
        assets: None for the built-in desk, or the `data` folder of a calvin_env checkout for the original files.
        cameras: Pictures that observations hold: any of `"static"` (200x200) and `"gripper"` (84x84).
        renderer: `"fast"` (ours, in TinyRenderer's look), `"fast_gl"` (ours, in the OpenGL look of CALVIN's public
            data), `"tiny"` or `"egl"` (PyBullet's own). It is set up when the first picture is asked for.
        depth: Observations also hold `depth_<camera>`.

    Raises:
        DeskError: Unknown scene, camera or renderer, missing asset files, no driver for `egl`.
    """

    def __init__(
        self,
        scene: str = "D",
        assets: str | Path | None = None,
        cameras: Sequence[str] = ("static", "gripper"),
        renderer: str = "fast",
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
        with open_assets(self.scene, self._assets_folder) as files:
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
        self._pictures = Preparation(self.renderer, client)
        if files.temporary:  # Bullet would remember every file by its ever new name
            p.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        p.setGravity(0, 0, -9.8, physicsClientId=client)
        self._robot = Robot(client, files)
        self._blocks = load_blocks(client, files, self.scene)
        self._table = Table(client, files)
        plane = p.loadURDF(str(files.plane), physicsClientId=client)
        # Only after loading: earlier it is lost and the motion depends on how the bodies came in.
        p.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        self._names = {self._robot.body: "robot", self._table.body: "desk", plane: "plane"}
        self._names |= {block.body: color for color, block in self._blocks.items()}
        self._desk_links = {index: name for name, index in self._table.links.items()}
        self._pictures.loaded(files.temporary)
        if files.temporary:
            p.setPhysicsEngineParameter(enableFileCaching=1, physicsClientId=client)

    # ---- what users call

    def reset(
        self,
        robot_obs: Sequence[float] | np.ndarray | None = None,
        scene_obs: Sequence[float] | np.ndarray | None = None,
        seed: int | None = 0,
    ) -> Observation:
        """Puts the desk into a state; nothing of what happened before remains.

        Args:
            robot_obs: (15,) joints, opening width and gripper action are used; None: CALVIN's home pose, hand open.
            scene_obs: (24,) with blocks in red, blue, pink order; None: everything closed and off, blocks placed at
                random by `seed` as CALVIN does, or where the scene's layout has them.
            seed: Decides the blocks' places when `scene_obs` is None.

        Returns:
            The observation after one simulation step, as in CALVIN.

        Raises:
            DeskError: A state of the wrong length, with a value that is not finite, or over `LARGEST`.
        """
        self._require_open()
        robot_state = None if robot_obs is None else _vector(robot_obs, 15, "robot_obs")
        scene_state = self._random_scene(seed) if scene_obs is None else _vector(scene_obs, 24, "scene_obs")
        if self._diverged:  # what is not finite stays in Bullet's caches
            self.close()
            self._open()
        self._clear_contacts()
        self._put(robot_state, scene_state)
        self._history = SavedState(self.scene.name, self.assets, robot_state, scene_state, ())
        self._actions = []
        return self.observe()

    def step(self, action: Sequence[float] | np.ndarray, control_mode: str = "rel") -> Observation:
        """Executes one action for 1/30 s.

        Args:
            action: (7,). `"rel"`: TCP translation in units of 0.02 m, rotation (euler) in units of 0.05 rad, both
                added to a target pose that is kept from step to step. `"abs"`: TCP xyz (m) and euler xyz (rad).
                Last number in both: the gripper opens if it is positive, closes otherwise.
            control_mode: `"rel"` or `"abs"`.

        Raises:
            DeskError: Unknown mode; an action of the wrong shape, with a value that is not finite, or over
                `LARGEST`. Relative actions beyond 1 are executed as they are, as in CALVIN.
            SimulationError: The physics diverged; reset before going on.
        """
        self._require_open()
        if control_mode not in ("rel", "abs"):
            raise DeskError(f"control_mode {control_mode!r} is unknown; it is 'rel' or 'abs'")
        self._advance(_vector(action, 7, "action"), control_mode)
        return self.observe()

    def save(self) -> SavedState:
        """Remembers the present state for `restore`, here or on another desk of the same scene and assets."""
        self._require_open()
        return replace(self._history, actions=tuple(self._actions))

    def restore(self, state: SavedState) -> Observation:
        """Goes back to a saved state; the same actions then lead to the same states, bit for bit.

        Bullet's own saved states miss what its contact solver remembers, so this resets and repeats the actions: about
        1 ms for each.

        Raises:
            DeskError: The state belongs to another scene or to other assets.
        """
        if (state.scene, state.assets) != (self.scene.name, self.assets):
            raise DeskError(
                f"the state was saved in scene {state.scene} with {state.assets} assets; this desk is scene "
                f"{self.scene.name} with {self.assets} assets"
            )
        self.reset(state.robot_obs, state.scene_obs)
        for action, control_mode in state.actions:
            self._advance(action, control_mode)
        return self.observe()

    def observe(self) -> Observation:
        """The present state: `robot_obs`, `scene_obs` and, per camera, `rgb_<camera>` (size, size, 3) uint8 and,
        if the desk was made with `depth`, `depth_<camera>` (size, size) float32 m.
        """
        self._require_open()
        obs = {"robot_obs": self._robot.observe(), "scene_obs": self._scene_obs()}
        if not all(np.isfinite(state).all() for state in obs.values()):
            self._diverged = True
            raise SimulationError("the simulation diverged: a state is no longer finite; reset the desk to go on")
        for camera in self.cameras:
            obs[f"rgb_{camera}"], inverse = self._draw(camera)
            if self.depth:
                obs[f"depth_{camera}"] = _distance(camera, inverse)
        return obs

    def render(self, camera: str = "static", size: int | None = None) -> np.ndarray:
        """A picture of the present state, (size, size, 3) uint8; `size` in pixels, the camera's own by default."""
        return self._draw(camera, size)[0]

    def render_depth(self, camera: str = "static", size: int | None = None) -> np.ndarray:
        """Distance along the camera's axis, (size, size) float32 m; the camera's far plane where there is nothing."""
        return _distance(camera, self._draw(camera, size)[1])

    def snapshot(self) -> Snapshot:
        """What the task oracle needs of the present state."""
        self._require_open()
        contacts: dict[str, set[Touch]] = {name: set() for name in ("robot", *COLORS)}
        for contact in p.getContactPoints(physicsClientId=self._client) or ():
            a, b = (self._touch(contact[1 + i], contact[3 + i]) for i in (0, 1))
            for this, other in ((a, b), (b, a)):
                if this[0] in contacts:
                    contacts[this[0]].add(other)
        slide, drawer, _, _ = self._table.joints()
        return Snapshot(
            slide=slide,
            drawer=drawer,
            bulb=self._table.bulb,
            led=self._table.led,
            blocks={color: self._block_state(color, frozenset(contacts[color])) for color in COLORS},
            touched_by_robot=frozenset(body for body, _ in contacts["robot"]),
        )

    def completed_tasks(self, start: Snapshot) -> set[str]:
        """Names of CALVIN's tasks that are fulfilled between `start` and now."""
        return completed_tasks(start, self.snapshot())

    def solve_ik(self, position: Any, euler: Any, rounds: int = 40) -> np.ndarray:
        """Arm joints (7,) rad that bring the TCP to a pose, found by repeating Bullet's IK; moves the arm there.

        Meant for choosing a start state between episodes: it leaves the arm displaced, so reset the desk afterwards.
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

    # ---- inside

    def _require_open(self) -> None:
        if self._client < 0:
            raise DeskError("this desk is closed, or Bullet had no client left for it; make a new one")

    def _draw(self, camera: str, size: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """A picture and 1 / distance."""
        self._require_open()
        _check_cameras((camera,))
        if self._renderer is None:
            self._renderer = self._pictures.open(self._table.light_colors())
        still = camera == "static"
        view = static_view() if still else gripper_view(*self._robot.camera_pose())
        lens = INTRINSICS[camera]
        pixels = lens.size if size is None else size
        if not isinstance(pixels, int | np.integer) or pixels < 1:
            raise DeskError(f"size must be a positive number of pixels, got {size!r}")
        return self._renderer.draw(lens, view, int(pixels), self._table.light_colors(), keep=still)

    def _advance(self, action: np.ndarray, control_mode: str) -> None:
        self._actions.append((action, control_mode))
        self._robot.command(action, relative=control_mode == "rel")
        for _ in range(SUBSTEPS):
            p.stepSimulation(physicsClientId=self._client)
        self._table.update_lights()

    def _put(self, robot_state: np.ndarray | None, scene_state: np.ndarray) -> None:
        self._table.reset(scene_state[FURNITURE])
        for index, color in enumerate(COLORS):
            pose = scene_state[block_pose(index)]
            self._blocks[color].place(pose[:3], pose[3:])
        self._robot.reset(robot_state)
        p.stepSimulation(physicsClientId=self._client)

    def _clear_contacts(self) -> None:
        """Bullet keeps contacts over a reset; a step with everything apart makes it forget them."""
        self._robot.reset(None)
        self._table.reset(np.zeros(6))
        for index, block in enumerate(self._blocks.values()):
            block.place((_PARKING + index, 0, _PARKING), (0, 0, 0))
        p.stepSimulation(physicsClientId=self._client)

    def _scene_obs(self) -> np.ndarray:
        return np.concatenate([self._table.observe(), *(self._blocks[c].observe() for c in COLORS)])

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
        """Everything closed and off; blocks as the scene's layout says, or at random, no two of them touching."""
        if self.scene.layout is not None:
            return np.array([0.0] * 6 + [x for color in COLORS for x in self.scene.layout[color]])
        rng = np.random.default_rng(seed)
        areas = list(self.scene.areas.values())
        while True:
            poses = []
            for _ in COLORS:
                area = areas[rng.integers(len(areas))]
                poses.append([rng.uniform(*area.x), rng.uniform(*area.y), 0.46, 0.0, 0.0, rng.uniform(-np.pi, np.pi)])
            # the longest block's half diagonal is 0.045 m
            if all(np.hypot(a[0] - b[0], a[1] - b[1]) > 0.09 for a, b in itertools.combinations(poses, 2)):
                return np.array([0.0] * 6 + [x for pose in poses for x in pose])


def _check_cameras(cameras: Sequence[str]) -> None:
    for camera in cameras:
        if camera not in CAMERAS:
            raise DeskError(f"camera {camera!r} is unknown; choose among {', '.join(CAMERAS)}")


def _distance(camera: str, inverse: np.ndarray) -> np.ndarray:
    far = np.float32(INTRINSICS[camera].far)
    return 1 / np.maximum(inverse, 1 / far)


def _vector(values: Any, length: int, name: str) -> np.ndarray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DeskError(f"{name} must be {length} numbers, got {values!r}") from None
    if array.shape != (length,):
        raise DeskError(f"{name} must have shape ({length},), got {array.shape}")
    if not np.isfinite(array).all():
        raise DeskError(f"{name} must be finite, got {array.tolist()}")
    if np.abs(array).max() > LARGEST:
        raise DeskError(f"{name} must lie within +-{LARGEST:g} in every component, got {array.tolist()}")
    return array
