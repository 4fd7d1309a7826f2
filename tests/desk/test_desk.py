"""The built-in desk: what a user may rely on without any asset files."""

import numpy as np
import pytest

from lerobot_lansar.calvin import TASKS
from lerobot_lansar.desk import SCENES, Desk, DeskError
from lerobot_lansar.desk.starts import sample_start

ZERO = np.array([0, 0, 0, 0, 0, 0, 1.0])


@pytest.fixture
def desk():
    with Desk("D", cameras=()) as desk:
        yield desk


def _trajectory(desk, start, seed=0, steps=60):
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, 7))
    obs = [desk.reset(*start)] + [desk.step(action) for action in actions]
    return np.array([np.concatenate([o["robot_obs"], o["scene_obs"]]) for o in obs])


def test_observation_has_calvins_shapes():
    with Desk("D") as desk:
        obs = desk.reset(seed=1)
    assert {key: value.shape for key, value in obs.items()} == {
        "robot_obs": (15,),
        "scene_obs": (24,),
        "rgb_static": (200, 200, 3),
        "rgb_gripper": (84, 84, 3),
    }
    assert obs["rgb_static"].dtype == np.uint8
    assert obs["rgb_static"].std() > 20
    assert obs["rgb_gripper"].std() > 20


@pytest.mark.parametrize("scene", SCENES)
def test_blocks_come_in_red_blue_pink_order_and_stay_where_they_are_put(scene):
    poses = [[x, -0.10, 0.46, 0, 0, 1.5] for x in (0.00, 0.07, 0.14)]
    with Desk(scene, cameras=()) as desk:
        desk.reset(scene_obs=[0.0] * 6 + [value for pose in poses for value in pose])
        for _ in range(20):
            obs = desk.step(ZERO)
        state = desk.snapshot()
    np.testing.assert_allclose(obs["scene_obs"][6:].reshape(3, 6)[:, :3], np.array(poses)[:, :3], atol=3e-3)
    for color, pose in zip(("red", "blue", "pink"), poses, strict=True):
        assert state.blocks[color].position[0] == pytest.approx(pose[0], abs=3e-3)
    assert all(block.contacts == {("desk", "base_link")} for block in state.blocks.values())


def test_the_evaluation_layout_of_scene_d_is_fixed():
    with Desk("D_eval", cameras=()) as desk:
        for seed in (0, 1):
            desk.reset(seed=seed)
            for _ in range(30):
                obs = desk.step(ZERO)
            red, blue, pink = obs["scene_obs"][6:].reshape(3, 6)
            np.testing.assert_allclose(red[:2], [0.05, -0.12], atol=3e-3)
            np.testing.assert_allclose(blue[:3], [*red[:2], red[2] + 0.04], atol=4e-3)  # it lies on the red one
            np.testing.assert_allclose(pink[:2], [0.10, 0.08], atol=6e-3)  # the door pushes it a little
        assert desk.scene.name == "D"


def test_same_state_and_actions_give_the_same_motion_after_other_episodes(desk):
    start = sample_start(desk, "stack_block", np.random.default_rng(5))
    first = _trajectory(desk, start)
    for seed in range(3):
        _trajectory(desk, sample_start(desk, "lift_pink_block_table", np.random.default_rng(seed)), seed)
    with Desk("D", cameras=()) as other:
        np.testing.assert_array_equal(_trajectory(desk, start), first)
        np.testing.assert_array_equal(_trajectory(other, start), first)


def test_two_desks_in_one_process_do_not_touch_each_other():
    with Desk("D", cameras=()) as a, Desk("B", cameras=()) as b:
        before = b.reset(seed=0)["robot_obs"]
        a.reset(seed=0)
        for _ in range(10):
            a.step([1, 0, 0, 0, 0, 0, -1])
        np.testing.assert_array_equal(b.observe()["robot_obs"], before)


def test_relative_action_of_one_moves_the_hand_by_two_centimetres(desk):
    x = desk.reset()["robot_obs"][0]
    desk.step([1, 0, 0, 0, 0, 0, 1])
    for _ in range(15):
        obs = desk.step(ZERO)
    assert obs["robot_obs"][0] - x == pytest.approx(0.02, abs=2e-3)


def test_absolute_action_brings_the_hand_to_the_pose(desk):
    desk.reset()
    target = [0.1, -0.2, 0.55, np.pi, 0.0, 1.4]
    for _ in range(40):
        obs = desk.step([*target, -1], control_mode="abs")
    np.testing.assert_allclose(obs["robot_obs"][:3], target[:3], atol=5e-3)
    assert obs["robot_obs"][6] < 0.01  # closed
    assert obs["robot_obs"][14] == -1


def test_button_toggles_the_led_once_per_press_and_the_switch_drives_the_bulb(desk):
    state = desk.reset(seed=0)["scene_obs"]
    leds = []
    for _ in range(2):
        for z, steps in ((0.60, 25), (0.46, 25)):
            for _ in range(steps):
                obs = desk.step([-0.12, -0.12, z, np.pi, 0, np.pi / 2, -1], control_mode="abs")
        leds.append(obs["scene_obs"][5])
    assert leds == [1, 0]
    state[3] = 0.088
    desk.reset(scene_obs=state)
    assert desk.step(ZERO)["scene_obs"][4] == 1


@pytest.mark.parametrize("task", TASKS)
def test_start_states_are_feasible_and_not_yet_fulfilled(desk, task):
    robot_obs, scene_obs = sample_start(desk, task, np.random.default_rng(11))
    obs = desk.reset(robot_obs, scene_obs)
    start = desk.snapshot()
    np.testing.assert_allclose(obs["robot_obs"][7:14], robot_obs[7:14], atol=0.02)
    assert task not in desk.completed_tasks(start)
    assert (len(start.touched_by_robot) == 1) == (task in ("place_in_slider", "place_in_drawer", "stack_block"))
    again = sample_start(desk, task, np.random.default_rng(11))
    np.testing.assert_array_equal(again[1], scene_obs)


@pytest.mark.parametrize(
    ("action", "mode", "message"),
    [
        ([0.0] * 6, "rel", r"shape \(7,\)"),
        ([0, 0, 0, 0, 0, np.nan, 1], "rel", "finite"),
        ([0, 0, np.inf, 0, 0, 0, 1], "abs", "finite"),
        (ZERO, "both", "'rel' or 'abs'"),
    ],
)
def test_unusable_actions_are_refused_and_change_nothing(desk, action, mode, message):
    before = desk.reset(seed=0)
    with pytest.raises(DeskError, match=message):
        desk.step(action, mode)
    np.testing.assert_array_equal(desk.observe()["robot_obs"], before["robot_obs"])


def test_errors_name_what_is_wrong(tmp_path, desk):
    with pytest.raises(DeskError, match="'E' is unknown; choose one of A, B, C, D"):
        Desk("E")
    with pytest.raises(DeskError, match="camera 'wrist' is unknown"):
        Desk("D", cameras=("wrist",))
    with pytest.raises(DeskError, match=r"panda_longer_finger\.urdf is missing"):
        Desk("D", assets=tmp_path)
    with pytest.raises(DeskError, match=r"scene_obs must have shape \(24,\)"):
        desk.reset(scene_obs=[0.0] * 23)
    with pytest.raises(DeskError, match="'juggle' is unknown"):
        sample_start(desk, "juggle", np.random.default_rng(0))
    desk.close()
    with pytest.raises(DeskError, match="closed"):
        desk.step(ZERO)


def test_a_camera_without_numpy_says_how_to_repair_it(monkeypatch):
    monkeypatch.setattr("pybullet.isNumpyEnabled", lambda: 0)
    with Desk("D", cameras=(), renderer="tiny") as desk, pytest.raises(DeskError, match="make install"):
        desk.render("static")
