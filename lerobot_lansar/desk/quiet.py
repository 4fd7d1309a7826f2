"""Imports pybullet without the line that it prints at import: "pybullet build time: …"."""

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def discarded(descriptor: int) -> Iterator[None]:
    """Discards what native code writes to a file descriptor of this process meanwhile.

    What other threads write to it in that time is lost too. A descriptor that is closed stays closed.

    Args:
        descriptor: `STDERR`, or another one that native code does not buffer.
    """
    try:
        saved = os.dup(descriptor)
    except OSError:  # closed, as that of a daemon: there is nothing to discard
        yield
        return
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, descriptor)
        os.close(null)
        yield
    finally:
        os.dup2(saved, descriptor)
        os.close(saved)


def import_pybullet() -> None:
    """Imports pybullet. An exception passes; only the line that its C code prints is discarded."""
    if "pybullet" not in sys.modules:
        with discarded(STDERR):
            importlib.import_module("pybullet")


import_pybullet()
