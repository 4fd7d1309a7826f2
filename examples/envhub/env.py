"""The CALVIN desk for LeRobot's EnvHub: `make_env` of `lerobot.envs` downloads this file and calls its `make_env`."""

from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg=None):
    """Vector environments by task; `cfg.task`, if given, names the tasks as `--env.task` does."""
    return CalvinEnvConfig(task=cfg.task if cfg else None).create_envs(n_envs, use_async_envs)
