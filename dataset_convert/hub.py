"""Uploading a converted dataset."""

from pathlib import Path

from dataset_convert import card


def push(root: Path, repo_id: str, private: bool) -> None:
    """Uploads a dataset with LeRobot's own method, which also sets the version tag that loading needs.

    An interrupted upload goes on: what the hub has is not sent again.

    Args:
        root: the dataset's folder.
        repo_id: user/name.
        private: whether only its owner sees it.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(repo_id, root=root, video_backend="pyav")  # it need not look for another one
    dataset.push_to_hub(private=private, **card.fields(root, repo_id))
