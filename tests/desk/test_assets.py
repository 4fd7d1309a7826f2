"""Where asset files come from: written for the built-in desk, checked for the original one."""

import os
import shutil
import subprocess
import sys

import pytest

from lerobot_lansar.desk import Desk, DeskError

FORKING = """
import multiprocessing, tempfile
from pathlib import Path
from lerobot_lansar.desk import Desk

def written():
    return sorted(file.name[: len("lansar_desk_D")] for file in Path(tempfile.gettempdir()).glob("lansar_desk_*"))

def child(scene):
    Desk("D").close()
    Desk(scene).close()

Desk("D", cameras=()).close()
for scene in "AB":
    process = multiprocessing.get_context("fork").Process(target=child, args=(scene,))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert written() == ["lansar_desk_D"], written()
with Desk("D") as desk:  # files and meshes are still there for the parent
    desk.observe()
Desk("D_eval").close()
assert written() == ["lansar_desk_D"], written()
"""


def test_built_in_files_are_written_once_per_process_and_removed_by_it_alone(tmp_path):
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", FORKING], check=True, timeout=120, env=environment)
    assert list(tmp_path.glob("lansar_desk_*")) == []


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("calvin_table_D/meshes/led_link.STL", None, r"led_link\.STL is missing"),
        ("calvin_table_D/textures/dark_wood.png", None, r"dark_wood\.png is missing"),
        (
            "calvin_table_D/meshes/base_link.obj",
            "version https://git-lfs.github.com/spec/v1\n",
            "git lfs pull",
        ),
    ],
)
def test_missing_and_unfetched_files_are_named(original_assets, tmp_path, name, content, message):
    folder = tmp_path / "data"
    shutil.copytree(original_assets, folder, copy_function=os.symlink)
    for path in (folder, *folder.rglob("*")):
        if path.is_dir():
            path.chmod(0o755)
    (folder / name).unlink()
    if content:
        (folder / name).write_text(content)
    with pytest.raises(DeskError, match=message):
        Desk("D", folder, cameras=())
