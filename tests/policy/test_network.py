"""The network alone: what it computes, what each token may see, and what each ablation removes."""

import copy
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import nn

from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.policy.network import (
    PACKED,
    Attention,
    BatchNorm,
    DecoderLayer,
    EncoderLayer,
    LanSARNetwork,
    recorded_attention,
)

from .conftest import thesis_network

TINY = thesis_network(
    clip=ClipConfig("lansar-desk", ""),
    hidden=24,
    context_layers=2,
    context_heads=2,
    decoder_layers=2,
    decoder_heads=2,
    feedforward=32,
    window=8,
)
THESIS = thesis_network()
at_both_sizes = pytest.mark.parametrize("size", [TINY, THESIS], ids=["tiny", "thesis"])


def windows(config, lengths, seed=0):
    """Random inputs of windows of the given lengths, as keyword arguments of the network."""
    generator = torch.Generator().manual_seed(seed)
    rows, steps = len(lengths), max(lengths)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    return {
        "command": draw(rows, config.clip_dim),
        "state": draw(rows, steps, config.state_dim),
        "blocks": draw(rows, steps, 3, config.block_dim),
        "scene": draw(rows, steps, config.scene_dim),
        "valid_steps": torch.cat([i * steps + torch.arange(length) for i, length in enumerate(lengths)]),
        "static": draw(rows, steps, config.clip_dim),
        "gripper": draw(rows, steps, config.clip_dim),
    }


def build(size=TINY, **options):
    torch.manual_seed(0)
    return LanSARNetwork(replace(size, **options))


def gradient_reaches(network, name):
    """Whether the predictions depend on the input called `name`."""
    inputs = windows(network.config, [5, 5])
    inputs[name] = inputs[name].requires_grad_()
    motion, logit, _ = network.eval()(**inputs)
    (motion.sum() + logit.sum()).backward()
    gradient = inputs[name].grad
    return gradient is not None and bool(gradient.abs().sum() > 0)


def test_layers_compute_what_pytorchs_transformer_layers_compute():
    torch.manual_seed(0)
    h, heads = 24, 4
    x, memory = torch.randn(3, 6, h), torch.randn(3, 6, h)
    causal = nn.Transformer.generate_square_subsequent_mask(6)
    encoder = EncoderLayer(h, heads, 32, 0.1).eval()
    decoder = DecoderLayer(h, heads, 32, 0.1).eval()
    torch_encoder = nn.TransformerEncoderLayer(h, heads, 32, batch_first=True).eval()
    torch_decoder = nn.TransformerDecoderLayer(h, heads, 32, batch_first=True).eval()

    def copy_attention(ours, theirs):
        parts = (ours.query, ours.key, ours.value)
        theirs.in_proj_weight.data = torch.cat([part.weight for part in parts]).detach()
        theirs.in_proj_bias.data = torch.cat([part.bias for part in parts]).detach()
        theirs.out_proj.load_state_dict(ours.out.state_dict())

    copy_attention(encoder.attention, torch_encoder.self_attn)
    copy_attention(decoder.self_attention, torch_decoder.self_attn)
    copy_attention(decoder.cross_attention, torch_decoder.multihead_attn)
    for ours, theirs in ((encoder, torch_encoder), (decoder, torch_decoder)):
        theirs.linear1.load_state_dict(ours.feedforward[0].state_dict())
        theirs.linear2.load_state_dict(ours.feedforward[3].state_dict())

    torch.testing.assert_close(encoder(x), torch_encoder(x), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(encoder(x, queries=1), torch_encoder(x)[:, :1], rtol=1e-4, atol=1e-5)
    expected = torch_decoder(x, memory, tgt_mask=causal, memory_mask=causal)
    torch.testing.assert_close(decoder(x, memory), expected, rtol=1e-4, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("prepended", [False, True])
@at_both_sizes
def test_a_step_is_not_changed_by_what_comes_after_it(size, prepended):
    network = build(size, command_prepended=prepended).eval()
    inputs = windows(size, [size.window])
    motion, logit, _ = network(**inputs)
    assert (motion.shape, logit.shape) == ((size.window, 6), (size.window,))
    for step in (1, size.window // 2, size.window - 1):
        changed = {name: value.clone() for name, value in inputs.items()}
        for name in ("state", "blocks", "scene", "static", "gripper"):
            changed[name][:, step:] += 10
        other_motion, other_logit, _ = network(**changed)
        assert torch.equal(motion[:step], other_motion[:step])
        assert torch.equal(logit[:step], other_logit[:step])
        assert not torch.allclose(motion[step], other_motion[step])
        assert not torch.allclose(logit[step], other_logit[step])


def test_every_earlier_step_is_seen():
    network = build().eval()
    inputs = windows(TINY, [6])
    inputs["state"].requires_grad_()
    network(**inputs)[0][-1].sum().backward()
    assert (inputs["state"].grad[0].abs().sum(dim=1) > 0).all()


@torch.no_grad()
@pytest.mark.parametrize("norm", ["batch", "layer"])
@at_both_sizes
def test_padding_changes_nothing_in_training_mode_either(size, norm):
    network = build(size, mlp_norm=norm, dropout=0.0).train()
    inputs = windows(size, [6, 3])
    motion, logit, _ = network(**inputs)
    wild = {name: value.clone() for name, value in inputs.items()}
    for name in ("state", "blocks", "scene", "static", "gripper"):
        wild[name][1, 3:] = 1e6
    torch.testing.assert_close(network(**wild)[0], motion, rtol=0, atol=0)

    longer = {name: value.clone() for name, value in inputs.items()}
    for name in ("state", "blocks", "scene", "static", "gripper"):
        pad = torch.zeros_like(longer[name][:, :2])
        longer[name] = torch.cat([longer[name], pad], dim=1)
    longer["valid_steps"] = torch.tensor([0, 1, 2, 3, 4, 5, 8, 9, 10])
    torch.testing.assert_close(network(**longer)[0], motion, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(network(**longer)[1], logit, rtol=1e-4, atol=1e-5)


@at_both_sizes
def test_dropped_modalities_have_no_token_no_parameter_and_no_influence(size):
    full, no_images = build(size), build(size, use_images=False)
    no_spatial = build(size, use_spatial_context=False)
    assert full.context_tokens == ["CLS", "X", "B_red", "B_blue", "B_pink", "S", "I", "G"]
    assert no_images.context_tokens == ["CLS", "X", "B_red", "B_blue", "B_pink", "S"]
    assert no_spatial.context_tokens == ["CLS", "I", "G"]
    for name in ("command", "state", "blocks", "scene", "static", "gripper"):
        assert gradient_reaches(full, name)
        assert gradient_reaches(no_images, name) == (name not in ("static", "gripper"))
        assert gradient_reaches(no_spatial, name) == (name not in ("blocks", "scene"))  # the target keeps X
    assert not [name for name, _ in no_images.named_parameters() if "static" in name or "gripper_c" in name]
    dropped = ("block_context", "scene_context", "state_context")
    assert not [name for name, _ in no_spatial.named_parameters() if name.startswith(dropped)]
    assert [name for name, _ in no_spatial.named_parameters() if name.startswith("state_target")]


def test_a_context_sees_the_command_only_when_asked_to():
    inputs = windows(TINY, [4])
    for in_context in (False, True):
        network = build(command_in_context=in_context).eval()
        command = torch.randn(4, TINY.hidden, requires_grad=True)
        names = ("state", "blocks", "scene", "static", "gripper")
        context = network.encode_context(network.encode_modalities(*(inputs[name][0] for name in names)), command)
        (gradient,) = torch.autograd.grad(context.sum(), command, allow_unused=True)
        assert (gradient is not None) == in_context == ("C" in network.context_tokens)


def test_the_command_decides_which_block_a_single_context_layer_looks_at():
    inputs = windows(TINY, [1])
    for in_context in (False, True):
        network = build(command_in_context=in_context, context_layers=1).eval()
        tokens = network.encode_modalities(
            *(inputs[name][0] for name in ("state", "blocks", "scene", "static", "gripper"))
        )
        shares = []
        for command in torch.randn(2, 1, TINY.hidden):
            with recorded_attention(network.context_layers) as seen:
                network.encode_context(tokens, command)
            (weights,) = seen["0.attention"]
            red, blue = (network.context_tokens.index(f"B_{color}") for color in ("red", "blue"))
            shares.append(weights[0, :, 0, red] / weights[0, :, 0, blue])
        assert torch.allclose(*shares) != in_context


def test_a_prepended_command_stands_once_at_the_front():
    steps, command = torch.ones(1, 3, TINY.hidden), torch.zeros(1, TINY.hidden)
    kinds = {
        prepended: build(command_prepended=prepended)._add_command(steps, command)[0, :, 0].tolist()
        for prepended in (False, True)
    }
    assert kinds == {False: [0, 1, 0, 1, 0, 1], True: [0, 1, 1, 1]}


def test_the_thesis_size_has_the_parameters_table_4_2_implies():
    h, feedforward = 512, 2048
    attention, norm = 4 * (h * h + h), 2 * h
    mixing = h * feedforward + feedforward + feedforward * h + h

    def mlp(*sizes, last=True):  # linear + BatchNorm each; a head's last linear has none
        total = sum(a * b + b + 2 * b for a, b in pairwise(sizes))
        return total if last else total - 2 * sizes[-1]

    inputs = [512, 512, 15, 15, 6, 6, 512, 512]  # C twice, X twice, B, S, I, G
    expected = sum(mlp(size, h // 3, 2 * h // 3, h) for size in inputs)
    expected += mlp(h, 256, 64, 6, last=False) + mlp(h, 256, 64, 1, last=False)
    expected += 6 * (attention + mixing + 2 * norm) + 6 * (2 * attention + mixing + 3 * norm)
    expected += h + 8 * h + 2 * 128 * h  # CLS, modality positions, memory and target positions
    network = LanSARNetwork(THESIS)
    assert sum(p.numel() for p in network.parameters()) == expected
    assert expected == 46_811_811  # docs/lansar.md


def test_weights_start_xavier_uniform_and_biases_zero():
    network = LanSARNetwork(replace(TINY, hidden=64))
    for module in network.modules():
        if isinstance(module, nn.Linear | nn.Embedding):
            bound = (6 / sum(module.weight.shape)) ** 0.5
            assert 0.8 * bound < module.weight.abs().max() <= bound
        if isinstance(module, nn.Linear):
            assert (module.bias == 0).all()


def test_a_single_row_passes_batch_norm_in_training():
    norm = BatchNorm(4).train()
    assert norm(torch.randn(1, 4)).isfinite().all()
    network = build().train()
    motion, *_ = network(**windows(TINY, [1]))
    assert motion.shape == (1, 6)


@torch.no_grad()
def test_recorded_attention_is_what_makes_the_output_and_costs_nothing_otherwise():
    network = build().eval()
    inputs = windows(TINY, [5])
    plain = network(**inputs)[0]
    with (
        recorded_attention(network.context_layers) as context,
        recorded_attention(network.decoder_layers) as decoder,
    ):
        torch.testing.assert_close(network(**inputs)[0], plain)
    assert all(not module.weights for module in network.modules() if isinstance(module, Attention))
    assert {name: [tuple(w.shape) for w in calls] for name, calls in context.items()} == {
        "0.attention": [(5, 2, 8, 8)],
        "1.attention": [(5, 2, 1, 8)],  # only CLS is read in the last layer
    }
    (weights,) = decoder["1.cross_attention"]
    assert weights.shape == (1, 2, 10, 10)
    torch.testing.assert_close(weights.sum(-1), torch.ones(1, 2, 10))
    assert (weights.triu(1) == 0).all()

    attention = network.decoder_layers[0].self_attention
    x, memory = torch.randn(2, 1, 6, TINY.hidden)
    cache = network.new_cache(1)
    for decoded in (slice(0, 4), slice(4, 6)):  # with the cache: four tokens, then two that also see these
        view = cache.add([0], (decoded.stop - decoded.start) // 2)
        attention.weights = []
        out = attention(x[:, decoded], memory[:, decoded], cache=view)
        values = attention.value(memory[:, : decoded.stop]).unflatten(-1, (2, -1)).transpose(1, 2)
        mixed = (attention.weights[0] @ values).transpose(1, 2).flatten(2)
        torch.testing.assert_close(attention.out(mixed), out)
    attention.weights = []
    torch.testing.assert_close(attention(x, memory, causal=True)[:, decoded], out)


def test_the_contrastive_loss_falls_when_windows_and_their_commands_agree():
    network = build(contrastive=True).eval()
    inputs = windows(TINY, [4, 6, 3, 5])
    inputs["command_tasks"] = torch.eye(3)[[0, 1, 2, 0]]  # two windows of one task
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(60):
        *_, loss = network(**inputs)
        losses.append(loss.item())
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    floor = (2 * torch.tensor(0.5).log().abs() / 4).item()  # the two windows of one task tell nothing
    assert losses[0] > 1.2
    assert losses[-1] == pytest.approx(floor, abs=0.05)
    assert build()(**windows(TINY, [4]))[2] is None


def test_commands_that_share_a_task_are_no_negatives_in_the_contrastive_loss():
    network = build(contrastive=True).eval()
    inputs = windows(TINY, [4, 6, 5])
    inputs["command_tasks"] = torch.tensor([[1.0, 0], [1, 1], [0, 0]])  # red, "lift it", none
    seen = []
    cross_entropy = torch.nn.functional.cross_entropy
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            torch.nn.functional,
            "cross_entropy",
            lambda x, labels: seen.append(labels) or cross_entropy(x, labels),
        )
        network(**inputs)
    assert len(seen) == 2  # pictures to commands, commands to pictures
    for labels in seen:
        assert labels.tolist() == [[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 1]]


@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_compiled_transformers_compute_the_same_with_the_same_weights(norm):
    network = build(dropout=0.0, mlp_norm=norm).train()
    compiled = copy.deepcopy(network)
    compiled.compile_transformers(backend="aot_eager")
    assert compiled.state_dict().keys() == network.state_dict().keys()
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    for lengths in ((8, 3, 5), (1, 8, 2)):  # as many windows, padded to as many steps
        inputs = windows(network.config, lengths)
        outputs = []
        for each in (network, compiled):
            each.zero_grad()
            motion, logit, _ = each(**inputs)
            (motion.square().sum() + logit.sum()).backward()
            outputs.append([motion, logit, *(p.grad for p in each.parameters())])
        for one, other in zip(*outputs, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    counts = torch._dynamo.utils.counters["stats"]
    assert counts["unique_graphs"] == 2  # one for each transformer, not one for each number of valid steps


@pytest.mark.parametrize("queries", [None, 1])
def test_packed_attention_computes_the_same(queries):
    torch.manual_seed(0)
    attention = Attention(12, 3, dropout=0.0).train()
    memory = torch.randn(2 * PACKED, 7, 12, requires_grad=True)
    results = []
    for attend in (attention.forward, attention._packed):
        attention.zero_grad()
        memory.grad = None
        attended = attend(memory[:, :queries], memory)
        attended.square().sum().backward()
        results.append([attended, memory.grad, *(p.grad for p in attention.parameters())])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def test_neither_forward_nor_backward_pass_synchronises_a_gpu():
    """PyTorch's fake tensors have no values: reading one (an item, a mask's count) raises."""
    from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

    with FakeTensorMode():
        network = build(contrastive=True, command_in_context=True).train()
        inputs = windows(TINY, [6, 3]) | {"command_tasks": torch.ones(2, 4)}
        motion, logit, contrast = network(**inputs)
        (motion.sum() + logit.sum() + contrast).backward()
        assert motion.shape == (9, 6)
        with pytest.raises(DataDependentOutputException):
            motion.sum().item()


@pytest.mark.parametrize("where", ["padding", "batch"])
def test_the_contrastive_loss_describes_a_window_by_its_own_steps(where):
    network = build(contrastive=True).eval()
    inputs = windows(TINY, [4, 6]) | {"command_tasks": torch.eye(2)}
    before = network(**inputs)[2]
    other = {name: value.clone() for name, value in inputs.items()}
    if where == "padding":
        other["state"][0, 4:] += 100
        assert torch.equal(network(**other)[2], before)
    else:
        other["state"][0, 1] += 100
        assert not torch.allclose(network(**other)[2], before)
