"""`lerobot`: one command in front of LeRobot's own, with `key=value` options.

LeRobot 0.6 installs `lerobot-train`, `lerobot-eval`, … but no `lerobot`. This one only rewrites the options, then
becomes LeRobot's command.
"""

import os
import re
import sys
import sysconfig
from pathlib import Path

from .command import CommandError, run_command

HELP = """usage: lerobot COMMAND [key=value ...] [--option=value ...]

Runs LeRobot's own lerobot-COMMAND: key=value becomes --key=value; what starts with - is passed on unchanged.

    lerobot train policy=lansar dataset.repo_id=you/desk_D policy.use_images=false steps=3000
    lerobot eval policy=outputs/train/checkpoints/last/pretrained_model env=calvin env.control_mode=abs seed=0

policy=NAME is --policy.type=NAME; policy=FOLDER or policy=user/model is --policy.path=…;
env=NAME is --env.type=NAME. lerobot COMMAND --help lists a command's options.
"""


def commands() -> dict[str, Path]:
    """LeRobot's commands installed beside this Python or, as pip does where it may not write, for the user."""
    folders = [sysconfig.get_path("scripts", sysconfig.get_preferred_scheme("user")), sysconfig.get_path("scripts")]
    found = {path.stem.removeprefix("lerobot-"): path for f in folders for path in Path(f).glob("lerobot-*")}
    return dict(sorted(found.items()))


def translate(command: str, arguments: list[str]) -> list[str]:
    """Turns `key=value` into LeRobot's `--key=value`.

    Args:
        command: The word after `lerobot`.
        arguments: What follows it.

    Returns:
        The arguments of `lerobot-<command>`.

    Raises:
        CommandError: An argument is neither an option nor `key=value`.
    """
    translated = []
    for position, argument in enumerate(arguments):
        key, equals, value = argument.partition("=")
        if not re.fullmatch(r"[A-Za-z_][\w.]*", key):  # such as JSON that holds a "="
            equals = ""
        follows_option = (
            position > 0 and arguments[position - 1].startswith("--") and "=" not in arguments[position - 1]
        )
        positional = command == "find-cameras" and not equals  # LeRobot's only one
        if argument.startswith("-") or (follows_option and not equals) or positional:
            translated.append(argument)
        elif not equals:
            raise CommandError(f"{argument!r} is neither key=value nor an option; see `lerobot {command} --help`")
        elif key == "policy":
            # A checkpoint is a folder or user/model on the hub; only training makes a policy from its name.
            is_checkpoint = command == "eval" or "/" in value or Path(value).exists()
            translated.append(f"--policy.{'path' if is_checkpoint else 'type'}={value}")
        elif key == "env":
            translated.append(f"--env.type={value}")
        else:
            translated.append(f"--{argument}")
    return translated


def run() -> None:
    """Prints the help, or replaces this process by LeRobot's command.

    Raises:
        CommandError: LeRobot has no such command, or an argument cannot be translated.
        OSError: The command could not be started.
    """
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(HELP)
        print("Commands: " + ", ".join(commands()))
        return
    word, arguments = sys.argv[1], sys.argv[2:]
    if word not in commands():
        raise CommandError(f"there is no lerobot-{word} here; commands: {', '.join(commands())}")
    script = str(commands()[word])
    os.execv(script, [script, *translate(word, arguments)])


def main() -> int:
    """Entry point of `lerobot`."""
    return run_command("lerobot", run)


if __name__ == "__main__":
    sys.exit(main())
