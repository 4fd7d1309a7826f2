"""The example for LeRobot's EnvHub, loaded by LeRobot's own loader as from the hub."""

import shutil
from pathlib import Path

import pytest
from lerobot.envs.configs import HubEnvConfig
from lerobot.envs.factory import make_env

EXAMPLE = Path(__file__).resolve().parents[1] / "examples/envhub"


@pytest.fixture
def cache(tmp_path):
    """A download cache that holds the example as `you/calvin-desk`, so that the hub's client needs no network."""
    repository = tmp_path / "models--you--calvin-desk"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs/main").write_text("abc")
    shutil.copytree(EXAMPLE, repository / "snapshots/abc")
    return str(tmp_path)


def test_lerobots_loader_makes_the_benchmarks_environment_from_env_py(cache):
    with pytest.raises(RuntimeError, match="Refusing to execute remote code"):
        make_env("you/calvin-desk", hub_cache_dir=cache)
    envs = make_env("you/calvin-desk", n_envs=2, hub_cache_dir=cache, trust_remote_code=True)
    env = envs["lh_mtlc"][0]
    observation, _ = env.reset(seed=[0, 1])
    assert observation["agent_pos"].shape == (2, 15)
    assert env.call("task_description")[0] != env.call("task_description")[1]
    env.close()


def test_a_hub_configuration_chooses_the_tasks(cache):
    config = HubEnvConfig(hub_path="you/calvin-desk", task="open_drawer,turn_on_led")
    envs = make_env(config, hub_cache_dir=cache, trust_remote_code=True)
    assert list(envs) == ["open_drawer", "turn_on_led"]
    for env in envs.values():
        env[0].close()
