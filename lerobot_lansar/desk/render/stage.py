"""What there is to draw in a Bullet client, and its present pose."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet as p

from .kinematics import Links
from .visuals import Visual, transform


@dataclass(frozen=True)
class Group:
    """The visuals of one link, which move together.

    Attributes:
        body, link: Bullet's ids.
        visuals: The link's shapes.
        still: Whether they never move and never change their colour.
        jointed: Whether the body has joints.
    """

    body: int
    link: int
    visuals: list[Visual]
    still: bool
    jointed: bool


class Stage:
    """All visuals of a Bullet client, in groups, and their poses.

    Args:
        client: Bullet client.
        visuals: All its visuals, in Bullet's order.
        repainted: (body, link) whose colours change.

    Attributes:
        groups: One per link that has visuals.
    """

    def __init__(self, client: int, visuals: Sequence[Visual], repainted: Collection[tuple[int, int]]):
        self._client = client
        bodies = list(dict.fromkeys(visual.body for visual in visuals))
        self._jointed = {body: Links(client, body) for body in bodies if p.getNumJoints(body, physicsClientId=client)}
        self._inertial = {body: p.getDynamicsInfo(body, -1, physicsClientId=client) for body in bodies}
        self._free = [b for b in bodies if b not in self._jointed and self._inertial[b][0] > 0]
        keys = list(dict.fromkeys((visual.body, visual.link) for visual in visuals))
        self.groups = [
            Group(
                body,
                link,
                [visual for visual in visuals if (visual.body, visual.link) == (body, link)],
                (body, link) not in repainted and not self._moves(body, link),
                body in self._jointed,
            )
            for body, link in keys
        ]
        self._poses = np.array([self._base(group.body) for group in self.groups])
        # of each body: rows of its groups, and where their links' frames are among all of the body's
        self._rows: dict[int, tuple[list[int], list[int]]] = {}
        for body in (*self._jointed, *self._free):
            rows = [row for row, group in enumerate(self.groups) if group.body == body]
            self._rows[body] = rows, [self.groups[row].link + 1 for row in rows]
        self._moment: dict[int, object] = {}  # of each body: the state that its poses show

    def poses(self) -> np.ndarray:
        """URDF frame of every group's link in world coordinates, (groups, 4, 4); the next call overwrites the array."""
        for body, links in self._jointed.items():
            states = p.getJointStates(body, links.moving, physicsClientId=self._client)
            positions = [state[0] for state in states]
            if positions != self._moment.get(body):  # both cameras see the same moment
                rows, numbers = self._rows[body]
                self._poses[rows] = links.poses(positions)[numbers]
                self._moment[body] = positions
        for body in self._free:
            pose = p.getBasePositionAndOrientation(body, physicsClientId=self._client)
            if pose != self._moment.get(body):
                self._poses[self._rows[body][0]] = self._base(body, pose)
                self._moment[body] = pose
        return self._poses

    def _moves(self, body: int, link: int) -> bool:
        return body in self._free or (body in self._jointed and self._jointed[body].moves(link))

    def _base(self, body: int, pose: tuple[Any, Any] | None = None) -> np.ndarray:
        """URDF frame of a body's base, (4, 4), from its Bullet pose."""
        position, orientation = pose or p.getBasePositionAndOrientation(body, physicsClientId=self._client)
        _, _, _, local_position, local_orientation = self._inertial[body][:5]
        if any(local_position) or local_orientation != (0.0, 0.0, 0.0, 1.0):
            inverse = p.invertTransform(local_position, local_orientation)
            position, orientation = p.multiplyTransforms(position, orientation, *inverse)
        return transform(position, orientation)
