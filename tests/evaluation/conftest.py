"""Small random policies of LeRobot's own for evaluations."""

import pytest
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

SIZES = {
    "act": {"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1, "n_vae_encoder_layers": 1},
    "diffusion": {"down_dims": (8, 16), "n_groups": 4, "diffusion_step_embed_dim": 8, "num_inference_steps": 2},
}
STEPS = {"act": {"chunk_size": 8, "n_action_steps": 6}, "diffusion": {"horizon": 8, "n_action_steps": 6}}


def random_policy(kind, **options):
    """An untrained policy on the robot's and the scene's state, which predicts several actions at once."""
    modes = {"STATE": NormalizationMode.MEAN_STD, "ENV": NormalizationMode.MEAN_STD}
    config = make_policy_config(
        kind,
        device="cpu",
        push_to_hub=False,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (15,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (24,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping={**modes, "ACTION": NormalizationMode.MEAN_STD},
        **{**SIZES[kind], **STEPS[kind], **options},
    )
    torch.manual_seed(0)
    return get_policy_class(kind)(config).eval()


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
