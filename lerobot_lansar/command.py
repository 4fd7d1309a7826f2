"""What all commands of this package share: error messages, exit codes, Ctrl-C."""

import shlex
import subprocess
import sys
from collections.abc import Callable

import yaml
from draccus.utils import DraccusException


class CommandError(Exception):
    """An error that the user can fix; the message says what is wrong and what to do."""


def run_command(name: str, function: Callable[[], int | None], resumable: bool = False) -> int:
    """Runs a command; an error that the user can fix becomes one message on the standard error stream.

    Args:
        name: Name of the command; its messages begin with it.
        function: Does the work and reads its options from `sys.argv`, as a function wrapped by `draccus.wrap` does.
        resumable: Whether the same command goes on where it was interrupted.

    Returns:
        The exit code: what `function` returned (None counts as 0), 2 after an error, 130 after Ctrl-C.
    """
    try:
        return function() or 0
    except subprocess.CalledProcessError as error:
        message = _describe(error)
    except (OSError, ValueError, CommandError, DraccusException, yaml.YAMLError) as error:
        message = _explain(error)
    except KeyboardInterrupt:
        hint = "; the same command goes on where it stopped" if resumable else ""
        print(f"{name}: interrupted{hint}", file=sys.stderr)
        return 130
    print(f"{name}: error: {message}", file=sys.stderr)
    return 2


def _explain(error: Exception) -> str:
    """The message of an error; draccus hides behind its own what an options' class or a file's reader said."""
    if isinstance(error, yaml.YAMLError):
        return f"an option is not valid YAML (a list is written '[a,b]', in quotes): {' '.join(str(error).split())}"
    cause = error.__cause__ if isinstance(error, DraccusException) else None
    if cause is not None and not isinstance(cause, ValueError):
        return f"{error}: {' '.join(str(cause).split())}"
    from huggingface_hub.errors import HFValidationError  # late: it takes a tenth of a short command's start

    said = cause or error
    hub = isinstance(said, HFValidationError)
    return f"there is no such folder, nor can it be on the hub: {said}" if hub else str(said)


def _describe(error: subprocess.CalledProcessError) -> str:
    """The command line as typed in a shell, its exit code, and its own message where that was captured."""
    line = error.cmd if isinstance(error.cmd, str) else shlex.join(map(str, error.cmd))
    said = error.stderr.decode(errors="replace") if isinstance(error.stderr, bytes) else error.stderr
    return f"`{line}` failed with exit code {error.returncode}" + (f": {said.strip()}" if said else "")
