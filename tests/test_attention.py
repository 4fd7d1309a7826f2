"""`lansar-attention`: the weights of a real rollout, and the files made of them."""

import sys

import numpy as np
import pytest
import torch

import lerobot_policy_lansar  # noqa: F401  (registers environment and policy)
from lerobot_lansar import attention as attention_module
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.policy.configuration_lansar import LanSARConfig
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
from lerobot_lansar.policy.processor_lansar import make_lansar_pre_post_processors

SMALL = {"hidden": 32, "context_layers": 2, "context_heads": 2, "decoder_layers": 3, "decoder_heads": 2}


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    config = LanSARConfig(
        device="cpu",
        push_to_hub=False,
        feedforward=64,
        use_images=False,
        window=8,
        clip=ClipConfig("lansar-desk", ""),
        **SMALL,
    )
    config.input_features, config.output_features = {}, {}
    folder = tmp_path / "checkpoint"
    for part in (LanSARPolicy(config), *make_lansar_pre_post_processors(config)):
        part.save_pretrained(folder)
    return folder


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["lansar-attention", *map(str, arguments)])
    return attention_module.main()


def test_a_rollout_leaves_weights_plots_and_video(checkpoint, tmp_path, monkeypatch):
    seen = []
    observe = attention_module.observe
    monkeypatch.setattr(attention_module, "observe", lambda config: seen.append(observe(config)) or seen[-1])
    code = run(
        monkeypatch,
        f"--policy.path={checkpoint}",
        "--env.type=calvin",
        "--env.task=open_drawer",
        "--env.cameras=[]",
        "--env.control_mode=abs",
        "--env.steps_per_command=20",
        "--seed=3",
        "--decoder_steps=[0,10,99]",
        f"--output_dir={tmp_path / 'out'}",
    )
    assert code == 0
    (attention,) = seen
    assert attention.tokens == ["CLS", "X", "B_red", "B_blue", "B_pink", "S", "C"]
    assert attention.context.shape == (20, 2, 2, 7, 7)
    assert attention.frames.shape == (20, 200, 200, 3)
    sums = attention.context.sum(-1)
    np.testing.assert_allclose(sums[:, 0], 1, atol=1e-5)
    np.testing.assert_allclose(sums[:, 1, :, 0], 1, atol=1e-5)
    assert np.isnan(sums[:, 1, :, 1:]).all()  # only CLS is read in the last layer
    np.testing.assert_allclose(attention.per_modality().sum(1), 7, atol=1e-4)
    # Two tokens per step; a full window of 8 steps drops 4.
    lengths = [step["self"].shape[-1] for step in attention.decoder]
    assert lengths == [2, 4, 6, 8, 10, 12, 14, 16, *[10, 12, 14, 16] * 3]
    for step in attention.decoder:
        assert step["cross"].shape[:2] == (3, 2)
        np.testing.assert_allclose(step["cross"].sum(-1), 1, atol=1e-5)
    stored = np.load(tmp_path / "out" / "attention.npz")
    np.testing.assert_array_equal(stored["context"], attention.context)
    np.testing.assert_array_equal(stored["decoder_cross_19"], attention.decoder[19]["cross"])
    for name in ("context_attention.png", "decoder_attention.png", "rollout.mp4"):
        assert (tmp_path / "out" / name).stat().st_size > 1000


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("calvin", "needs a LanSAR checkpoint, --policy.path=DIR; got an untrained policy of type act"),
        ("pusht", "runs the policy on the desk, --env.type=calvin; got pusht"),
    ],
)
def test_other_policies_and_environments_are_refused(monkeypatch, capsys, env, message):
    assert run(monkeypatch, "--policy.type=act", "--policy.push_to_hub=false", f"--env.type={env}") == 2
    assert message in capsys.readouterr().err
