"""`--env.type=calvin`: options, features and vector environments as LeRobot's evaluation uses them."""

import inspect
import io
import json
import sys
from contextlib import nullcontext, redirect_stdout
from pathlib import Path

import draccus
import lerobot.policies
import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import RelativeActionsProcessorStep

import lerobot_policy_lansar  # noqa: F401  (registers the environment)
from lerobot_lansar.calvin import ACTION_NAMES, TASK_GROUPS, TASKS, continuous_euler
from lerobot_lansar.command import CommandError
from lerobot_lansar.datasets import reads_scene
from lerobot_lansar.desk import Desk
from lerobot_lansar.desk.sentences import COMMANDS
from lerobot_lansar.envs import CalvinEnv
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig
from lerobot_lansar.envs.suites import suites
from lerobot_lansar.policy.configuration_lansar import LanSARConfig


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
    for scene, task, size in ((True, True, 58), (False, True, 34), (False, False, None)):
        told = env_to_policy_features(CalvinEnvConfig(scene_state=scene, task_in_state=task))
        assert getattr(told.get("observation.environment_state"), "shape", None) == (size and (size,))
    with pytest.raises(CommandError, match=r"--env\.cameras: 'wrist'"):
        CalvinEnvConfig(cameras=["wrist"])


def test_help_prints_the_comments_above_the_desks_options():
    text = io.StringIO()
    with pytest.raises(SystemExit), redirect_stdout(text):
        draccus.parse(CalvinEnvConfig, args=["--help"])
    assert "environment_state, 1 for the commanded task" in " ".join(text.getvalue().split())


def test_every_argument_of_the_environment_is_an_option():
    options = CalvinEnvConfig(steps_per_command=7, render_fps=5, task_in_state=True)
    arguments = set(inspect.signature(CalvinEnv).parameters) - {"task", "render_mode"}
    assert set(options.gym_kwargs) == arguments
    assert {options.gym_kwargs[name] for name in ("steps_per_command", "render_fps")} == {7, 5}


def test_every_task_is_in_one_group():
    named = [task for tasks in TASK_GROUPS.values() for task in tasks]
    assert sorted(named) == sorted(TASKS)
    assert not set(TASK_GROUPS) & set(TASKS)
    assert TASK_GROUPS["stack"] == ("stack_block", "unstack_block")
    assert [len(TASK_GROUPS[group]) for group in ("rotate", "push", "lift", "lights")] == [6, 7, 9, 4]


def test_groups_are_suites_of_their_tasks():
    assert suites("all") == TASK_GROUPS
    assert list(suites("lh_mtlc, drawer,turn_on_led").items()) == [
        ("lh_mtlc", ("lh_mtlc",)),
        ("drawer", ("open_drawer", "close_drawer")),
        ("turn_on_led", ("turn_on_led",)),
    ]
    envs = make_env(CalvinEnvConfig(task="drawer", cameras=[]), n_envs=1)
    assert list(envs) == ["drawer"]
    assert {number: env.call("task") for number, env in envs["drawer"].items()} == {
        0: ("open_drawer",),
        1: ("close_drawer",),
    }
    with pytest.raises(CommandError, match=r"--env\.task: 'juggle' is unknown.* a group \(rotate, push"):
        CalvinEnvConfig(task="lift,juggle")
    with pytest.raises(CommandError, match="names open_drawer twice"):
        CalvinEnvConfig(task="open_drawer,all")


def test_another_frame_rate_is_refused_with_the_reason():
    with pytest.raises(CommandError, match=r"--env\.fps must be 30, got 10: .* --env\.render_fps"):
        draccus.parse(CalvinEnvConfig, args=["--fps=10"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"renderer": "opengl"}, "renderer 'opengl' is unknown"),
        ({"control_mode": "absolute"}, "it is 'rel' or 'abs'"),
        ({"scene": "E"}, "start in scene D, not 'E'"),
        ({"annotations": "none.yaml"}, "none.yaml does not exist"),
        ({"steps_per_command": 0}, "steps_per_command"),
        ({"assets": "nowhere"}, "asset file nowhere.* is missing"),
    ],
)
def test_options_that_cannot_work_are_refused_before_a_training_begins(monkeypatch, options, message):
    monkeypatch.setattr(sys, "argv", ["lerobot-train"])
    with pytest.raises(CommandError, match=rf"--env: .*{message}"):
        CalvinEnvConfig(task="lh_mtlc,open_drawer", **options).get_env_processors()


def test_depth_of_no_camera_is_refused():
    for name in ("depth", "camera_poses"):
        with pytest.raises(CommandError, match=f"{name} needs cameras"):
            CalvinEnvConfig(cameras=[], **{name: True})


def test_it_is_known_which_of_lerobots_policies_read_the_scenes_state():
    folder = Path(lerobot.policies.__file__).parent
    reading = {}
    for file in folder.glob("*/configuration_*.py"):
        kind = file.parent.name
        if kind in PreTrainedConfig.get_known_choices():
            sources = "".join(path.read_text() for path in file.parent.glob("*.py"))
            reading[kind] = "env_state" in sources or "OBS_ENV_STATE" in sources
    assert {kind for kind, reads in reading.items() if reads} >= {"act", "diffusion", "tdmpc"}
    assert {kind: reads_scene(kind) for kind in reading} == reading


def act(folder, size):
    """A checkpoint's configuration, of an ACT that was trained on so many numbers of environment state."""
    features = {"observation.environment_state": {"type": "ENV", "shape": [size]}} if size else {}
    file = folder / "config.json"
    ACTConfig(device="cpu")._save_pretrained(folder)
    file.write_text(json.dumps({**json.loads(file.read_text()), "input_features": features}))
    return f"--policy.path={folder}"


@pytest.mark.parametrize(
    ("trained", "right", "wrong", "option"),
    [
        (58, {"task_in_state": True}, {}, "--env.task_in_state=true"),
        (24, {}, {"task_in_state": True}, "--env.task_in_state=false"),
        (24, {}, {"scene_state": False}, "--env.scene_state=true"),
        (34, {"scene_state": False, "task_in_state": True}, {}, "--env.scene_state=false --env.task_in_state=true"),
    ],
)
def test_a_forgotten_part_of_the_environment_state_is_named_before_the_first_step(
    tmp_path, monkeypatch, trained, right, wrong, option
):
    dataset = tmp_path / "dataset" / "meta" / "info.json"
    dataset.parent.mkdir(parents=True)
    dataset.write_text(json.dumps({"features": {"observation.environment_state": {"shape": [trained]}}}))
    data = ["--dataset.repo_id=you/desk", f"--dataset.root={tmp_path / 'dataset'}"]
    for arguments in ([act(tmp_path, trained)], ["--policy.type=act", *data]):
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", *arguments])
        CalvinEnvConfig(**right).get_env_processors()
        with pytest.raises(CommandError, match=f"trained on {trained} numbers .*set {option}$"):
            CalvinEnvConfig(**wrong).get_env_processors()
    file = tmp_path / "train.yaml"
    file.write_text("policy: {type: lansar, use_spatial_context: false}")
    for ignoring in (["--policy.type=hulc"], [f"--config_path={file}"]):
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *ignoring, *data])
        CalvinEnvConfig(**wrong).get_env_processors()


def test_a_policy_that_reads_no_environment_state_may_have_any(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", act(tmp_path, None)])
    for told in (True, False):
        CalvinEnvConfig(scene_state=told, task_in_state=told).get_env_processors()


def test_a_lansar_that_does_not_look_at_the_scene_may_have_it_or_not(tmp_path, monkeypatch):
    features = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (24,))}
    for looks in (False, True):
        config = LanSARConfig(device="cpu", use_spatial_context=looks, input_features=dict(features))
        config._save_pretrained(tmp_path)
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={tmp_path}"])
        CalvinEnvConfig().get_env_processors()
        refused = pytest.raises(CommandError, match=r"set --env\.scene_state=true") if looks else nullcontext()
        with refused:
            CalvinEnvConfig(scene_state=False).get_env_processors()


def test_recording_is_refused_where_lerobot_would_mix_up_sentences(monkeypatch):
    for recording in ("true", "false"):
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--eval.recording={recording}"])
        CalvinEnvConfig(task="lift").get_env_processors()
        for options in ({}, {"task": "lift", "sentence": "random"}):
            if recording == "false":
                CalvinEnvConfig(**options).get_env_processors()
            else:
                with pytest.raises(CommandError, match="label every frame with one sentence"):
                    CalvinEnvConfig(**options).get_env_processors()


def test_lerobots_relative_actions_do_not_jump_where_a_roll_passes_half_a_turn():
    relative = RelativeActionsProcessorStep(enabled=True, exclude_joints=["gripper"], action_names=ACTION_NAMES["abs"])
    envs = make_env(CalvinEnvConfig(task="open_drawer", cameras=[], control_mode="abs"), n_envs=1)
    env = envs["open_drawer"][0]
    obs, _ = env.reset(seed=[0])
    differences, rolls = [], []
    with Desk(cameras=()) as desk:  # stands for the recording: its angles are CALVIN's
        recorded = desk.reset()["robot_obs"]
        for swing in np.sin(np.linspace(0, 4 * np.pi, 60)):
            goal = np.array([*recorded[:3], np.pi + 0.3 * swing, *recorded[4:6], 1.0])
            goal[3] = (goal[3] + np.pi) % (2 * np.pi) - np.pi  # as CALVIN writes it
            action = np.r_[goal[:3], continuous_euler(goal[3:6]), 1.0]  # as datasets have it
            for state in (preprocess_observation(obs)["observation.state"], dataset_state(recorded)):
                transition = {"observation": {"observation.state": state}, "action": torch.tensor(action[None])}
                differences.append(relative(transition)["action"][0, 3:6].numpy())
            rolls.append(recorded[3])
            recorded = desk.step(goal, "abs")["robot_obs"]
            obs = env.step(np.r_[obs["agent_pos"][0, :3], action[3:]][None])[0]
    env.close()
    assert min(rolls) < -3
    assert max(rolls) > 3
    assert np.abs(np.diff(rolls)).max() > 6, "the recording does jump"
    assert np.abs(differences[20:]).max() < 0.5, "after both arms have reached the first pose"


def dataset_state(robot_obs):
    """A recorded state as `observation.state` of a dataset, in a batch of one."""
    state = np.r_[robot_obs[:3], continuous_euler(robot_obs[3:6]), robot_obs[6:]]
    return torch.tensor(state[None], dtype=torch.float32)


def test_parallel_tasks_are_refused_because_they_share_a_policy():
    with pytest.raises(CommandError, match="max_parallel_tasks must be 1"):
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


def test_wild_actions_of_one_episode_leave_the_others_of_its_batch_alone():
    (env,) = make_env(CalvinEnvConfig(task="turn_on_led", cameras=[]), n_envs=2, use_async_envs=True)[
        "turn_on_led"
    ].values()
    env.reset(seed=[3, 4])
    action = np.tile([0.5, 0, 0, 0, 0, 0, 1], (2, 1))
    action[0, 2] = np.nan
    ends = [env.step(action)[2].tolist() for _ in range(3)]
    assert ends[0] == [True, False]
    assert not any(end[1] for end in ends)
    env.close()


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


def test_lines_name_the_policy_that_is_evaluated_but_not_one_that_is_being_trained(tmp_path, monkeypatch):
    folder = tmp_path / "checkpoints" / "000100"
    folder.mkdir(parents=True)
    (tmp_path / "checkpoints" / "last").symlink_to(folder)
    monkeypatch.chdir(tmp_path)

    def named(*arguments):
        monkeypatch.setattr(sys, "argv", ["command", *arguments])
        return CalvinEnvConfig().gym_kwargs["results_extra"]

    assert named("--policy.path=checkpoints/last") == {"policy": "checkpoints/000100", "policy_reset": "batch"}
    assert named("--policy.path=you/model")["policy"] == "you/model"
    assert named("--policy.path=checkpoints/last", "--dataset.repo_id=you/desk")["policy"] is None
    assert named()["policy"] is None
