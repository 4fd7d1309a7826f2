"""Pictures of a desk, by four renderers behind one switch.

`fast` and `fast_gl` are ours (numba, no driver) and imitate the looks of `tiny` and `egl`, PyBullet's own renderers.

bullet           `tiny` and `egl`
fast             what our two renderers share
tiny_look        `fast`
gl_look          `fast_gl`
raster           compiled: which triangle is nearest at each pixel
shading          compiled: the colour of each pixel, in the two looks
stage            what there is to draw, and its present pose
visuals          the triangles, colours and textures of all bodies
kinematics       where links are, from joint positions
"""

from collections.abc import Collection
from typing import Protocol

import numpy as np

from ..cameras import Intrinsics
from .bullet import BulletRenderer, Colors, load_egl

__all__ = ["RENDERERS", "Colors", "Renderer", "load_egl", "open_renderer"]

RENDERERS = ("fast", "fast_gl", "tiny", "egl")


class Renderer(Protocol):
    """Draws the present state of one Bullet client."""

    def draw(
        self, intrinsics: Intrinsics, view: np.ndarray, size: int, colors: Colors, fixed: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `fast.FastRenderer.draw`."""


def open_renderer(
    name: str, client: int, repainted: Collection[tuple[int, int]], egl_plugin: int | None = None
) -> Renderer:
    """A renderer for a Bullet client in which all bodies are loaded.

    Args:
        name: One of `RENDERERS`.
        client: Bullet client.
        repainted: (body, link) whose colours change.
        egl_plugin: For `egl`: from `load_egl`.

    Raises:
        DeskError: A mesh cannot be read, or pybullet was built without numpy.
    """
    if not name.startswith("fast"):
        return BulletRenderer(client, egl_plugin)
    # late: numba and its kernels take a second to load, and not everybody needs pictures
    from .gl_look import OpenGLLook
    from .stage import Stage
    from .tiny_look import TinyLook
    from .visuals import read_visuals

    look = TinyLook if name == "fast" else OpenGLLook
    return look(Stage(client, read_visuals(client, round_boxes=name == "fast_gl"), repainted))
