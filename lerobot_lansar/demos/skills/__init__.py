"""How a hand does each of the 34 tasks: generators of waypoints that look at the desk's state before each one.

A skill goes on until the demonstrator stops it because the oracle is satisfied, or until it has tried often enough.
Distances are measured on the desk: sizes of handle, lever and blocks, height of the button.

blocks       taking, lifting, carrying, setting down and stacking blocks
table        turning blocks and pushing them over the table
furniture    drawer, door, switch and button
"""

from collections.abc import Callable, Iterator

from ...calvin import TASKS, Task
from ..moves import Skill, View, Waypoint, on_table
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
    """The task's skill, which first lets go of a block that the task is not about.

    A command ends as soon as it is fulfilled, often with a block still in the hand or between the open fingers.
    """
    skill = _BY_KIND[task.kind](task)

    def freed(view: View) -> Iterator[Waypoint]:
        wanted = _wanted(task, view)
        held = view.held()
        if held is None:
            yield from blocks.leave(view, but=wanted)
        elif held != wanted:
            yield from blocks.let_go(view, held)
        yield from skill(view)

    return freed


def _wanted(task: Task, view: View) -> str | None:
    """The block that the hand takes first, or already has, to do the task."""
    match task.kind:
        case "place_block" | "stack_block":
            return view.start.held()
        case "unstack_block":
            return blocks.top_of_stack(view.start)
        case "push_into_drawer":
            held = view.held()
            return held if held is not None and on_table(view.start.block(held)) else None
        case "lift_block" | "rotate_block" | "push_block":
            return task.color
    return None


SKILLS: dict[str, Skill] = {task.name: _with_free_hand(task) for task in sorted(TASKS.values(), key=_order)}
"""How each of the 34 tasks is done."""
