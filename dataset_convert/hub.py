"""Uploading a converted dataset to the Hugging Face hub."""

from pathlib import Path

from dataset_convert import card


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
