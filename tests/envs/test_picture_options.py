"""Pictures, depth and camera poses in observations, as LeRobot hands them to policies."""

import json
import sys

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.configs.types import FeatureType
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_lansar.calvin import CAMERAS
from lerobot_lansar.command import CommandError
from lerobot_lansar.desk import Desk
from lerobot_lansar.envs import CalvinEnv
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig
from lerobot_lansar.envs.pictures import Pictures
from lerobot_lansar.evaluation.options import EvaluateConfig
from lerobot_lansar.pictures import resize

EVERYTHING = {"depth": True, "camera_poses": True, "image_size": 128}


@pytest.fixture(scope="module")
def moved():
    """A desk after some steps, and its observation with the cameras' own sizes and depth in metres."""
    with Desk(depth=True) as desk:
        for _ in range(4):
            obs = desk.step([1, -1, 0.5, 0, 1, 1, 1])
        yield desk, obs


def test_the_space_is_that_of_the_observations():
    env = CalvinEnv("open_drawer", **EVERYTHING)
    check_env(env, skip_render_check=True)
    env.close()


def test_depth_comes_as_lerobot_hands_it_on_in_the_unit_asked_for(moved):
    _, obs = moved
    metres = Pictures(("static", "gripper"), 0, True).observe(obs)
    thousandths = Pictures(("static", "gripper"), 0, True, "mm").observe(obs)
    for camera, size in CAMERAS.items():
        key = f"images.{camera}_depth"
        assert metres[key].shape == (1, size, size)
        np.testing.assert_array_equal(metres[key][0], obs[f"depth_{camera}"])
        np.testing.assert_allclose(thousandths[key], metres[key] * 1000, rtol=1e-6)
        assert metres[key].dtype == thousandths[key].dtype == np.float32


def test_pictures_and_depth_are_resized_as_recordings_are(moved):
    _, obs = moved
    found = Pictures(("static", "gripper"), 128, True).observe(obs)
    for camera in CAMERAS:
        np.testing.assert_array_equal(found["pixels"][camera], resize(obs[f"rgb_{camera}"], 128))
        np.testing.assert_array_equal(found[f"images.{camera}_depth"][0], resize(obs[f"depth_{camera}"], 128))


def test_poses_and_intrinsics_are_those_of_the_pictures(moved):
    desk, obs = moved
    found = Pictures(("static", "gripper"), 128, camera_poses=True).observe(obs)
    for name in CAMERAS:
        camera = desk.camera(name, 128)
        np.testing.assert_allclose(found[f"camera_pose.{name}"].reshape(4, 4), camera.pose, atol=1e-6)
        np.testing.assert_allclose(found[f"camera_intrinsics.{name}"].reshape(3, 3), camera.intrinsics, rtol=1e-6)


def test_lerobot_hands_everything_to_the_policy_under_the_datasets_names(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-eval"])
    config = CalvinEnvConfig(task="open_drawer", **EVERYTHING)
    (env,) = make_env(config, n_envs=2)["open_drawer"].values()
    batch = preprocess_observation(env.reset(seed=[0, 1])[0])
    env.close()
    features = env_to_policy_features(config)
    assert {key: tuple(value.shape[1:]) for key, value in batch.items() if key in features} == {
        key: tuple(feature.shape) for key, feature in features.items() if key != "action"
    }
    assert {value.dtype for value in batch.values()} == {torch.float32}
    depth = batch["observation.images.static_depth"]
    assert features["observation.images.static_depth"].type is FeatureType.VISUAL
    assert depth.shape == (2, 1, 128, 128)
    assert 3000 < depth.min() < depth.max() <= 10_000, "millimetres, LeRobot's default"
    assert batch["observation.camera_pose.gripper"].shape == (2, 16)


def test_videos_have_the_size_asked_for_and_policies_do_not_see_it():
    env = CalvinEnv("open_drawer", render_size=320, image_size=64)
    obs, _ = env.reset(seed=0)
    assert env.render().shape == (320, 320, 3)
    assert obs["pixels"]["static"].shape == (64, 64, 3)
    env.close()
    env = CalvinEnv("open_drawer", image_size=64)
    env.reset(seed=0)
    assert env.render().shape == (200, 200, 3)
    env.close()


def policy(folder, **shapes):
    """The options of an evaluation of a policy that was trained on pictures of these shapes."""
    features = {f"observation.images.{key}": {"type": "VISUAL", "shape": shape} for key, shape in shapes.items()}
    ACTConfig(device="cpu")._save_pretrained(folder)
    file = folder / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "input_features": features}))
    return ["lerobot-eval", f"--policy.path={folder}"]


def test_depth_has_the_unit_in_which_the_policy_was_trained(tmp_path, monkeypatch):
    config = CalvinEnvConfig(depth=True)
    evaluation = policy(tmp_path, static_depth=[1, 200, 200])
    training = ["lerobot-train", "--policy.type=act", "--dataset.repo_id=you/desk"]
    resumed = tmp_path / "resumed" / "train_config.json"
    resumed.parent.mkdir()
    resumed.write_text(json.dumps({"dataset": {"repo_id": "you/desk", "depth_output_unit": "m"}}))
    for arguments, unit in (
        (["lerobot-train", f"--config_path={resumed}", "--resume=true"], "m"),
        (["lerobot-train", f"--config_path={resumed.parent}", "--resume=true"], "m"),
        (evaluation, "mm"),
        (training, "mm"),
        ([*training, "--dataset.depth_output_unit=m"], "m"),
        ([*training, "--dataset.depth_output_unit=m", "--dataset.eval_split=0.1"], "mm"),
        ([*training, f"--policy.path={tmp_path}"], "mm"),
    ):
        monkeypatch.setattr(sys, "argv", arguments)
        assert config.gym_kwargs["depth_unit"] == unit
    (tmp_path / "train_config.json").write_text(json.dumps({"dataset": {"depth_output_unit": "m"}}))
    monkeypatch.setattr(sys, "argv", evaluation)
    assert config.gym_kwargs["depth_unit"] == "m"
    assert CalvinEnvConfig(depth=True, depth_unit="mm").gym_kwargs["depth_unit"] == "mm"


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_jobs_run_on_the_device_that_is_named_even_if_this_machine_lacks_it(tmp_path, monkeypatch):
    arguments = policy(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"type": "act", "device": "cuda"}))
    for option, device in (([], "cpu"), (["--policy.device=cuda"], "cuda"), (["--policy.device=cpu"], "cpu")):
        monkeypatch.setattr(sys, "argv", [*arguments, *option])
        options = {"env": CalvinEnvConfig(), "output_dir": tmp_path}
        assert EvaluateConfig(**options, executor="slurm").policy.device == device
        assert EvaluateConfig(**options, executor="local").policy.device == "cpu"  # LeRobot's choice


def test_pictures_unlike_the_policys_are_named_before_the_first_step(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", policy(tmp_path, static=[3, 128, 128], static_depth=[1, 128, 128]))
    with pytest.raises(CommandError, match=r"trained on observation\.images\.static_depth: set --env\.depth=true"):
        CalvinEnvConfig(image_size=128).get_env_processors()
    with pytest.raises(CommandError, match=r"pictures of 128 pixels .* have 200: set --env\.image_size=128"):
        CalvinEnvConfig(depth=True).get_env_processors()
    CalvinEnvConfig(depth=True, image_size=128).get_env_processors()
    monkeypatch.setattr(sys, "argv", policy(tmp_path, gripper=[3, 84, 84]))
    with pytest.raises(CommandError, match=r"have 128: set --env\.image_size=0"):
        CalvinEnvConfig(image_size=128).get_env_processors()
    CalvinEnvConfig().get_env_processors()


def test_recording_depth_is_refused(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--eval.recording=true"])
    CalvinEnvConfig(task="lift").get_env_processors()
    with pytest.raises(CommandError, match="cannot store depth"):
        CalvinEnvConfig(task="lift", depth=True).get_env_processors()


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("image_size", 257, "image_size must be between 1 and 256"),
        ("image_size", -1, "image_size must be between 1 and 256"),
        ("render_size", 2000, "render_size must be between 1 and 1024"),
        ("depth_unit", "cm", "depth_unit 'cm' is unknown"),
    ],
)
def test_impossible_pictures_are_refused_by_name(option, value, message):
    with pytest.raises(ValueError, match=message):
        CalvinEnv("open_drawer", **{option: value})
    with pytest.raises(CommandError, match=f"--env.{message}"):
        CalvinEnvConfig(**{option: value})
