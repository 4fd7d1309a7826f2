"""The built-in desk: what users can rely on without any asset files."""

import numpy as np
import pytest

from lerobot_lansar.benchmark import load_chains
from lerobot_lansar.calvin import BLOCKS, BULB, BUTTON, COLORS, LED, SWITCH, TASKS
from lerobot_lansar.desk import SCENES, Desk, DeskError
from lerobot_lansar.desk.oracle import PLANK, TABLE
from lerobot_lansar.desk.robot import HOME_JOINTS
from lerobot_lansar.desk.scenes import BLOCK_SIDE, BUTTON_Y, SWITCH_TRAVEL, TABLE_Z
from lerobot_lansar.desk.starts import sample_start

ZERO = np.array([0, 0, 0, 0, 0, 0, 1.0])


@pytest.fixture
def desk():
    with Desk("D", cameras=()) as desk:
        yield desk


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
    poses = [[x, -0.10, TABLE_Z, 0, 0, 1.5] for x in (0.00, 0.07, 0.14)]
    with Desk(scene, cameras=()) as desk:
        desk.reset(scene_obs=[0.0] * 6 + [value for pose in poses for value in pose])
        for _ in range(20):
            obs = desk.step(ZERO)
        state = desk.snapshot()
    np.testing.assert_allclose(obs["scene_obs"][BLOCKS].reshape(3, 6)[:, :3], np.array(poses)[:, :3], atol=3e-3)
    for color, pose in zip(COLORS, poses, strict=True):
        assert state.blocks[color].position[0] == pytest.approx(pose[0], abs=3e-3)
    assert all(block.contacts == {("desk", "base_link")} for block in state.blocks.values())


def test_the_evaluation_layout_of_scene_d_is_fixed():
    with Desk("D_eval", cameras=()) as desk:
        for seed in (0, 1):
            desk.reset(seed=seed)
            for _ in range(30):
                obs = desk.step(ZERO)
            red, blue, pink = obs["scene_obs"][BLOCKS].reshape(3, 6)
            np.testing.assert_allclose(red[:2], [0.05, -0.12], atol=3e-3)
            np.testing.assert_allclose(blue[:3], [*red[:2], red[2] + BLOCK_SIDE], atol=4e-3)  # it lies on the red one
            np.testing.assert_allclose(pink[:2], [0.10, 0.08], atol=6e-3)  # the door pushes it a little
        assert desk.scene.name == "D"


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
        for z in (0.60, 0.46):
            for _ in range(25):
                pose = [desk.scene.button_x, BUTTON_Y, z, np.pi, 0, np.pi / 2]
                obs = desk.step([*pose, -1], control_mode="abs")
        leds.append(obs["scene_obs"][LED])
    assert leds == [1, 0]
    state[SWITCH] = SWITCH_TRAVEL
    desk.reset(scene_obs=state)
    assert desk.step(ZERO)["scene_obs"][BULB] == 1


def test_a_reset_sets_the_gripper_command_and_forgets_that_the_button_was_pressed(desk):
    obs = desk.reset(seed=0)
    desk.step([0, 0, 0, 0, 0, 0, -1])
    assert desk.reset(seed=0)["robot_obs"][14] == 1
    closed = obs["robot_obs"].copy()
    closed[14] = -1
    assert desk.reset(closed)["robot_obs"][14] == -1
    pressed = obs["scene_obs"].copy()
    pressed[BUTTON] = 0.02
    for _ in range(2):  # a button that is down at reset counts as a press, after every reset
        desk.reset(None, pressed)
        assert desk.step(ZERO)["scene_obs"][LED] == 1
        desk.reset(None, obs["scene_obs"])
        assert desk.step(ZERO)["scene_obs"][LED] == 0
    for led in (0, 1):  # unless the state is from the middle of an episode
        pressed[LED] = led
        desk.reset(None, pressed, continued=True)
        saved = desk.save()
        assert desk.step(ZERO)["scene_obs"][LED] == led
        desk.restore(saved)
        assert desk.step(ZERO)["scene_obs"][LED] == led


def test_a_reset_uses_joints_and_opening_width_and_ignores_the_tcp_pose(desk):
    state = np.zeros(15)
    state[6], state[7:14], state[14] = 0.06, HOME_JOINTS, 1
    obs = desk.reset(state)["robot_obs"]
    np.testing.assert_allclose(obs[7:14], HOME_JOINTS, atol=1e-3)
    assert obs[6] == pytest.approx(0.06, abs=2e-3)
    np.testing.assert_allclose(obs[:3], desk.reset(None)["robot_obs"][:3], atol=1e-3)


def test_every_block_of_the_benchmark_lies_on_something_when_the_first_command_is_given(desk):
    """The oracle wants a block that is to be lifted to lie on its surface then, not to float above it."""
    starts = {chain.scene_obs.tobytes(): chain for chain in load_chains()}
    assert len(starts) == 192
    for chain in starts.values():
        desk.reset(chain.robot_obs, chain.scene_obs)
        for block in desk.snapshot().blocks.values():
            assert block.contacts == {PLANK if block.position[1] > 0 else TABLE}


@pytest.mark.parametrize("task", TASKS)
def test_start_states_are_feasible_and_not_yet_fulfilled(desk, task):
    robot_obs, scene_obs = sample_start(desk, task, np.random.default_rng(11))
    obs = desk.reset(robot_obs, scene_obs)
    start = desk.snapshot()
    np.testing.assert_allclose(obs["robot_obs"][7:14], robot_obs[7:14], atol=0.02)
    assert task not in desk.completed_tasks(start)
    assert (len(start.touched_by_robot) == 1) == (TASKS[task].kind in ("place_block", "stack_block"))
    again = sample_start(desk, task, np.random.default_rng(11))
    np.testing.assert_array_equal(again[1], scene_obs)


@pytest.mark.parametrize(
    ("action", "mode", "message"),
    [
        ([0.0] * 6, "rel", r"shape \(7,\)"),
        ([0, 0, 0, 0, 0, np.nan, 1], "rel", "finite"),
        ([0, 0, np.inf, 0, 0, 0, 1], "abs", "finite"),
        ([0, 0, 101, 0, 0, 0, 1], "rel", r"within \+-100"),
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
    with pytest.raises(
        DeskError, match=r"renderer 'vulkan' is unknown; choose among gl, tiny, pybullet_gl, pybullet_tiny"
    ):
        Desk("D", renderer="vulkan")
    with pytest.raises(DeskError, match=r"panda_longer_finger\.urdf is missing"):
        Desk("D", assets=tmp_path)
    with pytest.raises(DeskError, match=r"scene_obs must have shape \(24,\)"):
        desk.reset(scene_obs=[0.0] * 23)
    with pytest.raises(DeskError, match="'juggle' is unknown"):
        sample_start(desk, "juggle", np.random.default_rng(0))
    desk.close()
    with pytest.raises(DeskError, match="closed"):
        desk.step(ZERO)
