"""The URDF files of a desk: from a calvin_env checkout's `data` folder, or generated from a scene's numbers."""

import re
import shutil
import tempfile
from dataclasses import dataclass
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path

from . import builtin
from .errors import DeskError
from .scenes import SCENES, Scene

_LFS = b"version https://git-lfs"


@dataclass(frozen=True)
class Assets:
    """URDF files of one scene, ready to load.

    Attributes:
        kind: `"built-in"` or `"original"`.
        robot, desk, plane: One URDF file each.
        blocks: Colour to URDF file.
        scale: Global scaling to load the desk and the blocks with.
    """

    kind: str
    robot: Path
    desk: Path
    plane: Path
    blocks: dict[str, Path]
    scale: float


def find_assets(scene: Scene, folder: str | Path | None) -> Assets:
    """Assets of `scene`: those in `folder`, or the built-in ones if it is None.

    Raises:
        DeskError: `folder` lacks a file that the scene needs.
    """
    return _built_in(scene.name) if folder is None else _original(scene, Path(folder))


@cache
def _built_in(name: str) -> Assets:
    """Writes the built-in files of a scene, once per process, into a folder that is removed when the process ends.

    `Finalize` rather than `atexit`: it also runs in multiprocessing's children, and a child that inherited a folder
    leaves it to its parent.
    """
    folder = Path(tempfile.mkdtemp(prefix=f"lansar_desk_{name}_"))
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)
    blocks = builtin.write(SCENES[name], folder)
    return Assets("built-in", folder / "robot.urdf", folder / "desk.urdf", folder / "plane.urdf", blocks, scale=1.0)


def _original(scene: Scene, folder: Path) -> Assets:
    assets = Assets(
        kind="original",
        robot=folder / "franka_panda" / "panda_longer_finger.urdf",
        desk=folder / f"calvin_table_{scene.name}" / "urdf" / f"calvin_table_{scene.name}.urdf",
        plane=folder / "plane" / "plane.urdf",
        blocks={c: folder / "blocks" / f"block_{c}_{size}.urdf" for c, size in scene.blocks.items()},
        scale=0.8,
    )
    for file in (assets.robot, assets.desk, assets.plane, *assets.blocks.values()):
        _check(file, scene)
        for mesh in sorted(set(re.findall(r'filename="([^"]+)"', file.read_text()))):
            _check(file.parent / mesh.removeprefix("package://"), scene)
    return assets


def _check(file: Path, scene: Scene) -> None:
    """Refuses files of which Bullet would not complain: missing textures, and Git LFS pointers (as empty meshes)."""
    if not file.is_file():
        raise DeskError(
            f"asset file {file} is missing; assets must name the `data` folder of a calvin_env checkout "
            f"(it holds franka_panda/, blocks/, plane/ and calvin_table_{scene.name}/), or be left out for "
            "the built-in desk"
        )
    with file.open("rb") as content:
        if content.read(len(_LFS)) == _LFS:
            raise DeskError(f"asset file {file} is a Git LFS pointer: run `git lfs pull` in the calvin_env checkout")
    material = file.with_suffix(".mtl")
    if file.suffix.lower() == ".obj" and material.is_file():
        for texture in re.findall(r"^\s*map_Kd\s+(\S+)", material.read_text(), re.MULTILINE):
            if "\\" not in texture:  # some collision meshes name a picture on their author's disk
                _check(file.parent / texture, scene)
