"""What the arm works on: the desk with its joints and lights, and the three blocks."""

from typing import Any

import numpy as np
import pybullet as p

from .assets import Assets
from .scenes import BUTTON_TRAVEL, SWITCH_TRAVEL, Scene

OFF = (1.0, 1.0, 1.0, 1.0)
LED_ON = (0.0, 1.0, 0.0, 1.0)
BULB_ON = (1.0, 1.0, 0.0, 1.0)
JOINT_FORCE = 4.0
"""Force (N) with which motors brake the slide, the drawer and the switch, and push the button back up."""
JOINTS = ("slide", "drawer", "button", "switch")
"""The desk's joints in the order of `scene_obs`."""


class Furniture:
    """The desk's slide, drawer, button and switch joints, light bulb and LED.

    Attributes:
        body: Bullet body id.
        links: Link name to link index (`base_link` is -1).
        bulb, led: Whether each light is on.
    """

    def __init__(self, client: int, assets: Assets):
        self.client = client
        self.body = p.loadURDF(str(assets.desk), globalScaling=assets.scale, physicsClientId=client)
        self.links = {"base_link": -1}
        self._joints: dict[str, int] = {}
        for index in range(p.getNumJoints(self.body, physicsClientId=client)):
            info = p.getJointInfo(self.body, index, physicsClientId=client)
            self.links[info[12].decode()] = index
            self._joints[info[1].decode().removeprefix("base__")] = index
        for name in ("slide", "drawer", "switch"):
            p.setJointMotorControl2(
                self.body, self._joints[name], p.VELOCITY_CONTROL, force=JOINT_FORCE, physicsClientId=client
            )
        button = self._joints["button"]
        p.setJointMotorControl2(
            self.body, button, p.POSITION_CONTROL, targetPosition=0, force=JOINT_FORCE, physicsClientId=client
        )
        self.bulb = self.led = False
        self._was_pressed = self._was_on = False

    def joints(self) -> list[float]:
        """Positions (m) of slide, drawer, button and switch."""
        indices = [self._joints[name] for name in JOINTS]
        return [state[0] for state in p.getJointStates(self.body, indices, physicsClientId=self.client)]

    def reset(self, state: np.ndarray, continued: bool = False) -> None:
        """Sets slide, drawer, button, switch (m), bulb and LED (0/1): (6,), the first part of `scene_obs`.

        With `continued`, lights have already followed a button that is down and a switch that is on.
        """
        for name, value in zip(JOINTS, state[:4], strict=True):
            p.resetJointState(self.body, self._joints[name], value, physicsClientId=self.client)
        self.bulb, self.led = bool(state[4] > 0.5), bool(state[5] > 0.5)
        self._was_pressed, self._was_on = (continued and is_down for is_down in self._are_down())

    def _are_down(self) -> tuple[bool, bool]:
        """Whether the button is pressed and whether the switch is on."""
        _, _, button, switch = self.joints()
        return button > BUTTON_TRAVEL / 2, switch > SWITCH_TRAVEL / 2

    def update_lights(self) -> None:
        """A new press of the button toggles the LED, a moved switch sets the bulb; to be called every control step."""
        pressed, on = self._are_down()
        if pressed and not self._was_pressed:
            self.led = not self.led
        self._was_pressed = pressed
        if on != self._was_on:
            self.bulb = on
        self._was_on = on

    def light_colors(self) -> dict[tuple[int, int], tuple[float, ...]]:
        """(body, link) of the LED and of the bulb to their present rgba, 0 to 1."""
        return {
            (self.body, self.links["led_link"]): LED_ON if self.led else OFF,
            (self.body, self.links["light_link"]): BULB_ON if self.bulb else OFF,
        }

    def observe(self) -> np.ndarray:
        """The first part of `scene_obs`: (6,) float64."""
        return np.array([*self.joints(), float(self.bulb), float(self.led)])


class Block:
    """One of the three blocks."""

    def __init__(self, client: int, assets: Assets, color: str):
        self.client = client
        self.body = p.loadURDF(str(assets.blocks[color]), globalScaling=assets.scale, physicsClientId=client)

    def place(self, position: Any, euler: Any) -> None:
        """Puts the block at `position` (3,) m with angles `euler` (3,) rad, at rest."""
        p.resetBasePositionAndOrientation(
            self.body, position, p.getQuaternionFromEuler(euler), physicsClientId=self.client
        )

    def pose(self) -> tuple[Any, Any]:
        """Position (3,) m and quaternion xyzw (4,)."""
        return p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)

    def velocity(self) -> tuple[Any, Any]:
        """Linear (m/s) and angular (rad/s) velocity, (3,) each."""
        return p.getBaseVelocity(self.body, physicsClientId=self.client)

    def observe(self) -> np.ndarray:
        """Position (m) and euler angles (rad): (6,) float64."""
        position, orientation = self.pose()
        return np.array([*position, *p.getEulerFromQuaternion(orientation)])


def load_blocks(client: int, assets: Assets, scene: Scene) -> dict[str, Block]:
    """Loads the blocks in CALVIN's order for the scene, so that Bullet's body ids are the original's."""
    return {color: Block(client, assets, color) for color in scene.blocks}
