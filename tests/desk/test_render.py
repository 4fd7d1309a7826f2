"""Our renderers against PyBullet's."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_lansar.desk import SCENES, Desk, DeskError
from lerobot_lansar.desk.render import OURS, raster
from lerobot_lansar.desk.render.geometry import Geometry
from lerobot_lansar.desk.render.stage import Group
from lerobot_lansar.desk.render.visuals import Mesh, Visual, load_mesh

CAMERAS = ("static", "gripper")


def along_a_motion(desk, states=4):
    """Pictures and depths of some states of a motion with contacts."""
    rng = np.random.default_rng(3)
    desk.reset(seed=2)
    for _ in range(states):
        for _ in range(15):
            desk.step([*rng.uniform(-1, 1, 2), -0.5, *rng.uniform(-1, 1, 3), rng.choice([-1, 1])])
        for camera in CAMERAS:
            yield camera, desk.render(camera).astype(int), desk.render_depth(camera)
    tilted = desk.reset(seed=2)["robot_obs"]
    for angle in (0.6, 2.4, 3.2):  # the hand looks at the floor and past it
        tilted[12] = angle
        desk.reset(tilted)
        yield "gripper", desk.render("gripper").astype(int), desk.render_depth("gripper")


def compare(scene, assets, ours, reference):
    """Maxima over the states: mean difference of each camera's pictures, share of pixels with over 1 % other depth."""
    colors, depths = {c: [] for c in CAMERAS}, []
    with Desk(scene, assets, (), ours) as one, Desk(scene, assets, (), reference) as other:
        for (camera, picture, depth), (_, expected, far) in zip(
            along_a_motion(one), along_a_motion(other), strict=True
        ):
            colors[camera].append(np.abs(picture - expected).mean())
            depths.append((np.abs(depth / far - 1) > 0.01).mean())
    return {camera: max(values) for camera, values in colors.items()}, max(depths)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("kind", ["built-in", "original"])
def test_tiny_draws_what_tinyrenderer_draws(request, scene, kind):
    assets = request.getfixturevalue("original_assets") if kind == "original" else None
    colors, depth = compare(scene, assets, "tiny", "pybullet_tiny")
    assert colors["static"] < 0.02
    assert colors["gripper"] < 0.02
    assert depth < 1e-3


@pytest.fixture(scope="module")
def egl():
    try:
        Desk("D", cameras=(), renderer="pybullet_gl").close()
    except DeskError as error:
        pytest.skip(str(error))


def test_without_a_driver_egl_is_an_error_and_not_a_crash():
    code = (
        "from lerobot_lansar.desk import Desk, DeskError\n"
        "try: Desk('D', renderer='pybullet_gl')\n"
        "except DeskError as error: print('said:', error)"
    )
    environment = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent", "EGL_PLATFORM": "nothing"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0
    if "said:" not in done.stdout:
        pytest.skip("this machine's EGL works whatever the environment says")
    assert "Renderer gl has the look without one" in done.stdout


@pytest.mark.parametrize("scene", [*SCENES, "built-in D"])
def test_gl_draws_what_the_plugin_draws(request, egl, scene):
    # A software driver has coarse depth and filters textures otherwise than the GPU that recorded CALVIN's data.
    assets = None if scene.startswith("built-in") else request.getfixturevalue("original_assets")
    colors, depth = compare(scene[-1], assets, "gl", "pybullet_gl")
    assert colors["static"] < 2.5
    assert colors["gripper"] < 3
    assert depth < 0.02


def test_gl_draws_what_the_plugin_once_drew():
    # for machines without a driver: pictures that the plugin drew with Mesa 22.3's software driver
    with Desk("D", cameras=(), renderer="gl") as desk:
        desk.reset(seed=5)
        for _ in range(25):
            desk.step([0.2, 0.1, -0.3, 0, 0, 0.2, 1])
        for camera, bound in (("static", 1.5), ("gripper", 2.5)):
            with Image.open(Path(__file__).parent / "data" / f"egl_D_{camera}.png") as image:
                expected = np.asarray(image).astype(int)
            assert np.abs(desk.render(camera) - expected).mean() < bound


def test_gl_draws_what_calvins_public_data_show(golden, original_assets):
    frame = np.load(golden / "real" / "episode_0358482.npz")
    with Desk("D", original_assets, renderer="gl", depth=True) as desk:
        obs = desk.reset(frame["robot_obs"], frame["scene_obs"])
    for camera in CAMERAS:
        difference = np.abs(obs[f"rgb_{camera}"].astype(int) - frame[f"rgb_{camera}"])
        assert difference.mean() < 0.2, camera
        assert (difference.max(-1) > 2).mean() < 0.01, camera
        assert np.abs(obs[f"depth_{camera}"] - frame[f"depth_{camera}"]).mean() < 0.0005, camera


def along_changes(desk):
    """Pictures and depths while one thing of the scene after the other changes under the standing camera."""
    robot, scene = (desk.reset(seed=4)[key] for key in ("robot_obs", "scene_obs"))
    home = scene.copy()
    for place, value in ((0, 0.2), (1, 0.15), (2, 0.02), (3, 0.08), (4, 1), (5, 1), (6, 0.1), (13, -0.2), (20, 0.7)):
        scene[place] = value  # slide, drawer, button, switch, bulb, LED, then a number of each block's pose
        desk.reset(robot, scene)
        yield "static", desk.render("static").astype(int), desk.render_depth("static")
    desk.reset(robot, home)
    yield "static", desk.render("static").astype(int), desk.render_depth("static")


@pytest.mark.parametrize("renderer", OURS)
@pytest.mark.parametrize(("path", "kind"), [(along_a_motion, "built-in"), (along_changes, "built-in"),
                                            (along_changes, "original")])  # fmt: skip
def test_skipping_and_remembering_change_no_pixel(request, renderer, path, kind):
    """The simple way: every face of every link looked at, everything drawn anew in every picture."""
    assets = request.getfixturevalue("original_assets") if kind == "original" else None
    with Desk("A", assets, (), renderer) as quick, Desk("A", assets, (), renderer) as simple:
        simple.render()
        simple._renderer._geometry.cones[:, 7] = 2  # no cluster is skipped
        draw = simple._renderer.draw
        simple._renderer.draw = lambda *arguments: draw(*arguments[:-1], False)  # no camera stands still
        before = np.zeros(())
        for (_, picture, depth), (_, expected, far) in zip(path(quick), path(simple), strict=True):
            np.testing.assert_array_equal(picture, expected)
            np.testing.assert_array_equal(depth, far)
            assert not np.array_equal(before, picture), "what changed is seen"
            before = picture


def test_lights_change_the_picture_at_any_size():
    with Desk("D", cameras=()) as desk:
        off = desk.reset(seed=0)["scene_obs"]
        dark = desk.render("static", 64)
        on = off.copy()
        on[4:6] = 1
        desk.reset(None, on)
        assert dark.shape == (64, 64, 3)
        changed = np.abs(desk.render("static", 64).astype(int) - dark).max(-1) > 50
        assert 0 < changed.mean() < 0.05
        desk.reset(None, off)
        np.testing.assert_array_equal(desk.render("static", 64), dark)


def test_observations_hold_depth_when_asked():
    with Desk("B", cameras=("gripper",), depth=True) as desk:
        obs = desk.reset()
    assert obs["depth_gripper"].shape == (84, 84)
    assert obs["depth_gripper"].dtype == np.float32
    assert 0.01 < obs["depth_gripper"].min() < obs["depth_gripper"].max() <= 2


def test_a_triangle_that_reaches_behind_the_eye_is_cut_at_the_near_plane():
    # a floor that passes under the eye, 1 m below it, seen by a camera that looks along it
    size = 32
    vertices = np.array([[-9, -1, 20], [9, -1, 20], [9, -1, -5], [-9, -1, -5]], np.float32)
    projection = np.array([[16, 0, 16, 0], [0, 16, 16, 0], [0, 0, 1, 0]], np.float64)[None]
    inverse_depth = np.zeros((size, size), np.float32)
    ids = np.full((size, size), raster.NOTHING, np.int32)
    for faces in ([[0, 1, 2], [0, 2, 3]], [[2, 1, 0], [3, 2, 0]]):  # one of them is seen from behind
        blank = np.zeros((2, 3, 3), np.float32)
        mesh = Mesh(vertices, np.array(faces, np.int32), blank, blank[..., :2])
        g = Geometry([Group(0, -1, [Visual(0, -1, mesh, (1, 1, 1, 1))], False, False)])
        limits = np.float32(0.1), np.float32(4.5)
        matrices, eyes = projection.astype(np.float32), np.zeros((1, 3))
        raster.nearest(
            np.array([0]),
            matrices,
            eyes,
            g.spheres,
            g.ranges,
            g.cones,
            g.corners,
            g.ranks,
            limits,
            np.float32(0),
            True,
            inverse_depth,
            ids,
        )
    rows = np.arange(size) - 16
    expected = np.where((rows < 0) & (rows <= -16 / 4.5), -rows / 16, 0)  # 1 / distance of the floor, up to 4.5 m
    np.testing.assert_allclose(inverse_depth, np.repeat(expected[:, None], size, 1), atol=1e-6)


def test_the_pieces_of_a_mesh_keep_the_files_order(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n")
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
        "o one\nusemtl a\nf 1 2 3\no two\nusemtl b\nf 1 2 4\nf 2 3 4\no three\nusemtl a\nf 1 3 4\n"
    )
    mesh = load_mesh(str(tmp_path / "m.obj"))
    corners = mesh.vertices[mesh.faces].sum(1)
    np.testing.assert_array_equal(corners, [[1, 1, 0], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    np.testing.assert_allclose(mesh.normals[0], [[0, 0, 1]] * 3)
    assert mesh.texture is None


def test_meshes_that_cannot_be_read_are_named(tmp_path):
    for name in ("a.dae", "b.stl"):
        (tmp_path / name).write_bytes(b"nothing")
        with pytest.raises(DeskError, match=name):
            load_mesh(str(tmp_path / name))
    (tmp_path / "c.obj").write_text("version https://git-lfs.github.com/spec/v1\n")
    for name in ("c.obj", "absent.obj", "absent.stl"):
        with pytest.raises(DeskError, match=name):
            load_mesh(str(tmp_path / name))


def test_a_camera_without_numpy_says_how_to_repair_it(monkeypatch):
    monkeypatch.setattr("pybullet.isNumpyEnabled", lambda: 0)
    with Desk("D", cameras=(), renderer="pybullet_tiny") as desk, pytest.raises(DeskError, match="make install"):
        desk.render("static")
