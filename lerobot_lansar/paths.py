"""`lansar-path`: the files and checkpoints that this package ships, found by name from any folder."""

import argparse
import difflib
import sys
from pathlib import Path

from .command import CommandError, run_command

CONFIGS = "configs"
"""The folder of configuration files, at the repository's top; a wheel carries it inside `lerobot_lansar`."""

CHECKPOINTS = "checkpoints"
"""The folder in `lerobot_lansar` that holds trained policies."""


def shipped() -> dict[str, Path]:
    """All shipped files and checkpoints by name.

    A file's name is its path without `.yaml`, such as `configs/thesis/baseline`; a checkpoint's is that of its folder,
    such as `checkpoints/desk-d`.
    """
    package = Path(__file__).parent
    top = package if (package / CONFIGS).is_dir() else package.parent
    checkpoints = sorted(file.parent for file in (package / CHECKPOINTS).glob("*/config.json"))
    files = sorted((top / CONFIGS).rglob("*.yaml"))
    named = {f"{CHECKPOINTS}/{folder.name}": folder for folder in checkpoints}
    return named | {file.relative_to(top).as_posix().removesuffix(".yaml"): file for file in files}


def shipped_path(name: str) -> Path:
    """The path of one shipped file or checkpoint.

    Args:
        name: One of `shipped`, with or without `.yaml`.

    Raises:
        CommandError: Nothing of that name is shipped; the message lists similar names.
    """
    files, name = shipped(), name.removesuffix(".yaml")
    if name in files:
        return files[name]
    raise CommandError(f"nothing named {name!r} is shipped; {_advice(name, list(files))}")


def _advice(name: str, names: list[str]) -> str:
    """Which of `names` may be meant: those that contain the last word of `name`, or else words spelled like it."""
    words = {known.rpartition("/")[2]: known for known in names}
    word = name.rpartition("/")[2]
    near = [words[known] for known in words if word and word in known]
    near = near or [words[known] for known in difflib.get_close_matches(word, words)]
    return f"did you mean {' or '.join(near)}?" if near else "lansar-path without a name lists what there is"


def run() -> None:
    """Prints the path of the named file, or all names.

    Raises:
        CommandError: Nothing of that name is shipped.
    """
    parser = argparse.ArgumentParser(
        prog="lansar-path",
        description="Prints the path of a file or checkpoint that this package ships, for use in other commands: "
        "lerobot-train --config_path=$(lansar-path configs/thesis/baseline)",
    )
    parser.add_argument("name", nargs="?", help="such as configs/lansar; without it, all names are listed")
    name = parser.parse_args().name
    print("\n".join(shipped()) if name is None else shipped_path(name))


def main() -> int:
    """Entry point of `lansar-path`."""
    return run_command("lansar-path", run)


if __name__ == "__main__":
    sys.exit(main())
