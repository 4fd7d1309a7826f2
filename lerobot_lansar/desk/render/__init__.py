"""Pictures of a desk, by four renderers behind one switch.

`gl` and `tiny` are ours: numba, one CPU core, no driver. `gl` has the look of CALVIN's public data, which a GPU drew
through PyBullet's OpenGL renderer; `tiny` that of PyBullet's TinyRenderer. `pybullet_gl` and `pybullet_tiny` are
PyBullet's own renderers, the reference for ours.

bullet           `pybullet_gl` and `pybullet_tiny`
software         what our two renderers share
gl_look          `gl`
tiny_look        `tiny`
raster           compiled: which face is nearest at each pixel, how high the casters of shadow are
shading          compiled: the colour of each pixel, in the two looks
geometry         all faces in flat arrays, in clusters that are skipped as a whole
stage            what there is to draw, and its present pose
visuals          the triangles, colours and textures of all bodies
kinematics       where links are, from joint positions
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Collection
from multiprocessing.util import Finalize
from typing import Protocol

import numpy as np

from ..cameras import Intrinsics
from .bullet import BulletRenderer, Colors, load_egl

__all__ = ["OURS", "RENDERERS", "Colors", "Renderer", "load_egl", "open_renderer"]

OURS = ("gl", "tiny")
"""Renderers that need no driver."""

RENDERERS = (*OURS, "pybullet_gl", "pybullet_tiny")


class Renderer(Protocol):
    """Draws the present state of one Bullet client."""

    def draw(
        self, intrinsics: Intrinsics, view: np.ndarray, size: int, colors: Colors, fixed: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `software.SoftwareRenderer.draw`."""


def _find_cache() -> None:
    """Lets numba keep compiled kernels in a temporary folder if it finds no other that it may write to.

    It wants the package's folder or one in the user's home. Processes started later use the same folder.
    """
    try:
        from . import kinematics  # noqa: F401
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        import numba

        folder = tempfile.mkdtemp(prefix="lansar_numba_")
        Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)
        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = folder  # type: ignore[attr-defined]
        print(
            "compiling for half a minute, as in each new run: set NUMBA_CACHE_DIR to a folder to keep it",
            file=sys.stderr,
        )


def open_renderer(
    name: str, client: int, repainted: Collection[tuple[int, int]], egl_plugin: int | None = None
) -> Renderer:
    """A renderer for a Bullet client in which all bodies are loaded.

    Args:
        name: One of `RENDERERS`.
        client: Bullet client.
        repainted: (body, link) whose colours change.
        egl_plugin: For `pybullet_gl`: from `load_egl`.

    Raises:
        DeskError: A mesh cannot be read, or pybullet was built without numpy.
    """
    if name not in OURS:
        return BulletRenderer(client, egl_plugin)
    # late: numba and its kernels take a second to load, and not everybody needs pictures
    _find_cache()
    from .gl_look import OpenGLLook
    from .stage import Stage
    from .tiny_look import TinyLook
    from .visuals import read_visuals

    look = TinyLook if name == "tiny" else OpenGLLook
    return look(Stage(client, read_visuals(client, round_boxes=name == "gl"), repainted))
