"""Mistakes that show only in the options of the running LeRobot command, of which LeRobot tells an environment nothing.

The options are read with LeRobot's own functions, from the command line. Those in a file of `--config_path` are not
seen, except the policy's path.
"""

import json
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.constants import HF_LEROBOT_HOME, OBS_ENV_STATE

from ..command import CommandError
from .spaces import environment_state_size


def refuse_recording() -> None:
    """Refuses `--eval.recording=true` where sentences differ between episodes or change within one.

    LeRobot would label all frames with the first environment's first sentence.

    Raises:
        CommandError: The command records.
    """
    if (parser.parse_arg("eval.recording") or "false").lower() != "false":
        raise CommandError(
            "--eval.recording=true would label every frame with one sentence, the first environment's first, but "
            "chains and --env.sentence=random have several: record single tasks with --env.sentence=first, or use "
            "lansar-record for demonstrations"
        )


def check_environment_state(task_in_state: bool) -> None:
    """Compares the environment's `environment_state` with what the command's policy was trained on.

    A policy that gets another number of inputs would end with "mat1 and mat2 shapes cannot be multiplied".

    Args:
        task_in_state: The environment's option.

    Raises:
        CommandError: They differ by the task's 34 numbers.
    """
    size, trained = environment_state_size(task_in_state), _trained_size()
    if trained == environment_state_size(not task_in_state):
        raise CommandError(
            f"the policy was trained on {trained} numbers of {OBS_ENV_STATE}, but the environment gives {size}: "
            f"set --env.task_in_state={str(not task_in_state).lower()}"
        )


def _trained_size() -> int | None:
    """How many numbers of the environment state the command's policy reads; None if none, or if that is unknown.

    Known for `--policy.path`, and for a dataset on this machine that a new policy is trained on.
    """
    policy, dataset = parser.get_path_arg("policy"), parser.parse_arg("dataset.repo_id")
    if policy is not None:
        feature = (PreTrainedConfig.from_pretrained(policy).input_features or {}).get(OBS_ENV_STATE)
        return None if feature is None else feature.shape[0]
    if dataset is not None:
        file = Path(parser.parse_arg("dataset.root") or HF_LEROBOT_HOME / dataset, "meta", "info.json")
        features = json.loads(file.read_text())["features"] if file.is_file() else {}
        return features[OBS_ENV_STATE]["shape"][0] if OBS_ENV_STATE in features else None
    return None
