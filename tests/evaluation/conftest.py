"""A checkpoint to evaluate."""

import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from random_policies import random_policy


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    """The folder of a random ACT, whose actions move the arm."""
    folder = tmp_path_factory.mktemp("policy") / "pretrained_model"
    policy = random_policy("act")
    policy.save_pretrained(folder)
    sizes = {"observation.state": 15, "observation.environment_state": 24, "action": 7}
    stats = {key: {"mean": torch.zeros(size), "std": torch.ones(size)} for key, size in sizes.items()}
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder
