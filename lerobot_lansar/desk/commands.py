"""What people say: sentences for each of the 34 tasks, ours or from a file in CALVIN's own format."""

from pathlib import Path

import yaml

from .errors import DeskError
from .oracle import TASKS
from .scenes import COLORS

_TEMPLATES: dict[str, tuple[str, ...]] = {
    "rotate_{color}_block_{side}": (
        "take the {color} block and rotate it {side}",
        "rotate the {color} block to the {side}",
        "grasp the {color} block and turn it {side}",
        "give the {color} block a turn towards the {side}",
        "pick up the {color} block and twist it to the {side}",
    ),
    "push_{color}_block_{side}": (
        "push the {color} block to the {side}",
        "slide the {color} block towards the {side}",
        "move the {color} block over to the {side}",
        "shove the {color} block {side}",
        "sweep the {color} block to the {side}",
    ),
    "move_slider_{side}": (
        "slide the door to the {side}",
        "move the sliding door to the {side}",
        "push the door of the cabinet to the {side}",
        "grasp the door handle and slide the door {side}",
        "shift the sliding door over to the {side} side",
    ),
    "open_drawer": (
        "open the drawer",
        "pull the drawer open",
        "pull the handle to open the drawer",
        "grasp the drawer handle, then open it",
        "slide the drawer out",
    ),
    "close_drawer": (
        "close the drawer",
        "push the drawer shut",
        "push the handle to close the drawer",
        "shut the drawer",
        "slide the drawer back in",
    ),
    "lift_{color}_block_table": (
        "lift the {color} block from the table",
        "grasp the {color} block on the table and lift it up",
        "pick up the {color} block from the table",
        "take the {color} block off the table",
        "raise the {color} block that lies on the table",
    ),
    "lift_{color}_block_slider": (
        "lift the {color} block lying in the cabinet",
        "grasp the {color} block on the shelf and lift it up",
        "pick up the {color} block from the sliding cabinet",
        "take the {color} block out of the cabinet",
        "raise the {color} block that lies on the shelf",
    ),
    "lift_{color}_block_drawer": (
        "lift the {color} block lying in the drawer",
        "grasp the {color} block in the drawer and lift it up",
        "pick up the {color} block from the drawer",
        "take the {color} block out of the drawer",
        "raise the {color} block that lies in the drawer",
    ),
    "place_in_slider": (
        "place the grasped object in the cabinet",
        "put the block into the sliding cabinet",
        "store the block you hold on the shelf",
        "set the object down in the cabinet",
        "lay the block behind the sliding door",
    ),
    "place_in_drawer": (
        "place the grasped object in the drawer",
        "put the block into the drawer",
        "store the block you hold in the drawer",
        "set the object down in the drawer",
        "drop the block into the open drawer",
    ),
    "stack_block": (
        "stack the grasped block on top of another block",
        "place the block on top of another block",
        "put the block you hold onto another one",
        "build a stack with the block",
        "set the object down on a different block",
    ),
    "unstack_block": (
        "take off the stacked block",
        "remove the top block",
        "take the upper block down from the stack",
        "lift the block off the one below it",
        "unstack the blocks",
    ),
    "turn_on_lightbulb": (
        "turn on the light bulb",
        "push the switch up to turn on the yellow light",
        "move the light switch upwards",
        "switch the yellow lamp on",
        "use the switch to light the bulb",
    ),
    "turn_off_lightbulb": (
        "turn off the light bulb",
        "push the switch down to turn off the yellow light",
        "move the light switch downwards",
        "switch the yellow lamp off",
        "use the switch to put out the bulb",
    ),
    "turn_on_led": (
        "turn on the led",
        "press the button to turn on the green light",
        "push the button so that the led lights up",
        "switch the green light on",
        "toggle the button to light the led",
    ),
    "turn_off_led": (
        "turn off the led",
        "press the button to turn off the green light",
        "push the button so that the led goes dark",
        "switch the green light off",
        "toggle the button to put out the led",
    ),
    "push_into_drawer": (
        "sweep the block into the drawer",
        "push the object into the drawer",
        "slide the block over the edge into the drawer",
        "shove the block until it falls into the drawer",
        "move the object into the open drawer by pushing it",
    ),
}


def _expand() -> dict[str, list[str]]:
    sentences = {}
    for name, templates in _TEMPLATES.items():
        for color in COLORS if "{color}" in name else ("",):
            for side in ("left", "right") if "{side}" in name else ("",):
                filled = [template.format(color=color, side=side) for template in templates]
                sentences[name.format(color=color, side=side)] = filled
    return {task: sentences[task] for task in TASKS}


COMMANDS: dict[str, list[str]] = _expand()
"""Task to sentences; evaluations use the first one of a task."""


def load_commands(file: str | Path | None) -> dict[str, list[str]]:
    """Sentences by task: :data:`COMMANDS`, or those of ``file`` where it has any.

    Args:
        file: YAML, task name to a sentence or a list of sentences, as in CALVIN's annotation files; or None.

    Raises:
        DeskError: The file is missing, is not of that form, or names a task that does not exist.
    """
    if file is None:
        return COMMANDS
    path = Path(file)
    if not path.is_file():
        raise DeskError(f"annotations file {path} does not exist")
    try:
        content = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise DeskError(f"annotations file {path} is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise DeskError(
            f"annotations file {path} must map task names to sentences, got {type(content).__name__}"
        )
    commands = dict(COMMANDS)
    for task, sentences in content.items():
        if task not in TASKS:
            raise DeskError(f"annotations file {path} names the unknown task {task!r}")
        listed = [sentences] if isinstance(sentences, str) else sentences
        if not isinstance(listed, list) or not listed or not all(isinstance(s, str) for s in listed):
            raise DeskError(f"annotations file {path}: {task} must be a sentence or a list of sentences")
        commands[task] = listed
    return commands
