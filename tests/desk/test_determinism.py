"""Same state and actions, same result, bit for bit, whatever happened before and wherever it happens."""

import gc
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pybullet as p
import pytest

from lerobot_lansar.desk import Desk, DeskError, SimulationError
from lerobot_lansar.desk.render import OURS
from lerobot_lansar.desk.starts import sample_start
from lerobot_lansar.envs import CalvinEnv
from lerobot_lansar.envs.configuration_calvin import ForkedVectorEnv

ZERO = np.array([0, 0, 0, 0, 0, 0, 1.0])
TOUCHING = "lift_red_block_table"


@pytest.fixture
def desk():
    with Desk("D", cameras=()) as desk:
        yield desk


def motion(desk, seed=0, steps=60):
    """A motion down to the table among the blocks; all states, (steps + 1, 39)."""
    rng = np.random.default_rng(seed)
    obs = [desk.reset(*sample_start(desk, TOUCHING, rng))]
    for _ in range(steps):
        obs.append(desk.step([*rng.uniform(-1, 1, 2), -0.6, *rng.uniform(-0.5, 0.5, 3), rng.choice([-1, 1])]))
    return np.array([np.concatenate([o["robot_obs"], o["scene_obs"]]) for o in obs])


def test_another_process_gives_the_same_bits(desk, tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import numpy as np; from test_determinism import *; "
        "np.save(sys.argv[2], motion(Desk('D', cameras=())))"
    )
    folder, file = Path(__file__).parent, tmp_path / "motion.npy"
    subprocess.run([sys.executable, "-c", code, str(folder), str(file)], check=True, timeout=120)
    np.testing.assert_array_equal(np.load(file), motion(desk))


def test_a_vector_environment_gives_the_same_bits(desk):
    vector = ForkedVectorEnv([lambda: CalvinEnv(TOUCHING, cameras=())] * 2)
    rng = np.random.default_rng(1)
    actions = np.array([[*rng.uniform(-1, 1, 6), 1] for _ in range(20)])
    try:
        obs, _ = vector.reset(seed=[5, 9])
        states = [obs["environment_state"]]
        for action in actions:
            states.append(vector.step(np.array([action, action]))[0]["environment_state"])
    finally:
        vector.close()
    for index, seed in enumerate((5, 9)):
        alone = [desk.reset(*sample_start(desk, TOUCHING, np.random.default_rng(seed)))]
        alone += [desk.step(action) for action in actions]
        expected = np.array([o["scene_obs"] for o in alone])
        np.testing.assert_array_equal(np.array([state[index] for state in states]), expected)


@pytest.mark.slow
def test_three_hundred_other_episodes_leave_nothing_behind(desk):
    first = motion(desk)
    rng = np.random.default_rng(8)
    for seed in range(300):
        desk.reset(seed=seed)
        for _ in range(5):
            desk.step(rng.uniform(-1, 1, 7))
    np.testing.assert_array_equal(motion(desk), first)


def test_a_saved_state_can_be_restored_even_on_another_desk(desk):
    motion(desk, steps=40)
    state = desk.save()
    actions = np.random.default_rng(3).uniform(-1, 1, (40, 7))
    after = [desk.step(action)["scene_obs"] for action in actions]
    with Desk("D", cameras=()) as other:
        for which, saved in ((desk, state), (other, pickle.loads(pickle.dumps(state)))):
            which.restore(saved)
            np.testing.assert_array_equal([which.step(action)["scene_obs"] for action in actions], after)
    with Desk("A", cameras=()) as other, pytest.raises(DeskError, match="saved in scene D"):
        other.restore(state)


def test_neither_other_episodes_nor_how_a_desk_was_loaded_change_a_motion(desk):
    # in the original both do: loading decides the order of contacts, and contacts survive a reset
    fresh = motion(desk)
    for target in ([0.1, -0.1, 0.4], [-0.1, 0.0, 0.42]):  # an episode that ends pressing on the table
        desk.reset(seed=1)
        for _ in range(40):
            desk.step([*target, np.pi, 0, 1.6, -1], control_mode="abs")
        np.testing.assert_array_equal(motion(desk), fresh)
    with Desk("D", cameras=()) as other:
        for _ in range(7):
            other.step(ZERO)
        np.testing.assert_array_equal(motion(other), fresh)


def test_desks_in_one_process_do_not_touch_each_other(desk):
    # in the original a second environment misses the pedestal in its pictures and mixes up bodies
    desk.reset(seed=1)
    picture = desk.render("static")
    with Desk("D", cameras=()) as twin, Desk("B", cameras=()) as other:
        twin.reset(seed=1)
        for camera in ("static", "gripper"):
            np.testing.assert_array_equal(twin.render(camera), desk.render(camera))
        before = other.reset(seed=0)["robot_obs"]
        np.testing.assert_array_equal(motion(twin), motion(desk))
        np.testing.assert_array_equal(other.observe()["robot_obs"], before)
        desk.reset(seed=1)
        np.testing.assert_array_equal(desk.render("static"), picture)


@pytest.mark.parametrize("renderer", [*OURS, "pybullet_tiny"])
def test_drawing_does_not_change_the_motion(desk, monkeypatch, renderer):
    fresh = motion(desk)
    with Desk("D", cameras=(), renderer=renderer) as drawn:
        draw_at_every_step(drawn, monkeypatch)
        np.testing.assert_array_equal(motion(drawn), fresh)


def draw_at_every_step(desk, monkeypatch):
    step = desk.step

    def step_and_draw(action, control_mode="rel"):
        obs = step(action, control_mode)
        desk.render("static"), desk.render("gripper")
        return obs

    monkeypatch.setattr(desk, "step", step_and_draw)


def test_a_diverging_simulation_is_an_error_and_a_reset_repairs_it(desk):
    with Desk("D", cameras=()) as neighbour:
        before = motion(desk, steps=5)
        desk.reset(seed=0)
        body = desk._blocks["red"].body
        p.resetBaseVelocity(body, [np.inf, 0, 0], physicsClientId=desk._client)
        with pytest.raises(SimulationError, match="reset the desk to go on"):
            desk.step(ZERO)
        np.testing.assert_array_equal(motion(neighbour, steps=5), before)
        np.testing.assert_array_equal(motion(desk, steps=5), before)


def resident() -> float:
    """Resident memory of this process in MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads this process's memory from Linux's /proc")
def test_two_thousand_episodes_and_fifty_desks_leak_nothing(desk):
    def episode(seed):
        desk.reset(seed=seed % 50)
        desk.step(ZERO)
        desk.completed_tasks(desk.snapshot())

    for seed in range(500):
        episode(seed)
    gc.collect()
    before = resident()
    for seed in range(2_000):
        episode(seed)
    gc.collect()
    assert resident() - before < 4
    desk.render()
    with Desk("D") as other:
        other.reset()
    gc.collect()
    before = resident()
    for _ in range(50):  # Bullet has room for 1024 clients, so desks must give theirs back
        with Desk("D") as other:
            other.reset()
    gc.collect()
    assert resident() - before < 30
