"""The gymnasium environment: chains, single tasks, rewards, ends of episodes, vector environments."""

import json
import re

import gymnasium
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env

import lerobot_lansar  # noqa: F401  (registers the environment)
from lerobot_lansar.benchmark import EPISODES_FILE, load_chains
from lerobot_lansar.calvin import TASKS, continuous_euler
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


@pytest.mark.parametrize("scene", [True, False])
@pytest.mark.parametrize("told", [True, False])
def test_the_environment_state_holds_what_was_asked_for(scene, told):
    env = CalvinEnv("turn_on_led", cameras=(), scene_state=scene, task_in_state=told)
    obs, _ = env.reset(seed=0)
    for _ in range(2):
        assert env.observation_space.contains(obs)
        expected = [env._last["scene_obs"]] * scene + [[float(task == "turn_on_led") for task in TASKS]] * told
        assert ("environment_state" in obs) == bool(expected)
        if expected:
            np.testing.assert_array_equal(obs["environment_state"], np.concatenate(expected))
        obs = env.step(np.array([0, 0, 0.5, 0, 0, 0, 1]))[0]
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
    assert [c["done"] for c in episode["commands"]] == [*tasks[:2], None]
    assert episode["reason"] is None
    assert episode["sentence"] == "first"
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


def test_a_badly_trained_policys_relative_action_is_not_taken_for_an_absolute_one():
    env = CalvinEnv("open_drawer", cameras=())
    env.reset(seed=0)
    env.step([4.0, -7.0, 0.5, 2.5, 0, 0.4, 1])
    env.close()


@pytest.mark.parametrize(
    ("mode", "action"),
    [
        ("abs", [150, 0, 0.4, 0.3, 0, 0, 1]),
        ("abs", [5000, 0, -90, 0.9, 0, 0, 1]),
        ("abs", [np.nan, 0, 0.4, 0.3, 0, 0, 1]),
        ("rel", [0, 0, 0.4, 400, 0, 0, 1]),  # that roll points the hand down, after 64 turns
    ],
)
def test_a_wild_first_action_fails_its_episode_and_does_not_stop_the_run(tmp_path, mode, action):
    env = CalvinEnv("turn_on_led", cameras=(), control_mode=mode, results_dir=str(tmp_path))
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="episodes fail early"):
        terminated = env.step(np.array(action))[2]
    env.close()
    assert terminated
    (line,) = map(json.loads, (tmp_path / EPISODES_FILE).read_text().splitlines())
    assert re.search(r"must be finite|within \+-100", line["reason"])


@pytest.mark.parametrize(("value", "reason"), [(np.nan, "must be finite"), (1000.0, r"within \+-100")])
@pytest.mark.parametrize("mode", ["rel", "abs"])
def test_a_wild_action_fails_its_episode_and_says_why(tmp_path, mode, value, reason):
    env = CalvinEnv("turn_on_led", cameras=(), control_mode=mode, results_dir=str(tmp_path))
    first, _ = env.reset(seed=3)
    stay = NOTHING if mode == "rel" else np.r_[first["agent_pos"][:6], 1]
    before = env.step(stay)[0]
    with pytest.warns(UserWarning, match="episodes fail early"):
        obs, reward, terminated, truncated, info = env.step(np.r_[value, stay[1:]])
    assert (reward, terminated, truncated, info["is_success"]) == (0, True, False, False)
    np.testing.assert_array_equal(obs["agent_pos"], before["agent_pos"])
    np.testing.assert_array_equal(env.reset(seed=3)[0]["environment_state"], first["environment_state"])
    env.close()
    (line,) = map(json.loads, (tmp_path / EPISODES_FILE).read_text().splitlines())
    assert re.search(reason, line["reason"])
    assert line["commands"] == [
        {
            "task": "turn_on_led",
            "sentence": env._sentences["turn_on_led"][0],
            "success": False,
            "steps": 2,
            "done": None,
        }
    ]


def test_the_line_says_which_task_was_done_instead_of_the_commanded_one(tmp_path):
    env = CalvinEnv("close_drawer", control_mode="abs", cameras=(), steps_per_command=150, results_dir=str(tmp_path))
    seed = next(seed for seed in range(20) if not env.reset(seed=seed)[0]["environment_state"][5])
    obs, _ = env.reset(seed=seed)
    *_, result = script(env, obs, ["turn_on_led"])
    while not result[2]:
        result = env.step(np.r_[result[0]["agent_pos"][:6], 1])
    env.close()
    (line,) = map(json.loads, (tmp_path / EPISODES_FILE).read_text().splitlines())
    assert [(c["task"], c["success"], c["done"]) for c in line["commands"]] == [("close_drawer", False, "turn_on_led")]


def test_an_action_of_another_size_stops_the_run():
    env = CalvinEnv("open_drawer", cameras=())
    env.reset(seed=0)
    with pytest.raises(DeskError, match=r"shape \(7,\), got \(6,\)"):
        env.step(np.zeros(6))
    env.close()


def test_a_diverged_episode_fails_and_the_next_one_is_unaffected(tmp_path):
    env = CalvinEnv("turn_on_led", cameras=(), results_dir=str(tmp_path))
    first, _ = env.reset(seed=3)
    env.render()
    red = env._desk._blocks["red"].body
    pybullet.resetBaseVelocity(red, [np.inf, 0, 0], physicsClientId=env._desk._client)
    with pytest.warns(UserWarning, match="its simulation diverges"):
        obs, reward, terminated, _, info = env.step(NOTHING)
    assert terminated
    assert json.loads((tmp_path / EPISODES_FILE).read_text())["reason"] == "simulation diverged"
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


def test_agent_pos_has_angles_that_do_not_jump_and_everything_else_as_calvin():
    env = CalvinEnv("open_drawer", cameras=(), control_mode="abs")
    obs, _ = env.reset(seed=0)
    raw = []
    for roll in np.pi + np.array([-0.2, 0.2, 0.2, -0.2, -0.2, 0.2]):
        for _ in range(6):
            obs = env.step([*obs["agent_pos"][:3], roll, *obs["agent_pos"][4:6], 1])[0]
            state = env._desk.observe()["robot_obs"]
            np.testing.assert_array_equal(np.delete(obs["agent_pos"], [3, 4, 5]), np.delete(state, [3, 4, 5]))
            np.testing.assert_array_equal(obs["agent_pos"][3:6], continuous_euler(state[3:6]))
            assert abs(obs["agent_pos"][3] - np.pi) < 0.5
            raw.append(state[3])
    assert min(raw) < -3
    assert max(raw) > 3
    env.close()


def test_absolute_actions_may_have_any_turn():
    states = []
    for turns in (0, -1, 2):
        env = CalvinEnv("open_drawer", cameras=(), control_mode="abs")
        obs, _ = env.reset(seed=0)
        target = obs["agent_pos"][:6] + [0.03, 0.02, 0, 0.1, 0, 0]
        for _ in range(8):
            obs = env.step([*target[:3], *(target[3:] + 2 * np.pi * turns), 1])[0]
        states.append(obs["agent_pos"])
        env.close()
    np.testing.assert_allclose(states[1:], [states[0]] * 2, atol=1e-9)


def test_random_sentences_depend_on_the_seed_alone_and_are_all_used(tmp_path):
    env = CalvinEnv(cameras=(), sentence="random")
    spoken: dict[str, set[str]] = {}
    for seed in (*range(0, 40, 4), 8):
        env.reset(seed=seed)
        first = env._current
        spoken.setdefault(first, set()).add(env.task_description)
        before = env.task_description
        env.reset(seed=seed)
        assert env.task_description == before
        assert before in env._sentences[first]
    assert any(env._sentences[task][0] not in sentences for task, sentences in spoken.items())
    single = CalvinEnv("open_drawer", cameras=(), sentence="random")
    single._desk = env._desk  # opening one takes longer than this test
    found = {(single.reset(seed=seed), single.task_description)[1] for seed in range(12)}
    assert found == set(env._sentences["open_drawer"])
    env.close()


def test_a_sentence_is_drawn_without_changing_the_start():
    env = CalvinEnv("open_drawer", cameras=())
    first, _ = env.reset(seed=2)
    env.sentence = "random"
    np.testing.assert_array_equal(env.reset(seed=2)[0]["environment_state"], first["environment_state"])
    env.close()


def test_pictures_are_drawn_at_render_fps():
    env = CalvinEnv("open_drawer", cameras=(), render_fps=10, steps_per_command=5)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(5):
        env.step([1, 0, 0, 0, 0, 0, 1])
        pictures.append(env.render())
    assert pictures[0].shape == (200, 200, 3)
    assert [p is pictures[0] for p in pictures[:3]] == [True] * 3
    assert pictures[4] is pictures[3] is not pictures[0]
    assert (pictures[5] != pictures[3]).any(), "the last one shows how the episode ended"
    assert env.render() is pictures[5]
    env.close()


def test_options_are_checked_by_name(tmp_path):
    with pytest.raises(DeskError, match="'juggle' is unknown"):
        CalvinEnv("juggle")
    with pytest.raises(DeskError, match="chains start in scene D"):
        CalvinEnv(scene="A")
    with pytest.raises(DeskError, match="'joint' is unknown"):
        CalvinEnv(control_mode="joint")
    with pytest.raises(DeskError, match="'last' is unknown"):
        CalvinEnv(sentence="last")
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
