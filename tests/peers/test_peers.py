"""MCIL, HULC and GR-1: what they learn from, what they predict, and what they refuse."""

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from torch.utils.data import default_collate

from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.datasets import NO_COMMAND
from lerobot_lansar.peers.gr1.modeling_gr1 import load_image_encoder
from lerobot_lansar.peers.gr1.network import Seen
from lerobot_lansar.peers.inputs import shift
from lerobot_lansar.peers.latent_plan.hand_frame import to_hand, to_world
from lerobot_lansar.peers.latent_plan.mixture import LogisticMixture

from .conftest import FORMS, LENGTH, SIZE, make, make_dataset

KINDS = tuple(FORMS)


def windows(kind, policy, datasets, starts):
    """A batch of the windows that begin in these frames, as LeRobot gives them to this policy."""
    root = datasets[FORMS[kind]]
    meta = LeRobotDatasetMetadata("test/squares", root=root)
    deltas = resolve_delta_timestamps(policy.config, meta)
    dataset = LeRobotDataset("test/squares", root=root, delta_timestamps=deltas)
    return default_collate([dataset[start] for start in starts])


def observation(*commands, seed=1):
    rng = np.random.default_rng(seed)
    pictures = rng.uniform(size=(2, len(commands), 3, SIZE, SIZE))
    shown = {
        f"observation.images.{c}": torch.tensor(p).float() for c, p in zip(("static", "gripper"), pictures, strict=True)
    }
    state = torch.tensor(rng.normal(size=(len(commands), 15))).float()
    return {**shown, "observation.state": state, "task": list(commands)}


# ---- learning


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "updates", "rate"), [("mcil", 400, 5e-3), ("hulc", 600, 1e-3), ("gr1", 100, 2e-3)])
def test_it_learns_32_demonstrations_by_heart(kind, updates, rate, datasets):
    options = {"window": 4, "image_size": 32, "dropout": 0.0} if kind == "gr1" else {"window": 4, "min_window": 4}
    if kind == "hulc":
        options["recognition_dropout"] = 0.0
    meta = LeRobotDatasetMetadata("test/squares", root=datasets[FORMS[kind]])
    policy, prepare, _ = make(kind, dataset_meta=meta, static_shift=0, gripper_shift=0, **options)
    batch = prepare(windows(kind, policy, datasets, range(0, 32 * LENGTH, LENGTH)))
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=rate)
    # MCIL swings at constant rates of 5e-4 to 5e-3; HULC learns what a plan means late, and before the rate falls.
    falling = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=updates) if kind == "mcil" else None
    losses = []
    for _ in range(updates):
        loss, _ = policy.train().forward(batch)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        if falling:
            falling.step()
        losses.append(loss.item())
    arm, gripper, target = predicted(kind, policy.eval(), batch)
    error = (arm - target[..., :6])[..., :2].abs().mean()  # the hand moves in x and y only
    plain = (target[..., :2] - target[..., :2].mean((0, 1))).abs().mean()
    print(f"{kind}: loss {losses[0]:.3f} to {losses[-1]:.3f}; error {error:.3f}, of the mean action {plain:.3f}")
    assert losses[-1] < losses[0]
    assert error < 0.35 * plain
    assert ((gripper > 0) == (target[..., 6] > 0)).float().mean() > 0.95


@torch.no_grad()
def predicted(kind, policy, batch):
    """Arm and gripper at every step, from the command; plans come from the proposal, as in a rollout; and the truth."""
    network = policy.network
    if kind == "gr1":
        steps = policy.config.window
        seen = [
            policy._see(policy._prepare(batch[f"observation.images.{c}"][:, :steps], c), c)
            for c in ("static", "gripper")
        ]
        tokens = torch.cat([network.read_state(batch["observation.state"][:, :steps])[:, :, None], *seen], dim=2)
        command = network.read_command(batch["observation.clip.command"])
        arm, gripper = network.actions(network(Seen(command, tokens), ("action",))["action"])
        return arm, gripper, batch["action"]
    left = (~batch["action_is_pad"]).sum(dim=1)
    seen, target = policy._see_windows(batch, left), policy._padded_actions(batch, left)
    goal = network.command_goal(batch["observation.clip.command"])
    mixture, logits, _ = network.act(network.draw(network.propose(seen[:, 0], goal)), seen, goal)
    means = (mixture.logits.softmax(-1) * mixture.means).sum(-1)
    return means[..., :6], means[..., 6] if logits is None else logits[..., 1] - logits[..., 0], target


# ---- parts of MCIL and HULC


def test_the_bins_of_a_mixture_share_all_probability_and_samples_follow_it():
    torch.manual_seed(0)
    bins = 10
    mixture = LogisticMixture(*(torch.randn(1, 3) * size for size in (1.0, 0.4, 0.5)), bins)
    mixture.log_scales -= 2
    centres = torch.linspace(-1, 1, bins)
    many = LogisticMixture(*(p.expand(bins, 1, 3) for p in (mixture.logits, mixture.means, mixture.log_scales)), bins)
    shares = many.log_prob(centres[:, None]).exp()
    assert shares.sum() == pytest.approx(1, abs=1e-5)
    drawn = LogisticMixture(
        *(p.expand(20_000, 1, 3) for p in (mixture.logits, mixture.means, mixture.log_scales)), bins
    )
    which = ((drawn.sample()[:, 0].clamp(-1, 1) + 1) * (bins - 1) / 2).round().long()
    assert (torch.bincount(which, minlength=bins) / 20_000 - shares).abs().max() < 0.015


def test_actions_come_back_from_the_frame_of_the_hand():
    rng = np.random.default_rng(0)
    state = torch.tensor(rng.normal(0, 0.4, (64, 15)) + [0, 0, 0, np.pi, 0, 1.5, *[0] * 9]).float()
    actions = torch.tensor(rng.uniform(-1, 1, (64, 7))).float()
    assert (to_world(to_hand(actions, state), state) - actions).abs().max() < 1e-3
    level = state.clone()
    level[:, 3:6] = torch.tensor([0, 0, np.pi / 2])  # turned about z only: what is x for the world is -y for the hand
    turned = to_hand(torch.eye(7)[:1].expand(64, -1), level)
    assert turned[0, :3].tolist() == pytest.approx([0, -1, 0], abs=1e-6)


def test_after_a_windows_end_the_hand_stays_and_sees_what_it_saw_last(datasets):
    policy, prepare, _ = make("hulc", action_frame="world")
    policy.eval()
    batch = prepare(windows("hulc", policy, datasets, [LENGTH - 9, 0]))  # 9 frames to the end, and all 16
    for camera in ("static", "gripper"):
        batch[f"observation.images.{camera}"] = torch.rand(2, 16, 3, SIZE, SIZE)
    batch["action"][0, 9:] = 0.5  # whatever the dataset repeats there
    with torch.no_grad():
        left = policy._draw_lengths((~batch["action_is_pad"]).sum(dim=1))
        seen, actions = policy._see_windows(batch, left), policy._padded_actions(batch, left)
        alone = policy._see(*(batch[f"observation.images.{c}"][0, 8:9] for c in ("static", "gripper")))
    assert left.tolist() == [9, 16]
    assert torch.allclose(seen[0, 8:], alone.expand(8, -1), atol=1e-5)
    assert not torch.allclose(seen[0, 7], seen[0, 8], atol=1e-3)
    assert (actions[0, 9:, :6] == 0).all()
    assert (actions[0, 9:, 6] == batch["action"][0, 8, 6]).all()
    assert torch.equal(actions[1], batch["action"][1])
    policy.train()
    drawn = torch.stack([policy._draw_lengths(torch.tensor([9, 16])) for _ in range(200)])
    assert drawn.min(0).values.tolist() == [8, 8]
    assert drawn.max(0).values.tolist() == [9, 16]


def test_frames_without_a_command_teach_only_by_their_last_picture(datasets):
    policy, prepare, _ = make("hulc")
    batch = prepare(windows("hulc", policy, datasets, [0, LENGTH]))

    def learned():
        loss, terms = policy.forward(batch)
        policy.zero_grad()
        loss.backward()
        goals = {name: getattr(policy.network, f"{name}_goal") for name in ("command", "picture")}
        assert list(terms) == [f"{g}_{t}" for g in goals if f"{g}_kl" in terms for t in ("action_loss", "kl")] + [
            "contrastive_loss"
        ], "every process of a training reports the same terms"
        return {
            name
            for name, goal in goals.items()
            if any(weight.grad is not None and weight.grad.abs().max() > 0 for weight in goal.parameters())
        }

    batch["task"] = [NO_COMMAND, NO_COMMAND]
    assert learned() == {"picture"}
    batch["task"][1] = "lift the red block"
    assert learned() == {"picture", "command"}
    policy.config.picture_goals = False
    assert learned() == {"command"}
    batch["task"][1] = NO_COMMAND
    assert learned() == set()


def test_only_windows_that_end_a_demonstration_are_contrasted_with_their_commands(datasets):
    policy, prepare, _ = make("hulc", contrastive_starts=2)
    found = {}
    for start in (0, LENGTH - 10, LENGTH - 9):  # with 8 frames at least, a window can begin 8 or 9 before the end
        batch = prepare(windows("hulc", policy, datasets, [start, LENGTH + start]))
        found[start] = policy.forward(batch)[1]["contrastive_loss"]
    assert [loss > 0 for loss in found.values()] == [False, False, True]


def test_in_play_a_window_of_a_command_ends_with_it(tmp_path):
    sentences = [NO_COMMAND] * 10 + ["lift the red block"] * 12 + [NO_COMMAND] * 2
    make_dataset(tmp_path / "play", "rel", 1, sentences=sentences)
    meta = LeRobotDatasetMetadata("test/squares", root=tmp_path / "play")
    policy, prepare, _ = make("hulc", dataset_meta=meta)
    batch = prepare(windows("hulc", policy, {"rel": tmp_path / "play"}, [0, 10, 14, 15]))
    left, told, command_left = policy._frames_left(batch)
    assert left.tolist() == [16, 14, 10, 9]
    assert told.tolist() == [False, True, True, False]  # the last is told something, but for 7 frames only
    assert command_left[1:3].tolist() == [12, 8]
    assert policy.forward(batch)[1]["contrastive_loss"] > 0


@pytest.mark.parametrize("kind", ["mcil", "hulc"])
def test_a_plan_lasts_until_it_is_old_or_the_command_changes(kind):
    policy, prepare, _ = make(kind)
    plans = []
    for step in range(8):
        commands = ["lift the red block", "lift the blue block" if step < 3 else "push the blue block"]
        policy.select_action(prepare(observation(*commands, seed=step)))
        plans.append(policy._rollout.plan.clone())
    new = [[not torch.equal(plans[t][env], plans[t - 1][env]) for env in (0, 1)] for t in range(1, 8)]
    assert [row[0] for row in new] == [False, False, False, False, True, False, False]  # replan_steps is 5
    assert [row[1] for row in new] == [False, False, True, False, False, False, False]
    policy.reset()
    assert policy._rollout is None


def test_pictures_of_a_window_are_moved_alike():
    torch.manual_seed(0)
    pictures = torch.rand(1, 3, 9, 9).expand(12, -1, -1, -1)
    moved = shift(pictures, 2, group=4)
    assert all(torch.equal(moved[4 * k], moved[4 * k + 3]) for k in range(3))
    assert not torch.equal(moved[0], moved[4])
    corner = pictures[0, :, 2:7, 2:7]  # within 2 pixels of the middle in all of them
    assert any(torch.equal(moved[0, :, y : y + 5, x : x + 5], corner) for y in range(5) for x in range(5))


# ---- parts of GR-1


def test_gr1_predicts_step_by_step_what_it_learns_in_windows(datasets):
    policy, prepare, finish = make("gr1")
    policy.eval()
    batch = prepare(windows("gr1", policy, datasets, [0]))
    expected, logits, _ = predicted("gr1", policy, batch)
    for step in range(policy.config.window):
        seen = {key: batch[key][:, step] for key in batch if key.startswith("observation.images") and "pad" not in key}
        seen |= {"observation.state": batch["observation.state"][:, step], "task": batch["task"]}
        action = finish(policy.select_action(prepare(seen)))
        assert torch.allclose(action[0, :6], expected[0, step], atol=1e-5)
        assert action[0, 6] == (1 if logits[0, step] > 0 else -1)
    commands = ("lift the red block", "lift the blue block")
    policy.reset()
    both = [policy.select_action(prepare(observation(*commands, seed=step))) for step in range(3)]
    for env in range(2):
        policy.reset()
        for step in range(3):
            seen = {k: v[env : env + 1] for k, v in observation(*commands, seed=step).items()}
            assert torch.allclose(policy.select_action(prepare(seen))[0], both[step][env], atol=1e-5)


def test_what_gr1_is_asked_changes_no_other_answer(datasets):
    policy, prepare, _ = make("gr1")
    policy.eval()
    batch = prepare(windows("gr1", policy, datasets, [0]))
    network = policy.network
    tokens = torch.randn(1, 4, 9, network.config.hidden)
    seen = Seen(network.read_command(batch["observation.clip.command"]), tokens)
    with torch.no_grad():
        alone, every = network(seen, ("action",)), network(seen, ("gripper", "action", "static"))
        later = Seen(seen.command, torch.cat([tokens[:, :3], torch.randn_like(tokens[:, 3:])], dim=1))
        changed = network(later, ("action",))
    assert torch.allclose(alone["action"], every["action"], atol=1e-5)
    assert torch.allclose(alone["action"][:, :3], changed["action"][:, :3], atol=1e-5)
    assert not torch.allclose(alone["action"][:, 3], changed["action"][:, 3], atol=1e-3)


def test_gr1_learns_nothing_from_beyond_a_demonstration(datasets):
    policy, prepare, _ = make("gr1", static_shift=0, gripper_shift=0, dropout=0.0)
    batch = prepare(windows("gr1", policy, datasets, [LENGTH - 4]))
    before = policy.forward(batch)[1]
    assert list(before) == ["arm_loss", "gripper_loss", "static_picture_loss", "gripper_picture_loss"]
    batch["action"][:, 4:] = 5
    for camera in ("static", "gripper"):
        batch[f"observation.images.{camera}"][:, 4:] = 0.5
    after = policy.forward(batch)[1]
    assert before == pytest.approx(after, rel=1e-5)
    batch["action"][:, 3] = 5
    assert policy.forward(batch)[1]["arm_loss"] != pytest.approx(before["arm_loss"])


def test_gr1_learns_no_action_of_play_that_is_not_its_commands(tmp_path):
    sentences = ["lift the red block"] * 3 + ["lift the blue block"] * 15 + [NO_COMMAND] * 6
    make_dataset(tmp_path / "play", "rel", 1, sentences=sentences)
    meta = LeRobotDatasetMetadata("test/squares", root=tmp_path / "play")
    policy, prepare, _ = make("gr1", dataset_meta=meta, static_shift=0, gripper_shift=0, dropout=0.0)
    batch = prepare(windows("gr1", policy, {"rel": tmp_path / "play"}, [0, 18]))
    before = policy.forward(batch)[1]
    batch["action"][0, 3:] = batch["action"][1] = 5  # of another command, and of none
    assert policy.forward(batch)[1] == pytest.approx(before, rel=1e-5)
    batch["action"][0, 2] = 5
    assert policy.forward(batch)[1]["arm_loss"] != pytest.approx(before["arm_loss"])
    alone = {key: value[1:] for key, value in batch.items() if isinstance(value, torch.Tensor | list)}
    nothing = policy.forward(alone)[1]
    assert nothing["arm_loss"] == nothing["gripper_loss"] == 0


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("hulc", "bins", 11),
        ("hulc", "gripper_weight", 0.0),
        ("mcil", "clip", ClipConfig("lansar-desk", "")),
        ("gr1", "image_encoder_weights", "a.pth"),
    ],
)
def test_what_a_checkpoints_weights_are_made_for_cannot_be_changed_under_them(kind, name, value, datasets, tmp_path):
    policy, _, _ = make(kind)
    policy.save_pretrained(tmp_path)
    meta = LeRobotDatasetMetadata("test/squares", root=datasets[FORMS[kind]])
    config = policy.config
    config.pretrained_path = tmp_path
    type(policy)(config, dataset_meta=meta)
    setattr(config, name, value)
    with pytest.raises(ValueError, match=f"--policy.{name}=.* was trained with {name}="):
        type(policy)(config, dataset_meta=meta)


def test_gr1s_image_encoder_is_trained_unless_its_weights_are_given(tmp_path):
    policy, _, _ = make("gr1")
    encoder = policy.network.image_encoder
    assert all(weight.requires_grad for weight in encoder.parameters())
    torch.save({"model": {**encoder.state_dict(), "mask_token": torch.zeros(1)}}, tmp_path / "mae.pth")
    kept, _, _ = make("gr1", image_encoder_weights=str(tmp_path / "mae.pth"))
    assert not any(weight.requires_grad for weight in kept.network.image_encoder.parameters())
    torch.nn.init.zeros_(kept.network.image_encoder.patch_embed.proj.weight)
    load_image_encoder(kept.network.image_encoder, str(tmp_path / "mae.pth"))
    for name, weight in encoder.state_dict().items():
        assert torch.equal(weight, kept.network.image_encoder.state_dict()[name])
    with pytest.raises(FileNotFoundError, match="image_encoder_weights"):
        load_image_encoder(encoder, str(tmp_path / "none.pth"))
    torch.save({"model": {"cls_token": torch.zeros(1)}}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match="does not fit"):
        load_image_encoder(encoder, str(tmp_path / "other.pth"))


# ---- refusals


@pytest.mark.parametrize("kind", KINDS)
def test_unusable_features_actions_and_environments_are_refused(kind, datasets):
    policy, prepare, _ = make(kind)
    other = {"rel": "abs", "abs": "rel"}[FORMS[kind]]
    config = policy.config
    with pytest.raises(ValueError, match=f"--action={FORMS[kind]}"):
        type(policy)(config, dataset_meta=LeRobotDatasetMetadata("test/squares", root=datasets[other]))
    seen = {
        **observation("lift the red block"),
        "observation.control_mode": torch.tensor([[("rel", "abs").index(other)]]),
    }
    with pytest.raises(ValueError, match=f"--env.control_mode={FORMS[kind]}"):
        policy.select_action(prepare(seen))
    seen = observation("lift the red block")
    del seen["observation.images.gripper"]
    with pytest.raises(ValueError, match=r"--env.cameras='\[static,gripper\]'"):
        policy.select_action(prepare(seen))
    config.input_features["observation.environment_state"] = PolicyFeature(FeatureType.ENV, (24,))
    config.validate_features()
    assert "observation.environment_state" not in config.input_features, "the peers read no privileged state"
    assert ("observation.state" in config.input_features) == (kind != "mcil")
    del config.input_features["observation.images.static"]
    with pytest.raises(ValueError, match=r"observation\.images\.static is missing"):
        config.validate_features()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("hulc", {"plan": "none"}, "--policy.plan='none'"),
        ("hulc", {"min_window": 40}, "--policy.min_window=40"),
        ("hulc", {"gripper_size": 20}, "at least 36"),
        ("hulc", {"recognition_heads": 5}, "--policy.recognition_heads=5"),
        ("mcil", {"action_frame": "hand"}, "--policy.control_mode=rel"),
        ("gr1", {"heads": 7}, "--policy.heads=7"),
        ("gr1", {"image_size": 40}, "--policy.image_size=40"),
        ("gr1", {"window": 1}, "--policy.window=1"),
        ("gr1", {"control_mode": "abs"}, "--policy.control_mode='abs'"),
    ],
)
def test_impossible_options_are_named(kind, options, message):
    with pytest.raises(ValueError, match=message):
        make(kind, **options)
