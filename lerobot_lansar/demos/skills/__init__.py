"""How a hand does each of the 34 tasks: generators of waypoints that look at the desk's state before each one.

A skill goes on until the demonstrator stops it because the oracle is satisfied, or until it has tried often enough.
Distances are measured on the desk: sizes of handle, lever and blocks, height of the button.

blocks       taking, lifting, carrying, setting down and stacking blocks
table        turning blocks and pushing them over the table
furniture    drawer, door, switch and button
"""

from collections.abc import Callable, Iterator

from ...calvin import TASKS, Task
from ..moves import Skill, View, Waypoint
from . import blocks, furniture, table


def _sign(task: Task) -> float:
    """The direction along x to the task's side: +1 to the right."""
    return 1.0 if task.side == "right" else -1.0


_BY_KIND: dict[str, Callable[[Task], Skill]] = {
    "rotate_block": lambda task: table.rotate(str(task.color), -_sign(task)),
    "push_block": lambda task: table.push(str(task.color), _sign(task)),
    "move_slider": lambda task: furniture.slide(_sign(task)),
    "open_drawer": lambda _: furniture.open_drawer,
    "close_drawer": lambda _: furniture.close_drawer,
    "lift_block": lambda task: blocks.lift(str(task.color)),
    "place_block": lambda task: blocks.place_in_slider if task.place == "slider" else blocks.place_in_drawer,
    "stack_block": lambda _: blocks.stack_block,
    "unstack_block": lambda _: blocks.unstack_block,
    "turn_on_lightbulb": lambda _: furniture.turn_on_lightbulb,
    "turn_off_lightbulb": lambda _: furniture.turn_off_lightbulb,
    "turn_on_led": lambda _: furniture.press_button,
    "turn_off_led": lambda _: furniture.press_button,
    "push_into_drawer": lambda _: table.push_into_drawer,
}


def _order(task: Task) -> tuple[int, bool]:
    """By kind; of turning and pushing, all to the right first. Recordings depend on it: they take tasks in turn."""
    return list(_BY_KIND).index(task.kind), task.color is not None and task.side == "left"


def _with_free_hand(task: Task) -> Skill:
    """The task's skill, which first puts down a block that the task is not about."""
    skill = _BY_KIND[task.kind](task)

    def freed(view: View) -> Iterator[Waypoint]:
        held = view.held()
        wanted = {task.color, view.start.held(), blocks.top_of_stack(view.start)}
        if held is not None and held not in wanted and task.kind != "push_into_drawer":
            yield from blocks.put_down(view)
        yield from skill(view)

    return freed


SKILLS: dict[str, Skill] = {task.name: _with_free_hand(task) for task in sorted(TASKS.values(), key=_order)}
"""How each of the 34 tasks is done."""
