"""Same state and actions, same result, whatever happened before; the original's own leftovers (golden/README.md)."""

import gc
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pybullet as p
import pytest

from lerobot_lansar.desk import Desk, DeskError, SimulationError
from lerobot_lansar.desk.robot import HOME_JOINTS
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
def test_a_thousand_other_episodes_leave_nothing_behind(desk):
    first = motion(desk)
    rng = np.random.default_rng(8)
    for seed in range(1000):
        desk.reset(seed=seed)
        for _ in range(5):
            desk.step(rng.uniform(-1, 1, 7))
    np.testing.assert_array_equal(motion(desk), first)


def test_a_saved_state_can_be_gone_back_to_even_on_another_desk(desk):
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


def test_the_motion_does_not_depend_on_how_the_desk_was_loaded(desk):
    # surprise 1: without deterministic pairs, what happened while loading decides
    desk.reset(seed=123)
    with Desk("D", cameras=()) as other:
        for _ in range(7):
            other.step(ZERO)
        np.testing.assert_array_equal(motion(other), motion(desk))


def test_a_reset_forgets_contacts(desk):
    # surprise 3: in the original the end of the last episode changes the next one
    fresh = motion(desk)
    for target in ([0.1, -0.1, 0.4], [-0.1, 0.0, 0.42]):
        desk.reset(seed=1)
        for _ in range(40):
            desk.step([*target, np.pi, 0, 1.6, -1], control_mode="abs")
        np.testing.assert_array_equal(motion(desk), fresh)


def test_a_second_desk_has_its_pedestal_and_bodies(desk):
    # surprise 5: in the original a second environment misses the pedestal and mixes up bodies
    picture = desk.render("static")
    with Desk("D", cameras=()) as other:
        np.testing.assert_array_equal(other.render("static"), picture)
        assert p.getNumBodies(physicsClientId=other._client) == p.getNumBodies(physicsClientId=desk._client)
        np.testing.assert_array_equal(motion(other), motion(desk))


def test_gripper_action_and_button_memory_do_not_survive_a_reset(desk):
    # surprise 6
    obs = desk.reset(seed=0)
    desk.step([0, 0, 0, 0, 0, 0, -1])
    assert desk.reset(seed=0)["robot_obs"][14] == 1
    closed = obs["robot_obs"].copy()
    closed[14] = -1
    assert desk.reset(closed)["robot_obs"][14] == -1
    pressed = obs["scene_obs"].copy()
    pressed[2] = 0.02
    desk.reset(None, pressed)
    assert desk.step(ZERO)["scene_obs"][5] == 1  # a button that is down at reset counts as a press
    desk.reset(None, obs["scene_obs"])
    assert desk.step(ZERO)["scene_obs"][5] == 0
    desk.reset(None, pressed)
    assert desk.step(ZERO)["scene_obs"][5] == 1, "the first press after a reset is swallowed"


def test_the_tcp_part_of_a_given_state_is_ignored(desk):
    # surprise 6: joints and half the width for each finger are used
    state = np.zeros(15)
    state[6], state[7:14], state[14] = 0.06, HOME_JOINTS, 1
    obs = desk.reset(state)["robot_obs"]
    np.testing.assert_allclose(obs[7:14], HOME_JOINTS, atol=1e-3)
    assert obs[6] == pytest.approx(0.06, abs=2e-3)
    np.testing.assert_allclose(obs[:3], desk.reset(None)["robot_obs"][:3], atol=1e-3)


def test_a_diverging_simulation_is_an_error_and_a_reset_mends_it(desk):
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
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="measures memory as Linux tells it")
def test_ten_thousand_episodes_and_a_hundred_desks_leak_nothing(desk):
    def episode(seed):
        desk.reset(seed=seed % 50)
        desk.step(ZERO)
        desk.completed_tasks(desk.snapshot())

    for seed in range(500):
        episode(seed)
    gc.collect()
    before = resident()
    for seed in range(10_000):
        episode(seed)
    gc.collect()
    assert resident() - before < 20
    desk.render()
    with Desk("D") as other:
        other.reset()
    gc.collect()
    before = resident()
    for _ in range(100):  # Bullet has room for 1024 clients, and not for many that are never given back
        with Desk("D") as other:
            other.reset()
    gc.collect()
    assert resident() - before < 60
