"""The policy as LeRobot drives it: loss, histories, actions, checkpoints, errors."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from huggingface_hub import ModelCard
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import nn

import lerobot_lansar.clip.commands as commands_module
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import Clip, embedding_size
from lerobot_lansar.policy.configuration_lansar import LanSARConfig
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy, embed_in_parts
from lerobot_lansar.policy.processor_lansar import ClipStep, make_lansar_pre_post_processors
from lerobot_lansar.policy.scheduler import LinearWarmupDecaySchedulerConfig
from lerobot_lansar.policy.windows import get_current

from .conftest import COMMANDS, VIDEO, add_embeddings, dataset_meta, make_dataset, observation, small_config


def make_policy(seed=0, **options):
    torch.manual_seed(seed)
    return LanSARPolicy(small_config(**options)).eval()


def step(policy, rng, tasks, **extra):
    """One control step on a random observation; returns the batch the policy saw and its action."""
    rows = len(tasks)
    batch = observation(rng, rows)
    generator = torch.Generator().manual_seed(len(tasks[0]))
    size = embedding_size(policy.config.clip.model)
    batch["observation.clip.command"] = torch.stack(
        [torch.full((size,), float(len(task))) + torch.randn(size, generator=generator) for task in tasks]
    )
    for name in ("static", "gripper"):
        batch[f"observation.clip.{name}"] = torch.randn(rows, size, generator=generator)
    batch |= {"task": list(tasks), **extra}
    return batch, policy.select_action(batch)


def act_once(policy, seen, commands):
    """The actions of a policy without pictures on an observation; every command has an embedding of its own."""
    size = embedding_size(policy.config.clip.model)
    embeddings = [torch.randn(size, generator=torch.Generator().manual_seed(sum(map(ord, c)))) for c in commands]
    return policy.select_action({**seen, "observation.clip.command": torch.stack(embeddings), "task": commands})


def sampled_frames(*index):
    """What LeRobot's data loader gives the preprocessor: single frames, whose contents go unread."""
    frames = {"index": torch.tensor(index), "task": list(COMMANDS[: len(index)])}
    frames["observation.state"] = torch.zeros(len(index), 15)
    frames["observation.environment_state"] = torch.zeros(len(index), 24)
    return {**frames, "action": torch.zeros(len(index), 7)}


class FixedPrediction(nn.Module):
    """A head that always predicts the same."""

    def __init__(self, *values):
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values))

    def forward(self, x):
        return self.values.expand(len(x), -1)


def with_prediction(policy, delta, logit):
    policy.network.motion_head, policy.network.gripper_head = FixedPrediction(*delta), FixedPrediction(logit)
    return policy


def test_the_loss_is_eq_4_6_on_scaled_targets_over_valid_steps(relative):
    config = small_config(dropout=0.0, window_start="anywhere")
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(relative[0])).eval()
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    batch = preprocess(sampled_frames(0, 25, 115))
    loss, parts = policy.forward(batch)

    valid_steps = batch["valid_steps"]
    assert valid_steps.tolist() == [*range(20), *range(64, 128), *range(128, 132)]
    x, blocks, scene = policy.scaler.encode(batch["observation.state"], batch["observation.environment_state"])
    motion, logit, _ = policy.network(batch["observation.clip.command"], x, blocks, scene, valid_steps)
    target = batch["action"].reshape(-1, 7)[valid_steps]
    true = (target[:, :6] - policy.scaler.delta_mean) / policy.scaler.delta_std
    error = (motion - true).abs()
    smooth = torch.where(error < 0.1, 0.5 * error**2 / 0.1, error - 0.05)
    probability = torch.sigmoid(logit)
    cross_entropy = -(target[:, 6] * probability.log() + (1 - target[:, 6]) * (1 - probability).log()).mean()
    expected = smooth[:, :3].mean() + smooth[:, 3:].mean() + cross_entropy
    torch.testing.assert_close(loss, expected)
    assert sum(parts.values()) == pytest.approx(loss.item(), rel=1e-5)

    weighted, same_parts = policy.forward(batch, reduction="none")
    assert weighted.shape == (3,)
    torch.testing.assert_close(weighted.mean(), loss)
    assert same_parts == parts
    alone = smooth[:20, :3].mean(1) + smooth[:20, 3:].mean(1)
    alone = alone - target[:20, 6] * probability[:20].log() - (1 - target[:20, 6]) * (1 - probability[:20]).log()
    torch.testing.assert_close(weighted[0], alone.sum() * 3 / len(valid_steps))


def make_lansar_pre_post_processors_for(policy):
    config = policy.config
    config.input_features, config.output_features = config.input_features or {}, config.output_features or {}
    return make_lansar_pre_post_processors(config)


def test_an_absolute_action_is_the_pose_plus_the_unscaled_difference_with_the_thesis_constants():
    thesis = {
        "position_scale_start": 3.0,
        "position_scale_slope": 1.0,
        "yaw_scale": 1.5,
        "window": 4,
        "window_slide": 1,
    }
    policy = with_prediction(make_policy(**thesis), [1, 2, 3, 0.1, 0.2, 0.3], -1.0)
    policy.scaler.delta_mean[:] = torch.tensor([0.01, 0, 0, 0, 0, 0])
    policy.scaler.delta_std[:] = 0.1
    rng = np.random.default_rng(0)
    for length in (1, 2, 3, 4, 4):  # the history grows, then slides
        batch, action = step(policy, rng, ["open the drawer"])
        pose = batch["observation.state"][0, :6]
        scale = 3 - length / 4
        position = pose[:3] + torch.tensor([0.11, 0.2, 0.3]) * scale
        torch.testing.assert_close(action[0, :3], position)
        torch.testing.assert_close(action[0, 3:6], pose[3:] + torch.tensor([0.01, 0.02, 0.03 * 1.5]))
        assert action[0, 6] == -1


def test_neither_actions_nor_noise_make_angles_jump():
    policy = with_prediction(make_policy(state_noise=0.01), [0, 0, 0, 0.2, 0, 0], 1.0)
    batch = observation(np.random.default_rng(0), 1) | {"observation.clip.command": torch.zeros(1, 256), "task": ["a"]}
    batch["observation.state"][0, 3:6] = torch.tensor([3.1, -3.14, 4.71])
    action = policy.select_action(batch)
    torch.testing.assert_close(action[0, 3:6], torch.tensor([3.3, -3.14, 4.71]))
    assert action[0, 6] == 1
    states = batch["observation.state"].expand(100, 1, 15)
    noisy = policy._add_noise(states)
    assert 0 < (noisy - states).abs().max() < 0.1
    assert torch.equal(noisy[..., 14], states[..., 14])


def test_a_relative_action_is_the_difference_in_calvins_units_clipped():
    policy = with_prediction(make_policy(control_mode="rel"), [0.01, -0.5, 0.02, 0.025, -9, 0], 1.0)
    _, action = step(policy, np.random.default_rng(0), ["open the drawer"])
    torch.testing.assert_close(action, torch.tensor([[0.5, -1, 1, 0.5, -1, 0, 1]]))


def windows_of(tasks, clear, window, slide):
    """The steps that the history rules leave in the window at each step of one environment."""
    kept, seen, windows = [], 0, []
    for t, task in enumerate(tasks):
        if t and (task != tasks[t - 1] or seen >= clear):
            kept, seen = [], 0
        if len(kept) == window:
            kept = kept[slide:]
        kept, seen = [*kept, t], seen + 1
        windows.append(kept)
    return windows


@pytest.mark.parametrize(
    ("slide", "options"),
    [
        (1, {}),
        (32, {}),
        (7, {"mlp_norm": "layer", "command_in_context": False}),
        (32, {"command_prepended": True}),
    ],
)
def test_cached_steps_give_what_the_whole_window_at_once_gives(slide, options, monkeypatch):
    """200 steps of three environments: windows that slide, forgetting after 120 steps, commands that change."""
    config = small_config(window_slide=slide, **options)
    torch.manual_seed(0)
    policy = LanSARPolicy(config).eval()
    preprocess, _ = make_lansar_pre_post_processors(config)
    rng = np.random.default_rng(0)
    sentences = ["open the drawer", "lift the red block", "close the drawer"]
    tasks = [
        [sentences[t // 150] for t in range(200)],
        ["go"] * 200,
        [sentences[t // 30 % 3] for t in range(200)],
    ]
    expected = [windows_of(row, 120, 64, slide) for row in tasks]
    seen, predictions = [], []
    predict = policy.network.predict
    monkeypatch.setattr(policy.network, "predict", lambda x: predictions.append(predict(x)) or predictions[-1])
    for t in range(200):
        batch = preprocess({**observation(rng, 3), "task": [row[t] for row in tasks]})
        seen.append(batch)
        predictions.clear()
        policy.select_action(batch)
        ((cached, _),) = predictions
        for i in range(3):
            steps = [seen[k] for k in expected[i][t]]
            state = torch.stack([b["observation.state"][i] for b in steps])[None]
            environment = torch.stack([b["observation.environment_state"][i] for b in steps])[None]
            command = batch["observation.clip.command"][i : i + 1]
            whole, *_ = policy.network(command, *policy.scaler.encode(state, environment), torch.arange(len(steps)))
            torch.testing.assert_close(cached[i], whole[-1], atol=1e-5, rtol=0)


def test_a_history_is_cleared_for_the_row_whose_command_changes_and_after_the_set_steps():
    policy = make_policy(history_clear_steps=5, window=4, window_slide=1)
    rng = np.random.default_rng(0)
    lengths = []
    for t in range(8):
        tasks = ["open the drawer", "lift the red block" if t < 3 else "close the drawer"]
        step(policy, rng, tasks)
        lengths.append([len(history.contexts) for history in policy._histories])
    assert [row[0] for row in lengths] == [1, 2, 3, 4, 4, 1, 2, 3]
    assert [row[1] for row in lengths] == [1, 2, 3, 1, 2, 3, 4, 4]
    policy.reset()
    step(policy, rng, ["open the drawer", "close the drawer"])
    assert [len(history.contexts) for history in policy._histories] == [1, 1]


def test_a_policy_sees_what_changed_since_the_command_as_in_training(relative, monkeypatch):
    config = small_config(since_command=True, window=8, history_clear_steps=10, window_start="anywhere")
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(relative[0])).eval()
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    frames = get_current().frames
    first = frames["first"][60]
    assert 20 <= first < 60  # an episode that does not begin the dataset
    seen, encode = [], policy.network.encode_modalities
    monkeypatch.setattr(policy.network, "encode_modalities", lambda *a: seen.append(a) or encode(*a))
    for t in range(first, first + 25):  # the history is cleared twice; the command goes on
        state, environment = (torch.tensor(frames[name][t])[None] for name in ("state", "environment_state"))
        batch = {"observation.state": state, "observation.environment_state": environment, "task": [COMMANDS[0]]}
        policy.select_action(preprocess(batch))
    for t, (_, blocks, scene, *_) in zip(range(first, first + 25), seen, strict=True):
        batch = preprocess(sampled_frames(t))
        _, expected, surroundings = policy.scaler.encode(
            *(batch[f"{name}state"] for name in ("observation.", "observation.environment_", "start_environment_"))
        )
        assert torch.equal(batch["start_environment_state"][0, 0], torch.tensor(frames["environment_state"][first]))
        torch.testing.assert_close((blocks[0], scene[0]), (expected[0, 0], surroundings[0, 0]))
    assert not torch.equal(seen[0][1], seen[20][1])


@pytest.mark.parametrize("options", [{}, {"mlp_norm": "layer", "command_in_context": False}, {"use_images": True}])
def test_an_action_does_not_depend_on_its_neighbours(options):
    config = small_config(window=4, **options)
    torch.manual_seed(0)
    policy = LanSARPolicy(config).eval()
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    rng = np.random.default_rng(0)
    tasks = [["open the drawer"] * 3 if t < 3 else ["open the drawer", "lift", "drop it"] for t in range(6)]
    observations = [observation(rng, 3, pictures=config.use_images) for _ in tasks]
    together = [
        policy.select_action(preprocess({**o, "task": list(task)})) for o, task in zip(observations, tasks, strict=True)
    ]
    for row in range(3):
        policy.reset()
        for o, task, expected in zip(observations, tasks, together, strict=True):
            alone = {name: value[row : row + 1] for name, value in o.items()}
            action = policy.select_action(preprocess({**alone, "task": [task[row]]}))
            torch.testing.assert_close(action[0], expected[row], atol=1e-5, rtol=0)


def test_actions_have_the_control_mode_that_each_environment_takes():
    delta = [0.01, 0.002, 0, 0.025, 0, 0]
    policy = with_prediction(make_policy(control_mode="abs"), delta, 1.0)
    mode = {"observation.control_mode": torch.tensor([[0.0], [1.0]])}
    batch, action = step(policy, np.random.default_rng(0), ["open the drawer"] * 2, **mode)
    torch.testing.assert_close(action[0, :6], torch.tensor([0.5, 0.1, 0, 0.5, 0, 0]))
    torch.testing.assert_close(action[1, :6], batch["observation.state"][1, :6] + torch.tensor(delta))
    assert action[:, 6].tolist() == [1, 1]


def test_bad_observations_are_named():
    policy, rng = make_policy(), np.random.default_rng(0)
    batch, _ = step(policy, rng, ["a", "a"])
    broken = batch["observation.state"].clone()
    broken[1, 3] = float("nan")
    with pytest.raises(ValueError, match=r"observation.state is NaN or infinite in environment \[1\]"):
        policy.select_action({**batch, "observation.state": broken})
    with pytest.raises(ValueError, match=r"must be \(B, 15\)"):
        policy.select_action({**batch, "observation.state": broken[:, :7]})
    with pytest.raises(ValueError, match="command per environment"):
        policy.select_action({**batch, "task": None})


def test_impossible_options_are_refused_with_the_option_named():
    for option, value in (("target", "acheived"), ("hidden", 33), ("window", 0), ("orientation", "quat")):
        with pytest.raises(ValueError, match=rf"--policy.{option}|--policy.context_heads"):
            small_config(**{option: value})
    with pytest.raises(ValueError, match=r"--policy.use_spatial_context=false"):
        small_config(use_images=False, use_spatial_context=False)
    with pytest.raises(ValueError, match=r"clip.model='nope'"):
        LanSARPolicy(small_config(clip=ClipConfig("nope", "")))


def test_missing_features_are_named():
    from lerobot.configs.types import FeatureType, PolicyFeature

    config = small_config()
    config.input_features = {"observation.state": PolicyFeature(FeatureType.STATE, (6,))}
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    with pytest.raises(ValueError, match=r"shape \(6,\), not \(15,\); observation.environment_state is missing"):
        LanSARPolicy(config)


def test_a_policy_without_pictures_says_what_to_do_when_one_needs_them():
    policy = make_policy(use_images=True)
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    batch = observation(np.random.default_rng(0), 1)
    with pytest.raises(ValueError, match=r"--env.cameras="):
        preprocess({**batch, "task": ["open the drawer"]})


def test_a_checkpoint_carries_statistics_and_clip_weights(tmp_path):
    from lerobot.policies.factory import make_pre_post_processors

    root = tmp_path / "data"
    make_dataset(root, lengths=(6, 9))
    torch.manual_seed(3)
    other = Clip(ClipConfig("lansar-desk", ""))
    for parameter in other.model.parameters():
        parameter.data += 0.01 * torch.randn_like(parameter)
    weights = tmp_path / "clip.pt"
    torch.save(other.model.state_dict(), weights)
    clip = ClipConfig("lansar-desk", str(weights))
    add_embeddings(root, Clip(clip))

    policy = LanSARPolicy(small_config(use_images=True, clip=clip), dataset_meta=dataset_meta(root))
    preprocess, postprocess = make_lansar_pre_post_processors_for(policy)
    policy.train()
    loss, _ = policy.forward(preprocess(sampled_frames(0, 7)))
    loss.backward()
    policy.eval()
    for part in (policy, preprocess, postprocess):
        part.save_pretrained(tmp_path / "checkpoint")
    weights.unlink()

    from lerobot_lansar.policy import windows

    windows._current.clear()  # as in a new process
    loaded = LanSARPolicy.from_pretrained(tmp_path / "checkpoint")
    assert not torch.equal(loaded.scaler.state_mean, torch.zeros(18))
    again, _ = make_pre_post_processors(loaded.config, str(tmp_path / "checkpoint"))
    batch = observation(np.random.default_rng(0), 2, pictures=True) | {"task": list(COMMANDS[:2])}
    expected = policy.select_action(preprocess(dict(batch)))
    assert torch.equal(loaded.select_action(again(dict(batch))), expected)


def test_embeddings_made_with_other_clip_weights_are_refused(tmp_path):
    root = tmp_path / "data"
    make_dataset(root, lengths=(6,))
    clip = Clip(ClipConfig("lansar-desk", ""))
    clip.weights_sha256 = "f" * 64
    add_embeddings(root, clip)
    policy = LanSARPolicy(small_config(use_images=True), dataset_meta=dataset_meta(root))
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    with pytest.raises(ValueError, match=r"pictures were embedded with other weights.*--policy.clip.pretrained"):
        preprocess(sampled_frames(0))
    with pytest.raises(ValueError, match=r"policy was trained with other weights"):
        ClipStep("lansar-desk", "", weights_sha256="e" * 64).clip("cpu")


def test_a_policy_that_reads_only_sentences_outlives_another_image_encoder(monkeypatch):
    from lerobot_lansar.policy import windows

    windows._current.clear()  # as in a new process
    told = {images: ClipStep("lansar-desk", "", use_images=images).get_config() for images in (False, True)}
    before = Clip(ClipConfig("lansar-desk", ""))
    old = told[False] | {"weights_sha256": before.weights_sha256}  # as checkpoints said it once
    assert ClipStep(**old).clip().text_sha256 == before.text_sha256

    def altered(*arguments, **options):
        clip = Clip(*arguments, **options)
        next(clip.model.visual.parameters()).data.add_(1)
        return clip

    monkeypatch.setattr(commands_module, "Clip", altered)
    assert ClipStep(**told[False]).clip().weights_sha256 != before.weights_sha256
    with pytest.raises(ValueError, match="policy was trained with other weights"):
        ClipStep(**told[True]).clip()


def test_under_adapters_the_base_policy_stays_as_it_was_saved():
    policy = make_policy(use_images=False, mlp_norm="batch")
    norms = [module for module in policy.modules() if isinstance(module, torch.nn.modules.batchnorm._BatchNorm)]
    policy.train()
    assert norms
    assert all(norm.training for norm in norms)
    policy.config.use_peft = True  # LeRobot's mark of a policy whose adapters alone are saved
    policy.train()
    assert not any(norm.training for norm in norms)
    assert policy._get_default_peft_targets()["target_modules"] == "all-linear", "LeRobot asks for it by this name"
    assert "_get_default_peft_targets" in vars(PreTrainedPolicy)


def test_a_trained_image_encoder_begins_as_clips_and_gets_gradients_from_every_step():
    clip = Clip(ClipConfig("lansar-desk", ""))
    policy = LanSARPolicy(small_config(use_images=True, finetune_clip=True))
    pictures = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (4, 84, 84, 3), dtype=np.uint8))
    batch = {f"observation.images.{camera}": pictures for camera in ("static", "gripper")}
    batch |= {"observation.state": torch.zeros(2, 3, 15), "valid_steps": torch.tensor([0, 1, 2, 4])}  # padded: 3, 5
    policy.train()
    for embedded in policy._embed_windows(batch):
        found = embedded.flatten(0, 1)
        torch.testing.assert_close(found[[0, 1, 2, 4]], clip.encode_images(pictures), rtol=1e-4, atol=1e-5)
        assert not found[[3, 5]].any()
    encoder, weight = policy.image_encoder, policy.image_encoder.visual.trunk.convolutions[0].weight
    (whole,) = torch.autograd.grad(encoder(pictures).square().sum(), weight)
    (parts,) = torch.autograd.grad(embed_in_parts(encoder, pictures, size=3).square().sum(), weight)
    torch.testing.assert_close(parts, whole, rtol=1e-3, atol=1e-4 * whole.abs().max().item())


def test_clip_follows_the_observations_to_their_device():
    clip_step = ClipStep("lansar-desk", "")
    clip_step._windows = None  # of another test's policy
    clip_step.get_config()  # saved before its first use, on the CPU
    clip_step._commands["go"] = torch.zeros(1)
    clip = clip_step.clip("meta")  # a device that every machine has
    assert {value.device.type for value in (*clip.model.parameters(), clip.images.mean)} == {"meta"}
    assert not clip_step._commands


def test_the_schedule_warms_up_for_4_percent_and_falls_to_zero():
    optimizer = torch.optim.AdamW([nn.Parameter(torch.zeros(1))], lr=4e-4)
    schedule = LinearWarmupDecaySchedulerConfig().build(optimizer, 30000)
    factor = schedule.lr_lambdas[0]
    assert factor(0) == pytest.approx(1 / 1201)
    assert factor(600) == pytest.approx(0.5, abs=1e-3)
    assert factor(1200) == 1.0
    assert factor(15600) == pytest.approx(0.5)
    assert factor(30000) == 0.0
    values = [factor(s) for s in range(0, 30001, 50)]
    assert max(values) == 1.0
    assert np.argmax(values) == 1200 // 50


def test_the_training_presets_are_table_4_2s():
    config = LanSARConfig(device="cpu")
    optimizer = config.get_optimizer_preset()
    assert (optimizer.lr, optimizer.weight_decay) == (4e-4, 0.01)
    assert config.get_scheduler_preset().warmup_fraction == 5 / 125
    assert config.observation_delta_indices is config.action_delta_indices is None


def test_muon_updates_hidden_matrices_and_adamw_the_rest():
    policy = make_policy(optimizer="muon", learning_rate=0.01, weight_decay=0.1)
    config = policy.config.get_optimizer_preset()
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    matrices, rest = ({names[id(p)] for p in group["params"]} for group in policy.get_optim_params())
    assert matrices | rest == set(names.values())
    hidden = [
        "state_context.4",
        "motion_head.0",
        "decoder_layers.1.cross_attention.out",
        "context_layers.0.feedforward.3",
    ]
    assert {f"network.{name}.weight" for name in hidden} <= matrices
    ends = [
        "state_context.0.weight",
        "motion_head.8.weight",
        "cls.weight",
        "memory_position.weight",
        "motion_head.0.bias",
    ]
    assert {f"network.{name}" for name in ends} <= rest

    def updated(build, steps, resume_after=None):
        """The parameters after some updates with random gradients, of a new policy with an optimizer of its own."""
        policy = make_policy(optimizer="muon")
        optimizers = build(policy)
        for step in range(steps):
            generator = torch.Generator().manual_seed(step)
            for parameter in policy.parameters():
                parameter.grad = torch.randn(parameter.shape, generator=generator)
            if step == resume_after:
                state = optimizers[0].state_dict()
                optimizers = build(policy)
                optimizers[0].load_state_dict(state)
            for optimizer in optimizers:
                optimizer.step()
        return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])

    def torchs_own(policy):
        first, second = ([p for n, p in policy.named_parameters() if n in part] for part in (matrices, rest))
        muon = torch.optim.Muon(first, lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
        return muon, torch.optim.AdamW(second, lr=0.01, weight_decay=0.1)

    expected = updated(torchs_own, 4)
    ours = updated(lambda policy: [config.build(policy.get_optim_params())], 4)
    # Equal where measured, but a processor may round bfloat16 products of stacked matrices otherwise.
    torch.testing.assert_close(ours, expected, rtol=0, atol=2e-4)
    assert torch.equal(updated(lambda policy: [config.build(policy.get_optim_params())], 4, resume_after=2), ours)
    # --optimizer.type=muon for any policy: everything with two dimensions
    shapes = [[p.ndim for p in group["params"]] for group in config.build(policy.parameters()).param_groups]
    assert [set(part) for part in shapes] == [{2}, {1}]


def test_mixed_precision_changes_neither_what_is_kept_nor_what_is_decided():
    policy = make_policy()
    _, expected = step(policy, np.random.default_rng(0), ["open the drawer"])
    policy.reset()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        _, action = step(policy, np.random.default_rng(0), ["open the drawer"])
    assert torch.equal(action, expected)
    clip = Clip(ClipConfig("lansar-desk", ""), "cpu")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(clip.encode_texts(["go"]), Clip(ClipConfig("lansar-desk", ""), "cpu").encode_texts(["go"]))


def test_bfloat16_trains_in_mixed_precision_whether_or_not_lerobot_enters_it(relative):
    config = small_config(dtype="bfloat16", dropout=0.0)
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(relative[0])).eval()
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    batch = preprocess(sampled_frames(0, 25, 115))
    seen = []
    policy.network.motion_head.register_forward_hook(lambda module, inputs, output: seen.append(output.dtype))
    loss, _ = policy.forward(batch)
    assert (seen.pop(), loss.dtype) == (torch.bfloat16, torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        assert policy.forward(batch)[0] == loss
    config.dtype = "float32"
    assert policy.forward(batch)[0] != loss


def test_lerobot_decodes_no_video_for_lansar(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    make_dataset(tmp_path / "data", lengths=(6,), video=True)
    dataset = LeRobotDataset("test/desk", root=tmp_path / "data")
    with pytest.raises(Exception, match=r"mp4|Invalid data|decod"):
        dataset[0]
    LanSARPolicy(small_config(), dataset_meta=dataset.meta)
    assert VIDEO not in dataset[0]
    assert VIDEO in LeRobotDataset("test/desk", root=tmp_path / "data").meta.features  # the dataset itself is untouched


@pytest.mark.parametrize("spatial", [True, False])
def test_the_model_card_says_what_the_policy_is_and_how_to_evaluate_it(spatial, monkeypatch):
    monkeypatch.setattr(ModelCard, "validate", lambda self: None)  # asks the hub
    config = small_config(use_images=not spatial, use_spatial_context=spatial, repo_id="me/lansar")
    policy = LanSARPolicy(config)
    run = SimpleNamespace(dataset=SimpleNamespace(repo_id="me/desk"), steps=7, batch_size=4, seed=3, optimizer=None)
    card = policy.generate_model_card("me/desk", config.type, config.license, config.tags, cfg=run, dataset_meta=None)
    assert {"calvin", "lerobot_policy_lansar", "robotics", "lansar"} <= set(card.data.tags)
    assert card.data.datasets == "me/desk"
    for text in (
        "the\ndistribution `lerobot_policy_lansar`",
        "lerobot-eval --policy.path=me/lansar --env.type=calvin",
        "https://huggingface.co/datasets/me/desk",
        "| updates | 7 |",
    ):
        assert text in card.text
    assert ("privileged simulator state" in card.text) == spatial
    assert ("--env.cameras='[]'" in card.text) == spatial


def test_options_of_training_change_training_only(tmp_path):
    make_dataset(tmp_path / "data", "rel", shown=tuple(enumerate(COMMANDS)))
    config = small_config(
        dropout=0.0,
        mlp_norm="layer",
        state_noise=0.01,
        contrastive_weight=0.5,
        paraphrases=True,
        egocentric_blocks=True,
    )
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(tmp_path / "data"))
    preprocess, _ = make_lansar_pre_post_processors_for(policy)
    batch = preprocess(sampled_frames(0, 25, 115))
    policy.train()
    assert policy.forward(batch)[0] != policy.forward(batch)[0]
    policy.eval()
    generator = torch.get_rng_state()
    with torch.no_grad():
        batch = preprocess(sampled_frames(0, 25, 115))
        loss, parts = policy.forward(batch)
        assert loss == policy.forward(batch)[0]
    assert torch.equal(torch.get_rng_state(), generator)  # a held-out loss draws nothing
    assert batch["command_tasks"].tolist() == np.eye(len(COMMANDS))[:3].tolist()
    torch.testing.assert_close(policy.forward(batch, reduction="none")[0].mean(), loss)
    weights = {"contrastive_loss": 0.5}
    assert sum(weights.get(k, 1) * v for k, v in parts.items()) == pytest.approx(loss.item(), rel=1e-5)


@pytest.mark.parametrize("slide", [1, 20])
def test_an_environments_actions_do_not_depend_on_the_others_of_its_batch(slide):
    """Not even in rounding: an evaluation gives the same results in any number of workers and after an interruption."""
    policy = make_policy(use_images=False, hidden=96, feedforward=384, window=slide + 1, window_slide=slide)
    rows, steps = policy.least_rows + 5, 2 * slide + 12
    few: set[int] = set()

    def count(module, inputs):
        few.update({inputs[0].shape[:-1].numel()} & set(range(policy.least_rows)))

    layers = [layer for name, layer in policy.network.named_modules() if isinstance(layer, torch.nn.Linear)]
    for layer in layers:
        if layer not in (*policy.network.command_memory.modules(), *policy.network.command_target.modules()):
            layer.register_forward_pre_hook(count)
    rng = np.random.default_rng(0)
    seen = [observation(rng, rows) for _ in range(steps)]

    def act(chosen, lengths):
        """Actions of some environments, (steps, rows, 7); the command of each changes after so many steps."""
        policy.reset()
        taken = []
        for t, everything in enumerate(seen):
            batch = {key: value[list(chosen)] for key, value in everything.items()}
            taken.append(act_once(policy, batch, [str(t // lengths[row]) for row in chosen]))
        return torch.stack(taken)

    lengths = rng.integers(3, 12, rows)
    lengths[6] = steps  # its window slides
    together = act(range(rows), lengths)
    others = lengths + 2
    others[[1, 6]] = lengths[[1, 6]]
    assert torch.equal(act([8, 6, 0, 1, *range(9, rows)], others)[:, [1, 3]], together[:, [6, 1]])
    assert not few, "some CPUs add up so few rows in another order"
    np.testing.assert_allclose(act([6], lengths)[:, 0], together[:, 6], atol=1e-5)  # alone, rounding differs


def test_single_environments_of_a_batch_can_be_reset():
    policy = make_policy(use_images=False)
    rng = np.random.default_rng(0)
    first, second = observation(rng, 4), observation(rng, 4)
    fresh = act_once(policy, second, ["go"] * 4)
    policy.reset()
    act_once(policy, first, ["go"] * 4)
    policy.reset_environments([2])
    mixed = act_once(policy, second, ["go"] * 4)
    assert [torch.equal(mixed[i], fresh[i]) for i in range(4)] == [False, False, True, False]
