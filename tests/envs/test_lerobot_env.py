"""`--env.type=calvin`: options, features and vector environments as LeRobot's evaluation uses them."""

import inspect
import io
import json
from contextlib import redirect_stdout
from dataclasses import fields

import draccus
import numpy as np
import pytest
from draccus.wrappers.docstring import get_attribute_docstring
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

import lerobot_policy_lansar  # noqa: F401  (registers the environment)
from lerobot_lansar.desk import DeskError
from lerobot_lansar.desk.sentences import COMMANDS
from lerobot_lansar.envs import CalvinEnv
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig


def test_is_registered_under_its_name():
    assert EnvConfig.get_choice_class("calvin") is CalvinEnvConfig


def test_features_follow_the_cameras():
    features = env_to_policy_features(CalvinEnvConfig(cameras=["gripper"]))
    assert {key: feature.shape for key, feature in features.items()} == {
        "action": (7,),
        "observation.state": (15,),
        "observation.environment_state": (24,),
        "observation.images.gripper": (3, 84, 84),
    }
    told = env_to_policy_features(CalvinEnvConfig(task_in_state=True))
    assert told["observation.environment_state"].shape == (58,)
    with pytest.raises(DeskError, match=r"--env\.cameras: 'wrist'"):
        CalvinEnvConfig(cameras=["wrist"])


def test_every_option_of_the_desk_is_explained_by_help():
    inherited = {field.name for field in fields(EnvConfig)}
    own = {field.name for field in fields(CalvinEnvConfig)} - inherited | {"task", "fps"}
    explained = {name for name in own if get_attribute_docstring(CalvinEnvConfig, name).comment_above}
    assert explained == own
    assert len(own) == 14
    text = io.StringIO()
    with pytest.raises(SystemExit), redirect_stdout(text):
        draccus.parse(CalvinEnvConfig, args=["--help"])
    assert "environment_state, 1 for the commanded task" in " ".join(text.getvalue().split())


def test_every_argument_of_the_environment_is_an_option():
    options = CalvinEnvConfig(steps_per_command=7, render_fps=5, task_in_state=True)
    arguments = set(inspect.signature(CalvinEnv).parameters) - {"task", "render_mode"}
    assert set(options.gym_kwargs) == arguments
    assert {options.gym_kwargs[name] for name in ("steps_per_command", "render_fps")} == {7, 5}


def test_parallel_tasks_are_refused_because_they_share_a_policy():
    with pytest.raises(DeskError, match="max_parallel_tasks must be 1"):
        CalvinEnvConfig(max_parallel_tasks=2)


def rollout(use_async: bool, results_dir):
    config = CalvinEnvConfig(
        task="open_drawer, turn_on_led", cameras=[], steps_per_command=4, results_dir=str(results_dir)
    )
    envs = make_env(config, n_envs=2, use_async_envs=use_async)
    assert list(envs) == ["open_drawer", "turn_on_led"]
    vector = envs["open_drawer"][0]
    obs, _ = vector.reset(seed=[3, 4], options={"lerobot_new_rollout": True})
    assert vector.call("task_description") == (COMMANDS["validation"]["open_drawer"][0],) * 2
    assert vector.call("_max_episode_steps") == (4, 4)
    states, ends = [obs["agent_pos"]], []
    action = np.tile([1.0, 0, 0, 0, 0, 0, 1], (2, 1))
    for _ in range(7):
        obs, rewards, terminated, _, _info = vector.step(action)
        assert (rewards == 0).all()
        states.append(obs["agent_pos"])
        ends.append(terminated.copy())
    prepared = preprocess_observation(obs)
    for tasks in envs.values():
        tasks[0].close()
    return np.array(states), np.array(ends), prepared


def test_sync_and_async_agree_and_finished_episodes_freeze(tmp_path):
    states, ends, prepared = rollout(use_async=False, results_dir=tmp_path / "sync")
    assert ends[:3].sum() == 0
    assert ends[3].all()
    np.testing.assert_array_equal(states[5], states[4])
    np.testing.assert_array_equal(states[7], states[4])
    assert prepared["observation.state"].shape == (2, 15)
    assert prepared["observation.control_mode"].tolist() == [[0.0], [0.0]]
    other_states, other_ends, _ = rollout(use_async=True, results_dir=tmp_path / "async")
    np.testing.assert_array_equal(other_states, states)
    np.testing.assert_array_equal(other_ends, ends)
    for folder in ("sync", "async"):
        lines = [json.loads(line) for line in (tmp_path / folder / "episodes.jsonl").read_text().splitlines()]
        assert sorted(line["seed"] for line in lines) == [3, 4]
