"""Small random policies of LeRobot's own."""

import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config

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
