"""What several rooms know about datasets and checkpoints: where they are, names in them, what policies read."""

import os
from pathlib import Path
from typing import Any

from huggingface_hub.constants import HF_HOME

IS_INTERVENTION = "is_intervention"
"""CALVIN's frames of takeovers say with this array who acted, (1,) bool: True for the demonstrator, False for a policy.
LeRobot's name for it (`TeleopEvents.IS_INTERVENTION`)."""
INTERVENTION_FEATURE = f"complementary_info.{IS_INTERVENTION}"
"""The dataset's column of it, named as LeRobot names the complementary information of a transition."""

NO_COMMAND = "play without a command"
"""The sentence of a frame of play that no annotated window covers."""

MANIFEST = "meta/calvin_source.json"
"""File in which `lansar-convert` says what a dataset was made from."""

LOSSES_FILE = "losses.json"
"""In a checkpoint's `pretrained_model`: a list of {"update": int, "training": float} and {…, "held_out": float}."""

VERSION = "v3.0"
"""LeRobot's tag of the dataset format: the revision that it asks the hub for."""

IGNORE_SCENE = (
    *("mcil", "hulc", "gr1"),
    *("eo1", "evo1", "fastwam", "groot", "lingbot_va", "molmoact2", "multi_task_dit", "pi0", "pi05", "pi0_fast"),
    *("smolvla", "vla_jepa", "vqbet", "wall_x", "xvla"),
)
"""Types of policies that never read it, although LeRobot lists it among the inputs of a policy whose dataset has it."""


def reads_scene(policy_type: str | None, use_spatial_context: bool = True) -> bool:
    """Whether a policy reads `environment_state` if it is there; those that are not known count as reading it.

    Args:
        policy_type: `--policy.type`.
        use_spatial_context: LanSAR's option; policies without it have none.
    """
    return use_spatial_context and policy_type not in IGNORE_SCENE


def feature_problems(features: dict[str, Any], sizes: dict[str, int]) -> list[str]:
    """What keeps a policy from reading these features, a sentence each: vectors that are missing or of another size.

    Args:
        features: Name to a LeRobot feature of a policy, with its `shape`.
        sizes: Name to the numbers that a vector must have.
    """
    problems = []
    for name, size in sizes.items():
        if name not in features:
            problems.append(f"{name} is missing")
        elif tuple(features[name].shape) != (size,):
            problems.append(f"{name} has shape {tuple(features[name].shape)}, not ({size},)")
    return problems


def dataset_folder(repo_id: str, folder: Path | None) -> Path:
    """A dataset's folder: the one given, or where LeRobot makes one of that name, `$HF_LEROBOT_HOME/<repo_id>`."""
    if folder is not None:
        return folder
    return Path(os.environ.get("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")).expanduser() / repo_id


def find_dataset(repo_id: str, folder: Path | None) -> Path:
    """A dataset's folder: the one given, or where LeRobot 0.6 finds that name without asking the hub.

    That is `$HF_LEROBOT_HOME/<repo_id>`, unless it lacks the dataset or is a download by an earlier LeRobot; then
    the snapshot of `VERSION` in the download cache `$HF_LEROBOT_HOME/hub`.

    Args:
        repo_id: user/name.
        folder: Given by the user; returned unchecked.

    Raises:
        FileNotFoundError: No folder is given and there is neither.
    """
    if folder is not None:
        return folder
    from huggingface_hub import snapshot_download  # late: reports and workers need the name of a file only
    from huggingface_hub.errors import LocalEntryNotFoundError

    own, cache = dataset_folder(repo_id, None), dataset_folder("hub", None)
    if (own / "meta/info.json").is_file() and not (own / ".cache/huggingface/download").exists():
        return own
    try:
        return Path(
            snapshot_download(repo_id, repo_type="dataset", revision=VERSION, cache_dir=cache, local_files_only=True)
        )
    except (LocalEntryNotFoundError, ValueError) as error:  # no such download; not a name that the hub allows
        raise FileNotFoundError(
            f"no dataset {repo_id} in {own}, nor among LeRobot's downloads in {cache}: give its folder as "
            f"--dataset_dir, or download it: hf download {repo_id} --repo-type=dataset --revision={VERSION} "
            f"--cache-dir={cache}"
        ) from error
