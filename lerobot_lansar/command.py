"""What all `lansar-…` commands do alike: error messages, exit codes, Ctrl-C."""

import shlex
import subprocess
import sys
from collections.abc import Callable

from draccus.utils import DraccusException


class CommandError(Exception):
    """Something went wrong that the user can mend; the message says what and how."""


def run_command(name: str, function: Callable[[], int | None], resumable: bool = False) -> int:
    """Runs a command and turns what a user can mend into one line on the standard error stream.

    Args:
        name: The command's, with which its messages begin.
        function: Reads its options from `sys.argv`, as a function wrapped by `draccus.wrap` does.
        resumable: The same command goes on where it was interrupted.

    Returns:
        The exit code: what `function` returned (None is 0), 2 after an error, 130 after Ctrl-C.
    """
    try:
        return function() or 0
    except subprocess.CalledProcessError as error:
        message = f"{shlex.join(map(str, error.cmd))} failed: {error.stderr or error}"
    except (OSError, ValueError, CommandError, DraccusException) as error:
        message = str(error)
    except KeyboardInterrupt:
        hint = "; the same command goes on where it stopped" if resumable else ""
        print(f"{name}: interrupted{hint}", file=sys.stderr)
        return 130
    print(f"{name}: error: {message}", file=sys.stderr)
    return 2
