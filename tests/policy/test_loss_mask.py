"""Datasets that say who acted: only the demonstrator's frames are learned, the policy's are history."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from lerobot_lansar.datasets import INTERVENTION_FEATURE
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
from lerobot_lansar.policy.processor_lansar import make_lansar_pre_post_processors
from lerobot_lansar.policy.windows import Windows

from .conftest import COMMANDS, LENGTHS, dataset_meta, make_dataset, small_config
from .test_policy import sampled_frames

STARTS = np.cumsum((0, *LENGTHS))[:-1]
TAKEN_OVER = (5, 70, 9, 0)
"""Frame of each episode in which the demonstrator takes over; in the third, it never does."""


def say_who_acted(root, taken_over=TAKEN_OVER):
    """Adds the column to a dataset; returns it."""
    acted = np.concatenate([np.arange(n) >= k for n, k in zip(LENGTHS, taken_over, strict=True)])
    (file,) = (root / "data").rglob("*.parquet")
    pq.write_table(pq.read_table(file).append_column(INTERVENTION_FEATURE, pa.array(acted)), file)
    return acted


def test_every_window_of_a_taken_over_episode_holds_frames_that_count(tmp_path):
    make_dataset(tmp_path / "data")
    acted = say_who_acted(tmp_path / "data")
    meta = dataset_meta(tmp_path / "data")
    for rule in ("episode", "anywhere", "mixed"):
        windows = Windows(meta.root, meta.features, meta.total_frames, small_config(window=8, window_start=rule))
        start, end = windows.bounds(np.arange(sum(LENGTHS)))
        seen = np.array([acted[a:b].sum() for a, b in zip(start, end, strict=True)])
        never = slice(STARTS[2], STARTS[3])
        assert (np.delete(seen, np.r_[never]) > 0).all()
        assert (seen[never] == 0).all()
        second = slice(STARTS[1], STARTS[2])
        assert start[second].min() == STARTS[1] + 70 - 7  # the policy's last frames are history
        assert end[second].max() == STARTS[2]
        batch = windows.batch(np.array([STARTS[1]]))
        np.testing.assert_array_equal(batch["counts"][0], [0, 0, 0, 0, 0, 0, 0, 1])


def test_all_frames_the_demonstrators_is_as_without_the_column(tmp_path, relative):
    make_dataset(tmp_path / "data")
    say_who_acted(tmp_path / "data", (0, 0, 0, 0))
    meta, plain = dataset_meta(tmp_path / "data"), dataset_meta(relative[0])
    index = np.arange(sum(LENGTHS))
    ours, theirs = (
        Windows(m.root, m.features, m.total_frames, small_config(window=8, window_start="mixed")) for m in (meta, plain)
    )
    np.testing.assert_array_equal(ours.bounds(index), theirs.bounds(index))
    assert "counts" not in ours.batch(index[:3])


def test_the_policys_actions_have_no_part_in_the_loss_its_states_have(tmp_path):
    make_dataset(tmp_path / "data")
    say_who_acted(tmp_path / "data")
    torch.manual_seed(0)
    config = small_config(window=8, window_start="anywhere", dropout=0.0)
    config.input_features, config.output_features = {}, {}
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(tmp_path / "data")).eval()  # no statistics of the batch
    preprocess, _ = make_lansar_pre_post_processors(config)
    index = torch.tensor([STARTS[0], STARTS[1], STARTS[2], STARTS[3]])
    batch = preprocess({**sampled_frames(*index.tolist()), "task": list(COMMANDS)})
    counts = batch["counts"]
    assert 0 < counts.mean() < 1
    for key in ("action", "observation.state"):
        batch[key] = batch[key].clone().requires_grad_()
    loss, parts = policy.forward(batch)
    loss.backward()
    changes = batch["action"].grad.abs().sum(dim=2)
    assert (changes[counts == 0] == 0).all()
    assert (changes[counts > 0] > 0).any()
    assert (batch["observation.state"].grad[1, :7].abs().sum(dim=1) > 0).all()  # history
    assert (batch["observation.state"].grad[2] == 0).all()  # nothing there counts
    each, _ = policy.forward(batch, reduction="none")
    torch.testing.assert_close(each.mean(), loss)
    torch.testing.assert_close(sum(parts.values()), loss.item())
    assert each[2] == 0
