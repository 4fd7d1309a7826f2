"""`--policy.type=act_depth`: ACT on pictures of one channel beside those of three."""

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

import lerobot_policy_lansar  # noqa: F401  (registers the policy)

SIZE, CHUNK = 32, 4
COLORS, DEPTH = "observation.images.static", "observation.images.static_depth"


def make(kind):
    config = make_policy_config(
        kind,
        device="cpu",
        pretrained_backbone_weights=None,
        dim_model=16,
        n_heads=2,
        dim_feedforward=16,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        input_features={
            COLORS: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)),
            DEPTH: PolicyFeature(FeatureType.VISUAL, (1, SIZE, SIZE)),
            "observation.state": PolicyFeature(FeatureType.STATE, (15,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
    )
    torch.manual_seed(0)
    return get_policy_class(kind)(config)


def batch(depth):
    return {
        COLORS: torch.full((2, 3, SIZE, SIZE), 0.5),
        DEPTH: torch.full((2, 1, SIZE, SIZE), depth),
        "observation.state": torch.zeros(2, 15),
        "action": torch.zeros(2, CHUNK, 7),
        "action_is_pad": torch.zeros(2, CHUNK, dtype=torch.bool),
    }


def test_depth_is_learned_from_and_changes_the_actions():
    policy = make("act_depth")
    loss, _ = policy.forward(batch(0.3))
    loss.backward()
    assert torch.isfinite(loss)
    near, far = (policy.predict_action_chunk(batch(depth)) for depth in (-1.0, 1.0))
    assert near.shape == (2, CHUNK, 7)
    assert not torch.allclose(near, far)


def test_lerobots_own_act_cannot_read_depth():
    # once it can, this package needs no ACT of its own
    with pytest.raises(RuntimeError, match=r"expected input.* to have 3 channels"):
        make("act").forward(batch(0.3))


def test_depth_is_scaled_by_the_datasets_statistics():
    policy = make("act_depth")
    assert isinstance(policy.config, ACTConfig)
    one = {name: np.full((1, 1, 1), value) for name, value in (("mean", 4000.0), ("std", 500.0))}
    stats = {DEPTH: one, COLORS: {"mean": np.zeros((3, 1, 1)), "std": np.ones((3, 1, 1))}}
    prepare, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    scaled = prepare({**batch(4500.0), "task": ["", ""]})
    assert scaled[DEPTH].shape == (2, 1, SIZE, SIZE)
    assert scaled[DEPTH].mean() == pytest.approx(1, abs=1e-4)
    stats[DEPTH] = stats[COLORS]  # what LeRobot's eval_split makes of it
    with pytest.raises(ValueError, match=r"add --dataset\.use_imagenet_stats=false"):
        make_pre_post_processors(policy.config, dataset_stats=stats)
