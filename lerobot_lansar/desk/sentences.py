"""Commands in words: a small grammar for each of the 34 tasks, or sentences from a user's file.

Each task has two disjoint sets of sentences, as in CALVIN: *training* sentences label demonstrations, *validation*
sentences are held out for evaluation. They start from the example commands in Table 4.1 of the thesis. Colour and
side are filled in from the task; tests check the words for places and opposites (open, close; on, off).
"""

import itertools
import re
from pathlib import Path

import yaml

from ..calvin import COLORS, TASKS
from .errors import DeskError

_BLOCK = "the {color} (block|cube)"

_GRAMMAR: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "rotate_{color}_block_{side}": (
        (
            f"(take|grasp|grab|pick up) {_BLOCK} and (rotate|turn) it (|to the ){{side}}",
            f"(rotate|turn) {_BLOCK} (to|towards) the {{side}}",
            f"give {_BLOCK} a turn to the {{side}}",
        ),
        (
            "twist the {color} block to the {side}",
            "hold the {color} block and spin it {side}",
            "make a {side} turn with the {color} block",
        ),
    ),
    "push_{color}_block_{side}": (
        (
            f"(|go )(push|slide|move) {_BLOCK} (to|towards) the {{side}}",
            f"(push|slide|move) {_BLOCK} over to the {{side}} side",
        ),
        (
            "shove the {color} block to the {side}",
            "sweep the {color} block over to the {side}",
            "nudge the {color} block {side}",
        ),
    ),
    "move_slider_{side}": (
        (
            "(slide|push|move) the (|sliding )door (to|towards) the {side}",
            "(slide|move) the door handle to the {side}",
            "grasp the door handle and (slide|move) the door {side}",
        ),
        (
            "pull the sliding door over to the {side} side",
            "shift the cabinet's door to the {side}",
            "bring the door to the {side} end",
        ),
    ),
    "open_drawer": (
        (
            "(|go )(open|pull open) the drawer",
            "(pull|grasp) the (|drawer )handle (and|to) open (it|the drawer)",
            "(slide|pull) the drawer out",
        ),
        ("get the drawer open", "take hold of the drawer's handle and pull", "make the drawer come out"),
    ),
    "close_drawer": (
        (
            "(|go )(close|shut) the drawer",
            "(push|grasp) the (|drawer )handle (and|to) close (it|the drawer)",
            "(slide|push) the drawer in",
        ),
        ("get the drawer closed", "push the drawer back into the desk", "make sure the drawer is shut"),
    ),
    "lift_{color}_block_table": (
        (
            f"(lift|pick up|raise) {_BLOCK} (from|on) the table",
            f"(take|grasp|grab) {_BLOCK} on the table and (lift it up|raise it)",
            f"(lift|pick) {_BLOCK} up",
        ),
        (
            "take the {color} block off the table",
            "on the table, get hold of the {color} block and bring it up",
            "raise the {color} block that lies on the table",
        ),
    ),
    "lift_{color}_block_slider": (
        (
            f"(lift|pick up|raise) {_BLOCK} (from|in) the (|sliding )cabinet",
            f"(take|grasp|grab) {_BLOCK} (|lying )in the cabinet and (lift it up|raise it)",
            f"in the cabinet (grasp|lift) {_BLOCK}",
        ),
        (
            "take the {color} block out of the sliding cabinet",
            "from the shelf, get hold of the {color} block and bring it up",
            "raise the {color} block that lies on the shelf",
        ),
    ),
    "lift_{color}_block_drawer": (
        (
            f"(lift|pick up|raise) {_BLOCK} (from|in) the drawer",
            f"(take|grasp|grab) {_BLOCK} (|lying )in the drawer and (lift it up|raise it)",
            f"go towards {_BLOCK} in the drawer and lift it",
        ),
        (
            "take the {color} block out of the drawer",
            "inside the drawer, get hold of the {color} block and bring it up",
            "raise the {color} block that lies in the drawer",
        ),
    ),
    "place_in_slider": (
        (
            "(place|put|set) the (grasped |)(object|block) (in|into) the (|sliding )cabinet",
            "(store|lay) the (object|block) in the cabinet",
        ),
        (
            "set what you hold down behind the sliding door",
            "leave the block on the shelf",
            "put it into the cabinet",
        ),
    ),
    "place_in_drawer": (
        (
            "(place|put|set|drop) the (grasped |)(object|block) (in|into) the (|open )drawer",
            "(store|lay) the (object|block) in the drawer",
        ),
        (
            "set what you hold down in the drawer",
            "leave the block inside the drawer",
            "let go of it over the drawer",
        ),
    ),
    "stack_block": (
        (
            "(stack|place|put) the (grasped |)(object|block) on top of another (object|block)",
            "(stack|put) the (grasped |)block (on|onto) another one",
            "stack the blocks",
        ),
        (
            "set what you hold down on a different block",
            "build a tower of two blocks",
            "leave the block standing on another one",
        ),
    ),
    "unstack_block": (
        (
            "(take off|remove|take down) the (stacked|top|upper) block",
            "(unstack|take apart) the (blocks|stack|tower)",
            "(take|lift) the (top|upper) block (off|from) the (stack|tower)",
        ),
        (
            "free the lower block of the one on it",
            "pick the highest block off the pile",
            "undo the tower of blocks",
        ),
    ),
    "turn_on_lightbulb": (
        (
            "(turn|switch) on the (light bulb|yellow light|yellow lamp|bulb)",
            "(push|move|slide) the switch (up|upwards) (|to turn on the (light|bulb))",
        ),
        (
            "make the bulb glow yellow",
            "flip the light switch to its upper end",
            "use the switch to light the lamp",
        ),
    ),
    "turn_off_lightbulb": (
        (
            "(turn|switch) off the (light bulb|yellow light|yellow lamp|bulb)",
            "(push|move|slide) the switch (down|downwards) (|to turn off the (light|bulb))",
        ),
        (
            "make the bulb go dark",
            "flip the light switch to its lower end",
            "use the switch to put out the lamp",
        ),
    ),
    "turn_on_led": (
        (
            "(turn|switch) on the (led|led light|green light|green lamp)",
            "(press|push) the button to (turn|switch) on the (led|green light)",
        ),
        (
            "make the led shine green",
            "touch the button so that the led lights up",
            "get the green light to shine",
        ),
    ),
    "turn_off_led": (
        (
            "(turn|switch) off the (led|led light|green light|green lamp)",
            "(press|push) the button to (turn|switch) off the (led|green light)",
        ),
        ("make the led go dark", "touch the button so that the led goes out", "get the green light to stop"),
    ),
    "push_into_drawer": (
        (
            "(push|sweep|slide) the (object|block) into the (|open )drawer",
            "(push|sweep|slide) the (object|block) off the table into the drawer",
        ),
        (
            "shove a block over the edge so that it falls into the drawer",
            "let the block drop into the drawer by pushing it",
            "knock the block into the drawer",
        ),
    ),
}
"""Task to its patterns of training and of validation sentences; `(a|b|)` stands for a, b or nothing."""

_ALTERNATIVES = re.compile(r"\(([^()]*)\)")


def expand(pattern: str) -> list[str]:
    """All sentences that a pattern stands for, in order.

    >>> expand("(open|pull) the (|top )drawer")
    ['open the drawer', 'open the top drawer', 'pull the drawer', 'pull the top drawer']
    """
    inner = _ALTERNATIVES.search(pattern)
    if inner is None:
        return [" ".join(pattern.split())]
    before, after = pattern[: inner.start()], pattern[inner.end() :]
    return [s for choice in inner[1].split("|") for s in expand(before + choice + after)]


def _sentences(split: int) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, patterns in _GRAMMAR.items():
        colors = COLORS if "{color}" in name else ("",)
        sides = ("left", "right") if "{side}" in name else ("",)
        for color, side in itertools.product(colors, sides):
            filled = (pattern.format(color=color, side=side) for pattern in patterns[split])
            listed = dict.fromkeys(sentence for pattern in filled for sentence in expand(pattern))
            found[name.format(color=color, side=side)] = list(listed)
    return {task: found[task] for task in TASKS}


COMMANDS: dict[str, dict[str, list[str]]] = {"training": _sentences(0), "validation": _sentences(1)}
"""Split to task to sentences. Evaluations command a task by its first validation sentence, or by any of them."""


def load_commands(file: str | Path | None, split: str) -> dict[str, list[str]]:
    """Sentences by task: those of `file` for the tasks that it names, those of `COMMANDS` for the others.

    Args:
        file: YAML file in the form of CALVIN's annotations, task name to a sentence or a list of sentences; or None.
        split: `"training"` or `"validation"`.

    Raises:
        DeskError: The file is missing, has another form, or names an unknown task.
    """
    commands = dict(COMMANDS[split])
    if file is None:
        return commands
    path = Path(file)
    if not path.is_file():
        raise DeskError(f"annotations file {path} does not exist")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DeskError(f"annotations file {path} is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise DeskError(f"annotations file {path} must map task names to sentences, got {type(content).__name__}")
    for task, sentences in content.items():
        if task not in TASKS:
            raise DeskError(f"annotations file {path} names the unknown task {task!r}")
        listed = [sentences] if isinstance(sentences, str) else sentences
        if not isinstance(listed, list) or not listed or not all(isinstance(s, str) for s in listed):
            raise DeskError(f"annotations file {path}: {task} must be a sentence or a list of sentences")
        commands[task] = listed
    return commands
