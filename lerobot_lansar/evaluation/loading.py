"""A policy and its processors, built from the options of a command as LeRobot's evaluation builds them."""

from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy


def load_policy(
    policy: PreTrainedConfig, env: EnvConfig, rename_map: dict[str, str] | None = None
) -> tuple[PreTrainedPolicy, tuple[Any, Any, Any, Any]]:
    """Loads a policy for an environment.

    Args:
        policy: `--policy`; without `pretrained_path`, its weights are random.
        env: `--env`.
        rename_map: `--rename_map`.

    Returns:
        The policy in evaluation mode; the processors as LeRobot's `rollout` takes them: the environment's before and
        after the policy, then the policy's own before and after it.
    """
    loaded = make_policy(policy, env_cfg=env, rename_map=rename_map or {}).eval()
    path = policy.pretrained_path
    overrides = {
        "device_processor": {"device": str(loaded.config.device)},
        "rename_observations_processor": {"rename_map": rename_map or {}},
    }
    own = make_pre_post_processors(
        policy, pretrained_path=None if path is None else str(path), preprocessor_overrides=overrides
    )
    return loaded, (*make_env_pre_post_processors(env, policy), *own)
