"""Mistakes that show only in the options of the running LeRobot command, of which LeRobot tells an environment nothing.

The options are read as LeRobot reads them, from the command line or else from the file of `--config_path`.
"""

import json
from pathlib import Path
from typing import Any

from draccus.cfgparsing import load_config
from huggingface_hub import hf_hub_download
from lerobot.configs import DEFAULT_DEPTH_UNIT, PreTrainedConfig, parser
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES

from ..calvin import CAMERAS
from ..command import CommandError
from ..datasets import find_dataset, reads_scene
from .pictures import Pictures
from .spaces import EnvironmentState


def refuse_recording(mixed: bool, depth: bool) -> None:
    """Refuses `--eval.recording=true` where LeRobot could not record what happens.

    Args:
        mixed: Sentences differ between episodes or change within one. LeRobot would label all frames with the first
            environment's first sentence.
        depth: Observations hold depth, which LeRobot would encode as colours.

    Raises:
        CommandError: The command records.
    """
    if str(_option("eval.recording") or False).lower() == "false":
        return
    if mixed:
        raise CommandError(
            "--eval.recording=true would label every frame with one sentence, the first environment's first, but "
            "chains and --env.sentence=random have several: record single tasks with --env.sentence=first, or use "
            "lansar-record for demonstrations"
        )
    if depth:
        raise CommandError("--eval.recording=true cannot store depth: leave out --env.depth, or use lansar-record")


def check_policy(
    environment_state: EnvironmentState,
    pictures: Pictures,
    trained: dict[str, tuple[int, ...]] | None = None,
    option: str = "--env.",
) -> None:
    """Compares the environment's observations with what the command's policy was trained on.

    A policy that gets another number of inputs would end with "mat1 and mat2 shapes cannot be multiplied", one that
    reads depth would end with a KeyError without; one that gets pictures of another size does not end, but fails at its
    tasks.

    Args:
        environment_state: The environment's.
        pictures: Its pictures.
        trained: The shapes of what the policy reads, by key; None: those of the command's policy.
        option: What the names of options about pictures begin with.

    Raises:
        CommandError: `environment_state` lacks numbers of the scene or of the task, or has them although it should
            not; pictures have another size; the policy reads depth and there is none.
    """
    shapes = _trained_shapes() if trained is None else trained
    _check_environment_state(environment_state, shapes)
    _check_pictures(pictures, shapes, option)


def _check_environment_state(given: EnvironmentState, shapes: dict[str, tuple[int, ...]]) -> None:
    trained = shapes.get(OBS_ENV_STATE, (None,))[0]
    choices = (EnvironmentState(scene, task) for scene in (True, False) for task in (True, False))
    wanted = {choice.size: choice for choice in choices}.get(trained or given.size)
    if wanted is None or wanted == given:
        return
    values = {"scene_state": (wanted.scene, given.scene), "task_in_state": (wanted.task, given.task)}
    options = [f"--env.{name}={str(value).lower()}" for name, (value, now) in values.items() if value != now]
    raise CommandError(
        f"the policy was trained on {trained} numbers of {OBS_ENV_STATE}, but the environment gives {given.size}: "
        f"set {' '.join(options)}"
    )


def _check_pictures(pictures: Pictures, trained: dict[str, tuple[int, ...]], option: str) -> None:
    for camera in pictures.cameras:
        key, size = f"{OBS_IMAGES}.{camera}", pictures.size(camera)
        if f"{key}_depth" in trained and not pictures.depth:
            raise CommandError(f"the policy was trained on {key}_depth: set {option}depth=true")
        if key in trained and trained[key][1] != size:
            own = 0 if trained[key][1] == CAMERAS[camera] else trained[key][1]
            raise CommandError(
                f"the policy was trained on pictures of {trained[key][1]} pixels in {key}, but the environment's have "
                f"{size}: set {option}image_size={own}"
            )


def trained_depth_unit() -> str:
    """The unit in which LeRobot gives depth to the command's policy in training, `"m"` or `"mm"`.

    A training command's own `--dataset.depth_output_unit`, or that of the training that made `--policy.path`.
    """
    policy, names = parser.get_path_arg("policy"), ("depth_output_unit", "eval_split")
    if _option("dataset.repo_id") is not None or policy is None:
        unit, held_out = (_option(f"dataset.{name}") for name in names)
    else:
        unit, held_out = map((_training_of(policy).get("dataset") or {}).get, names)
    # With a held-out split, LeRobot 0.6 takes no notice of the option.
    return DEFAULT_DEPTH_UNIT if unit is None or float(held_out or 0) > 0 else unit


def named_device() -> str | None:
    """`--policy.device` of the command, whether or not this machine has it; None without one."""
    return _option("policy.device")


def evaluated_policy() -> str | None:
    """`--policy.path` of the command: a name on the hub, or the folder that it leads to; None without one.

    None in a training too, which evaluates what it has made of that policy so far.
    """
    policy = None if _option("dataset.repo_id") is not None else parser.get_path_arg("policy")
    if policy is None or not Path(policy).is_dir():
        return policy
    folder = Path(policy).resolve()  # `checkpoints/last` is another folder tomorrow
    return str(folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder)


def _training_of(policy: str) -> dict[str, Any]:
    """The options with which LeRobot trained a policy, from the file that it keeps beside it; empty without one."""
    file = Path(policy, TRAIN_CONFIG_NAME)
    if not Path(policy).is_dir():
        try:
            file = Path(hf_hub_download(policy, TRAIN_CONFIG_NAME))
        except (OSError, ValueError):  # no such file there, or no hub
            return {}
    return json.loads(file.read_text()) if file.is_file() else {}


def shapes_read(policy: PreTrainedConfig) -> dict[str, tuple[int, ...]]:
    """The shapes of what a policy reads, by key."""
    found = {key: tuple(feature.shape) for key, feature in (policy.input_features or {}).items()}
    if not reads_scene(policy.type, getattr(policy, "use_spatial_context", True)):
        found.pop(OBS_ENV_STATE, None)
    return found


def _trained_shapes() -> dict[str, tuple[int, ...]]:
    """The shapes of what the command's policy reads, by key; empty if that is unknown.

    Known for `--policy.path`, and for a dataset on this machine that a new policy is trained on. The second number of
    a picture's shape is its height in both.
    """
    policy, dataset = parser.get_path_arg("policy"), _option("dataset.repo_id")
    if policy is not None:
        return shapes_read(PreTrainedConfig.from_pretrained(policy))
    if dataset is None:
        return {}
    root = _option("dataset.root")
    try:
        file = find_dataset(dataset, None if root is None else Path(root)) / "meta/info.json"
        features = json.loads(file.read_text())["features"]
    except FileNotFoundError:
        return {}
    spatial = str(_option("policy.use_spatial_context")).lower() != "false"
    ignored = () if reads_scene(_option("policy.type"), spatial) else (OBS_ENV_STATE,)
    return {key: tuple(feature["shape"]) for key, feature in features.items() if key not in ignored}


def _option(name: str) -> Any:
    """The value of an option such as `policy.type`; None if neither command line nor `--config_path` has it."""
    value, path = parser.parse_arg(name), parser.parse_arg("config_path")
    if value is not None or path is None:
        return value
    file = Path(path, TRAIN_CONFIG_NAME) if Path(path).is_dir() else Path(path)  # a checkpoint to resume
    if not file.is_file():
        return None
    section, _, key = name.partition(".")
    with file.open() as stream:
        return ((load_config(stream, file=file) or {}).get(section) or {}).get(key)
