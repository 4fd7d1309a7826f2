"""Where a desk's bodies come from: a CALVIN checkout's `data` folder, or URDFs generated from a scene's numbers."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from . import builtin
from .errors import DeskError
from .scenes import Scene

_LFS = b"version https://git-lfs"


@dataclass(frozen=True)
class Assets:
    """URDF files of one scene, ready to load.

    Attributes:
        kind: `"built-in"` or `"original"`; every results file states it.
        scale: Global scaling to load the desk and the blocks with.
        temporary: The files go away once they are loaded.
    """

    kind: str
    robot: Path
    desk: Path
    plane: Path
    blocks: dict[str, Path]
    scale: float
    temporary: bool


@contextmanager
def open_assets(scene: Scene, folder: str | Path | None) -> Iterator[Assets]:
    """Assets of `scene`: those in `folder`, or built-in ones (written to a temporary folder) when it is None.

    Raises:
        DeskError: `folder` lacks a file that the scene needs.
    """
    if folder is not None:
        yield _original(scene, Path(folder))
        return
    with tempfile.TemporaryDirectory(prefix="lansar_desk_") as name:
        path = Path(name)
        files = builtin.write(scene, path)
        yield Assets("built-in", path / "robot.urdf", path / "desk.urdf", path / "plane.urdf", files, 1.0, True)


def _original(scene: Scene, folder: Path) -> Assets:
    assets = Assets(
        kind="original",
        robot=folder / "franka_panda" / "panda_longer_finger.urdf",
        desk=folder / f"calvin_table_{scene.name}" / "urdf" / f"calvin_table_{scene.name}.urdf",
        plane=folder / "plane" / "plane.urdf",
        blocks={c: folder / "blocks" / f"block_{c}_{size}.urdf" for c, size in scene.blocks.items()},
        scale=0.8,
        temporary=False,
    )
    for file in (assets.robot, assets.desk, assets.plane, *assets.blocks.values()):
        _check(file, scene)
        for mesh in sorted(set(re.findall(r'filename="([^"]+)"', file.read_text()))):
            _check(file.parent / mesh.removeprefix("package://"), scene)
    return assets


def _check(file: Path, scene: Scene) -> None:
    """Bullet says nothing of a missing texture, and loads a Git LFS pointer as an empty mesh."""
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
