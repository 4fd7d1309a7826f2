"""Pictures of a desk, by four renderers behind one switch.

`fast` and `fast_gl` are ours (numba, no driver) in the two looks that PyBullet has; `tiny` and `egl` are
PyBullet's own and the reference for them.
"""

from collections.abc import Collection
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..cameras import Camera
from .bullet import BulletRenderer, Colors, load_egl

if TYPE_CHECKING:
    from .visuals import Visual

RENDERERS = ("fast", "fast_gl", "tiny", "egl")


class Renderer(Protocol):
    """Draws the present state of one Bullet client."""

    def draw(
        self, camera: Camera, view: np.ndarray, size: int, colors: Colors, keep: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `fast.FastRenderer.draw`."""


class Preparation:
    """What a renderer needs to be done before anybody asks for a picture.

    Args:
        name: One of `RENDERERS`.
        client: Bullet client, still empty: the EGL plugin draws only what is loaded after it.
    """

    def __init__(self, name: str, client: int):
        self._name, self._client = name, client
        self._plugin = load_egl(client) if name == "egl" else None
        self._round_boxes = name == "fast_gl"
        self._visuals: list[Visual] | None = None

    def loaded(self, temporary: bool) -> None:
        """To be called when all bodies are loaded; reads their shapes now if the files are `temporary`."""
        if temporary and self._name.startswith("fast"):
            from .visuals import read_visuals

            self._visuals = read_visuals(self._client, self._round_boxes)

    def open(self, repainted: Collection[tuple[int, int]]) -> Renderer:
        """The renderer; `repainted` names the (body, link) whose colours change.

        Raises:
            DeskError: A mesh cannot be read, or pybullet lacks numpy.
        """
        if not self._name.startswith("fast"):
            return BulletRenderer(self._client, self._plugin)
        # numba and its kernels take a second to load, which users without pictures need not wait for
        from .gl_look import OpenGLLook
        from .stage import Stage
        from .tiny_look import TinyLook
        from .visuals import read_visuals

        visuals = self._visuals or read_visuals(self._client, self._round_boxes)
        look = TinyLook if self._name == "fast" else OpenGLLook
        return look(Stage(self._client, visuals, repainted))
