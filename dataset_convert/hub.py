"""A converted dataset on the Hugging Face hub: uploading it, and finding what LeRobot has downloaded."""

import os
from pathlib import Path

from huggingface_hub import snapshot_download
from huggingface_hub.constants import HF_HOME
from huggingface_hub.errors import LocalEntryNotFoundError

from dataset_convert import card

VERSION = "v3.0"
"""LeRobot's tag of the dataset format: the revision that it asks the hub for."""


def folder_of(repo_id: str, folder: Path | None) -> Path:
    """A dataset's folder: the one given, or where LeRobot looks for a dataset of that name."""
    if folder is not None:
        return folder
    return Path(os.environ.get("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")) / repo_id


def push(root: Path, repo_id: str, private: bool) -> None:
    """Uploads a dataset with LeRobot's own method, which also sets the version tag that loading needs.

    An interrupted upload goes on: what the hub has is not sent again. Large folders need no other method:
    `upload_folder`, which LeRobot calls, commits them in several parts and resumes, and the hub's client deprecates
    `upload_large_folder` in favour of it. The version tag is set last, so that nobody loads an incomplete dataset.

    Args:
        root: The dataset's folder.
        repo_id: user/name.
        private: Whether only its owner sees it.
    """
    # Takes seconds, and worker processes import this module.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(repo_id, root=root, video_backend="pyav")  # named, so that it does not look for torchcodec
    dataset.push_to_hub(private=private, **card.fields(root, repo_id))


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
    own, cache = folder_of(repo_id, None), folder_of("hub", None)
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
