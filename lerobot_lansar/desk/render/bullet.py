"""PyBullet's own two renderers: the reference for ours, and slower."""

import importlib.util
import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
import pybullet as p

from ..cameras import Intrinsics
from ..errors import DeskError

_PLUGIN = "_eglRendererPlugin"
Colors = dict[tuple[int, int], tuple[float, ...]]
"""(body, link) to rgba, 0 to 1."""


class BulletRenderer:
    """Draws with `getCameraImage`.

    Args:
        client: Bullet client.
        plugin: The EGL plugin's id in this client (`load_egl`), or None for TinyRenderer.

    Raises:
        DeskError: This pybullet was built without numpy.
    """

    def __init__(self, client: int, plugin: int | None = None):
        if not p.isNumpyEnabled():
            raise DeskError(
                "this pybullet was built without numpy, so its own cameras return Python tuples and are many times "
                "slower. Renderers gl and tiny need no numpy there. Build it again for the other two, as "
                "`make install` does in this package's checkout: `pip install 'numpy>=2.0,<2.3' 'setuptools<82' wheel "
                "&& pip install --no-build-isolation --no-binary pybullet --force-reinstall --no-cache-dir "
                "pybullet==3.2.7`"
            )
        self._client = client
        self._renderer = p.ER_TINY_RENDERER if plugin is None else p.ER_BULLET_HARDWARE_OPENGL
        self._shown: Colors = {}
        if plugin is not None:  # the plugin's first two pictures have no shadow
            for _ in range(2):
                self.draw(Intrinsics(60.0, 0.1, 10.0), np.eye(4), 16, {})

    def draw(
        self, intrinsics: Intrinsics, view: np.ndarray, size: int, colors: Colors, fixed: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `software.SoftwareRenderer.draw`."""
        for (body, link), color in colors.items():
            if self._shown.get((body, link)) != color:
                p.changeVisualShape(body, link, rgbaColor=color, physicsClientId=self._client)
                self._shown[body, link] = color
        near, far = intrinsics.near, intrinsics.far
        image: Any = p.getCameraImage(
            size,
            size,
            view.T.ravel().tolist(),
            p.computeProjectionMatrixFOV(intrinsics.fov, 1.0, near, far),
            renderer=self._renderer,
            physicsClientId=self._client,
        )
        picture = np.asarray(image[2], np.uint8).reshape(size, size, 4)[..., :3]
        buffer = np.asarray(image[3], np.float64).reshape(size, size)
        return picture, ((far - (far - near) * buffer) / (far * near)).astype(np.float32)


@cache
def _egl_works(plugin: str) -> bool:
    """Whether the plugin can be loaded; tried in another process, because without a driver it ends the process."""
    code = "import pybullet as p, sys; p.connect(p.DIRECT); sys.exit(p.loadPlugin(sys.argv[1], sys.argv[2]) < 0)"
    command = [sys.executable, "-c", code, plugin, _PLUGIN]
    try:
        return subprocess.run(command, capture_output=True, timeout=60).returncode == 0
    except subprocess.TimeoutExpired:  # a driver that hangs
        return False


def load_egl(client: int) -> int:
    """Loads the EGL plugin into a Bullet client, before any body: it draws only what is loaded later.

    Returns:
        The plugin's id.

    Raises:
        DeskError: The plugin, EGL or a driver for it is missing.
    """
    found = importlib.util.find_spec("eglRenderer")
    works = found is not None and found.origin is not None and _egl_works(found.origin)
    plugin = p.loadPlugin(found.origin, _PLUGIN, physicsClientId=client) if works and found else -1
    if plugin < 0:
        raise DeskError(
            "renderer pybullet_gl: pybullet's EGL plugin could not be loaded; it needs an OpenGL driver with EGL "
            "(Debian and Ubuntu: libegl1 and a GPU driver or libgl1-mesa-dri). Renderer gl has the look without one"
        )
    return plugin
