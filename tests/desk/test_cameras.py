"""Where the cameras are and what they see: `Desk.camera`, and the same from recorded states."""

import numpy as np
import pytest

from lerobot_lansar.cameras import Camera, gripper_camera_pose, intrinsics, static_camera_pose
from lerobot_lansar.desk import Desk, DeskError
from lerobot_lansar.desk.cameras import gripper_view, static_view
from lerobot_lansar.pictures import resize

TABLE = 0.44
"""Height of the table's surface (m) in every scene."""

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV's camera coordinates to OpenGL's, which a view matrix leads to."""


@pytest.fixture(scope="module")
def desk():
    with Desk(cameras=(), depth=True) as desk:
        yield desk


def test_the_static_camera_is_where_its_picture_is_drawn_from(desk):
    camera = desk.camera("static")
    np.testing.assert_allclose(OPENGL @ np.linalg.inv(camera.pose), static_view(), atol=1e-6)
    assert camera.size == 200
    assert np.linalg.det(camera.pose[:3, :3]) == pytest.approx(1)


def test_the_gripper_camera_is_where_its_picture_is_drawn_from_even_in_motion(desk):
    rng = np.random.default_rng(0)
    obs = desk.reset()
    for step in range(120):
        if step % 30 == 29:
            joints = np.r_[obs["robot_obs"][:7], rng.uniform(-1, 1, 7) * 0.3 + obs["robot_obs"][7:14], 1]
            obs = desk.reset(joints)
        else:
            obs = desk.step([*rng.uniform(-1, 1, 6), 1])
        drawn = gripper_view(*desk._robot.camera_pose())
        for pose in (desk.camera("gripper").pose, gripper_camera_pose(obs["robot_obs"].astype(np.float32))):
            np.testing.assert_allclose(OPENGL @ np.linalg.inv(pose), drawn, atol=1e-5)


def test_states_in_any_number_give_a_pose_each(desk):
    states = np.stack([desk.reset()["robot_obs"], desk.step([1, 1, 1, 1, 1, 1, 1])["robot_obs"]])
    poses = gripper_camera_pose(states)
    assert poses.shape == (2, 4, 4)
    np.testing.assert_array_equal(poses[1], gripper_camera_pose(states[1]))
    assert gripper_camera_pose(np.zeros((0, 15))).shape == (0, 4, 4)


@pytest.mark.parametrize(("name", "size", "own"), [("static", 128, 200), ("gripper", 84, 84), ("gripper", 128, 84)])
def test_intrinsics_are_those_of_a_pictures_size(desk, name, size, own):
    desk.reset(seed=1)
    camera = desk.camera(name, size)
    points = camera.points(resize(desk.render_depth(name), size))
    again = (points - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    pixels = again @ camera.intrinsics.T
    rows, columns = np.indices((size, size))
    np.testing.assert_allclose(pixels[..., 0] / pixels[..., 2], columns, atol=1e-6)
    np.testing.assert_allclose(pixels[..., 1] / pixels[..., 2], rows, atol=1e-6)
    np.testing.assert_allclose(intrinsics(name)[0, 0] / own, camera.intrinsics[0, 0] / size)
    assert height_of_table(points) == pytest.approx(TABLE, abs=0.003)


def height_of_table(points):
    """The height (m) at which most points near the table lie."""
    heights = points[..., 2][np.abs(points[..., 2] - TABLE) < 0.05]
    counts, edges = np.histogram(heights, bins=np.arange(TABLE - 0.05, TABLE + 0.05, 0.001))
    return edges[counts.argmax()] + 0.0005


def test_unknown_cameras_and_sizes_are_refused(desk):
    with pytest.raises(DeskError, match="camera 'wrist' is unknown"):
        desk.camera("wrist")
    with pytest.raises(DeskError, match="size must be a positive"):
        desk.camera("static", 0)


def interpolated(image, column, row):
    """Values of an (n, n, k) image between pixels."""
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    x, y = (column - left)[:, None], (row - top)[:, None]
    upper = image[top, left] * (1 - x) + image[top, left + 1] * x
    return upper * (1 - y) + (image[top + 1, left] * (1 - x) + image[top + 1, left + 1] * x) * y


def test_both_cameras_of_calvins_public_data_see_one_world(golden):
    frame = np.load(golden / "real" / "episode_0358482.npz")
    static = Camera("static", 200, intrinsics("static"), static_camera_pose())
    gripper = Camera("gripper", 84, intrinsics("gripper"), gripper_camera_pose(frame["robot_obs"]))
    one, other = static.points(frame["depth_static"]), gripper.points(frame["depth_gripper"]).reshape(-1, 3)
    for points in (one, other):
        assert height_of_table(points) == pytest.approx(TABLE, abs=0.001)
    seen = (other - static.pose[:3, 3]) @ static.pose[:3, :3] @ static.intrinsics.T
    column, row = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    inside = (column >= 0) & (column < 199) & (row >= 0) & (row < 199)
    met = interpolated(one, column[inside], row[inside])
    apart = np.linalg.norm(met - other[inside], axis=1)
    both_see_it = apart < 0.02
    assert both_see_it.mean() > 0.8
    assert np.median(apart[both_see_it]) < 0.0005
