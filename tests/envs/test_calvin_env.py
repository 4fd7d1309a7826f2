"""The gymnasium environment: chains, single tasks, rewards, ends of episodes, vector environments."""

import json

import gymnasium
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env

import lerobot_lansar  # noqa: F401  (registers the environment)
from lerobot_lansar.benchmark import EPISODES_FILE, load_chains
from lerobot_lansar.calvin import TASKS
from lerobot_lansar.demos.motion import Motion
from lerobot_lansar.demos.moves import View
from lerobot_lansar.demos.skills import SKILLS
from lerobot_lansar.desk import DeskError
from lerobot_lansar.envs import CalvinEnv

NOTHING = np.array([0, 0, 0, 0, 0, 0, 1.0])


def script(env, obs, tasks, seed=0):
    """Carries out `tasks` in turn with the demonstrator's skills; yields what each step returned."""
    for task in tasks:
        state = obs["agent_pos"], obs["environment_state"][:24]
        view = View(env.unwrapped._desk.scene, *state, np.random.default_rng(seed))
        motion = Motion(view.robot_obs, 1.0)
        for waypoint in SKILLS[task](view):
            for held in range(70):
                distance, turn = motion.error(waypoint, view.robot_obs)
                if distance < waypoint.tolerance and turn < 0.12 and held >= waypoint.hold:
                    break
                result = env.step(motion.toward(waypoint, view.robot_obs))
                obs = result[0]
                view.robot_obs, view.scene_obs = obs["agent_pos"], obs["environment_state"][:24]
                yield result
                if result[1] or result[2]:
                    break
            if result[1] or result[2]:
                break


@pytest.mark.parametrize("mode", ["rel", "abs"])
def test_passes_gymnasiums_checker(mode):
    env = gymnasium.make("lerobot_lansar/Calvin-v0", control_mode=mode, cameras=("gripper",))
    check_env(env.unwrapped)
    env.close()


def test_seed_chooses_the_chain_and_reset_without_seed_does_not_count_chains():
    env = CalvinEnv(cameras=())
    for seed, chain in ((0, 0), (1007, 7), (7, 7)):
        obs, _ = env.reset(seed=seed)
        np.testing.assert_allclose(obs["environment_state"][:2], load_chains()[chain].scene_obs[:2], atol=1e-3)
        assert env._commands == load_chains()[chain].tasks
    env.reset(seed=3)
    env.reset()
    env.reset(seed=4)
    assert env._chain == 4
    env.close()


def test_a_chain_rewards_each_fulfilled_command_and_changes_the_sentence(tmp_path):
    # the first chain that starts with two tasks that the demonstrator knows
    chain, tasks = next(
        (k, chain.tasks) for k, chain in enumerate(load_chains()) if set(chain.tasks[:2]) <= set(SKILLS)
    )
    env = CalvinEnv(
        control_mode="abs", cameras=(), steps_per_command=200, results_dir=str(tmp_path), task_in_state=True
    )
    obs, info = env.reset(seed=chain)
    sentences, rewards, told = [env.task_description], [], [obs["environment_state"][24:]]
    for result in script(env, obs, tasks[:2]):
        rewards.append(result[1])
        sentences.append(env.task_description)
        told.append(result[0]["environment_state"][24:])
        assert not result[3]
    obs, _, terminated, _, info = result
    assert sum(rewards) == 2
    assert info == {"is_success": False, "successes": 2}
    assert list(dict.fromkeys(sentences)) == [env._sentences[task][0] for task in tasks[:3]]
    assert (np.sum(told, axis=1) == 1).all()
    named = [list(TASKS)[number] for number in np.argmax(told, axis=1)]
    assert [env._sentences[task][0] for task in named] == sentences
    steps = 0
    while not terminated:
        stay = np.concatenate([obs["agent_pos"][:6], [1]])
        obs, reward, terminated, _, _ = env.step(stay)
        steps += 1
    assert steps == 200
    assert reward == 0
    (line,) = (tmp_path / EPISODES_FILE).read_text().splitlines()
    episode = json.loads(line)
    assert episode["chain"] == chain
    assert episode["successes"] == 2
    assert [c["success"] for c in episode["commands"]] == [True, True, False]
    assert episode["commands"][2]["steps"] == 200
    env.close()


@pytest.mark.parametrize("task", ["open_drawer", "turn_off_led", "lift_red_block_table"])
def test_single_task_succeeds_when_the_oracle_says_so(task):
    env = CalvinEnv(task, control_mode="abs", cameras=())
    obs, info = env.reset(seed=1)
    assert not info["is_success"]
    *_, (obs, reward, terminated, _, info) = script(env, obs, [task])
    assert (reward, terminated, info["is_success"]) == (1.0, True, True)
    env.close()


def test_an_episode_depends_on_its_seed_alone():
    def episode(env, seed):
        obs, _ = env.reset(seed=seed)
        states = [obs["environment_state"]]
        for _ in range(10):
            states.append(env.step(NOTHING)[0]["environment_state"])
        return np.array(states)

    a, b = CalvinEnv("stack_block", cameras=()), CalvinEnv("stack_block", cameras=())
    first = episode(a, 5)
    episode(b, 6)
    np.testing.assert_array_equal(episode(b, 5), first)
    a.close()
    b.close()


def test_actions_of_the_other_control_mode_are_refused_at_once():
    env = CalvinEnv("open_drawer", cameras=(), control_mode="rel")
    obs, _ = env.reset(seed=0)
    with pytest.raises(DeskError, match=r"--env\.control_mode=abs"):
        env.step(np.concatenate([obs["agent_pos"][:6], [1]]))
    env.close()
    env = CalvinEnv("open_drawer", cameras=(), control_mode="abs")
    env.reset(seed=0)
    with pytest.raises(DeskError, match=r"--env\.control_mode=rel"):
        env.step([0.3, -0.2, 0.9, 0, 0, 0.4, 1])
    env.close()


def test_a_diverged_episode_fails_and_the_next_one_is_unaffected():
    env = CalvinEnv("turn_on_led", cameras=())
    first, _ = env.reset(seed=3)
    env.render()
    red = env._desk._blocks["red"].body
    pybullet.resetBaseVelocity(red, [np.inf, 0, 0], physicsClientId=env._desk._client)
    obs, reward, terminated, _, info = env.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    assert terminated
    assert reward == 0
    assert not info["is_success"]
    assert np.isfinite(obs["environment_state"]).all()
    assert env.render().shape == (200, 200, 3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(again["environment_state"], first["environment_state"])
    env.close()


def test_an_episode_that_ended_cannot_be_stepped_on():
    env = CalvinEnv("open_drawer", cameras=(), steps_per_command=1)
    env.reset(seed=0)
    assert env.step(NOTHING)[2]
    with pytest.raises(DeskError, match="reset the environment"):
        env.step(NOTHING)
    env.close()


@pytest.mark.parametrize("mode", ["rel", "abs"])
def test_every_kth_action_is_perturbed_as_equation_4_9_says(mode, monkeypatch):
    options = {"control_mode": mode, "perturbation_every": 3, "perturbation_scale": 5.0}
    env = CalvinEnv("open_drawer", cameras=(), **options)
    obs, _ = env.reset(seed=1)
    given = [np.array([0.4, 0.0, -0.2, 0, 0, 0.1, 1.0]) for _ in range(9)]
    done = []
    step = env._desk.step
    monkeypatch.setattr(env._desk, "step", lambda action, m: done.append(action) or step(action, m))
    for k, action in enumerate(given):
        if mode == "abs":
            given[k] = action = np.r_[obs["agent_pos"][:3] + 0.02 * action[:3], obs["agent_pos"][3:6], 1]
        before = obs["agent_pos"][:3]
        obs = env.step(action)[0]
        if k % 3 == 2:
            origin = before if mode == "abs" else 0
            difference, wanted = done[k][:3] - origin, given[k][:3] - origin
            assert (difference[[0, 2]] != wanted[[0, 2]]).all()
            assert difference[1] == pytest.approx(0, abs=1e-12)  # sigma is proportional to the difference
            np.testing.assert_array_equal(done[k][3:], given[k][3:])
        else:
            np.testing.assert_array_equal(done[k], given[k])
    monkeypatch.undo()
    env.reset(seed=1)
    draws = [env._perturbed(np.array([1.0, 1, 1, 0, 0, 0, 1]))[:3] for _ in range(2000)]
    if mode == "rel":
        assert np.mean(draws) == pytest.approx(1, abs=0.3)
        assert np.std(draws) == pytest.approx(5, rel=0.05)
    env.close()


def test_perturbations_depend_on_the_seed_alone():
    draws = []
    for seed in (4, 4, 5):
        env = CalvinEnv("open_drawer", cameras=(), perturbation_every=1, perturbation_scale=1.0)
        env.reset(seed=seed)
        draws.append(env._perturbed(np.ones(7))[0])
        env.close()
    assert draws[0] == draws[1] != draws[2]


def test_pictures_are_drawn_at_render_fps():
    env = CalvinEnv("open_drawer", cameras=(), render_fps=10)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(4):
        env.step([1, 0, 0, 0, 0, 0, 1])
        pictures.append(env.render())
    assert pictures[0].shape == (200, 200, 3)
    assert [p is pictures[0] for p in pictures] == [True, True, True, False, False]
    env.close()


def test_options_are_checked_by_name(tmp_path):
    with pytest.raises(DeskError, match="'juggle' is unknown"):
        CalvinEnv("juggle")
    with pytest.raises(DeskError, match="chains start in scene D"):
        CalvinEnv(scene="A")
    with pytest.raises(DeskError, match="'joint' is unknown"):
        CalvinEnv(control_mode="joint")
    with pytest.raises(DeskError, match="give both or neither"):
        CalvinEnv(perturbation_every=5)
    with pytest.raises(DeskError, match="does not exist"):
        CalvinEnv(annotations=str(tmp_path / "none.yaml"))
    with pytest.raises(DeskError, match="reset the environment"):
        CalvinEnv().step(NOTHING)


def test_annotations_file_replaces_sentences(tmp_path):
    file = tmp_path / "sentences.yaml"
    file.write_text("open_drawer: ['pull that thing']\n")
    assert CalvinEnv("open_drawer", annotations=str(file)).task_description == "pull that thing"
    file.write_text("open_door: ['no']\n")
    with pytest.raises(DeskError, match="unknown task 'open_door'"):
        CalvinEnv("open_drawer", annotations=str(file))
