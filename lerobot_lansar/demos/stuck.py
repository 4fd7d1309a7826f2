"""When a policy that carries out a command needs help."""

import numpy as np

from ..calvin import TASKS, Task
from ..desk import is_fulfilled
from ..desk.desk import Observation
from ..desk.oracle import Snapshot

USUAL_FRAMES = {
    ("rotate_block", None): 126,
    ("push_block", None): 98,
    ("move_slider", None): 98,
    ("open_drawer", None): 105,
    ("close_drawer", None): 121,
    ("lift_block", "table"): 75,
    ("lift_block", "slider"): 92,
    ("lift_block", "drawer"): 69,
    ("place_block", "slider"): 78,
    ("place_block", "drawer"): 82,
    ("stack_block", None): 74,
    ("unstack_block", None): 48,
    ("turn_on_lightbulb", None): 87,
    ("turn_off_lightbulb", None): 86,
    ("turn_on_led", None): 64,
    ("turn_off_led", None): 67,
    ("push_into_drawer", None): 119,
}
"""Kind and place of a task to the demonstrator's mean number of frames (eight hours of chains, variety 0.3, desk D)."""

STILL_FRAMES = 45
"""A policy has stopped when for so long nothing went farther than `_STILL` from where it was: longer than any rest of
the demonstrator."""
_STILL = 0.005  # m
LOOSE_FRAMES = 15
"""A block that was in the hand is lost when the hand has not touched it for so long: a placed one has then settled."""
_FURNITURE = {
    *("move_slider", "open_drawer", "close_drawer"),
    *("turn_on_lightbulb", "turn_off_lightbulb", "turn_on_led", "turn_off_led"),
}


def usual_frames(task: str) -> int:
    """How many frames the demonstrator takes for a task, on average."""
    return USUAL_FRAMES[TASKS[task].kind, TASKS[task].place]


class Watch:
    """Watches a policy carry out one command and says when it is stuck.

    Args:
        task: The task that is commanded.
        start: The state in which it was commanded.
        patience: The policy may take so many times the frames that the demonstrator usually takes.
    """

    def __init__(self, task: str, start: Snapshot, patience: float):
        self._start = start
        self._limit = patience * usual_frames(task)
        self._wrong = [name for name, other in TASKS.items() if _is_mistake(other, TASKS[task])]
        self._frames = self._still = self._loose = 0
        self._where: np.ndarray | None = None
        self._carried: str | None = None
        held, commanded = start.held, TASKS[task]
        goes_on = commanded.kind in ("place_block", "stack_block") or commanded.color == held
        self._to_put_down = None if goes_on else held

    def is_stuck(self, obs: Observation, now: Snapshot) -> bool:
        """Whether the policy needs help, after its next step; call it once per step.

        It does if it takes too long, if nothing moves, if it lost the block that it had in its hand (not one from the
        command before, which it has to put down), or if the oracle sees that it did something else: the same task to
        the other side or with another block, or moved furniture.
        """
        self._frames += 1
        self._see_movement(obs)
        self._see_carried(now)
        return (
            self._frames >= self._limit
            or self._still >= STILL_FRAMES
            or self._loose >= LOOSE_FRAMES
            or any(is_fulfilled(name, self._start, now) for name in self._wrong)
        )

    def _see_movement(self, obs: Observation) -> None:
        scene = obs["scene_obs"]
        blocks = scene[6:].reshape(3, 6)[:, :3].ravel()
        where = np.concatenate([obs["robot_obs"][:3], obs["robot_obs"][6:7], scene[:4], blocks])
        if self._where is None or np.abs(where - self._where).max() > _STILL:
            self._where, self._still = where, 0
        else:
            self._still += 1

    def _see_carried(self, now: Snapshot) -> None:
        held = now.held
        if held is not None and held != self._to_put_down:
            self._carried, self._loose = held, 0
        elif self._carried is not None and "robot" not in now.blocks[self._carried].bodies:
            self._loose += 1


def _is_mistake(other: Task, commanded: Task) -> bool:
    """Whether nobody fulfils one task on the way to another."""
    if other == commanded:
        return False
    if other.kind in _FURNITURE:
        return True
    if commanded.color is None or other.color is None:
        return False
    return other.color != commanded.color or other.kind == commanded.kind == "push_block"
