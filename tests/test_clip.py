"""CLIP through open_clip, and the small trained one that comes with the package."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from lerobot_lansar.calvin import COLORS, SCENE_NAMES, TASKS, block_pose
from lerobot_lansar.cameras import intrinsics, static_camera_pose
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import CLIP_MODELS, Clip, ImageEncoder, embedding_size, weights_are_public
from lerobot_lansar.desk import Desk
from lerobot_lansar.desk.sentences import COMMANDS


def test_clip_embeds_both_image_layouts_alike_and_tells_commands_apart():
    clip = Clip(ClipConfig("lansar-desk", ""))
    images = np.random.default_rng(0).integers(0, 256, (2, 84, 84, 3), dtype=np.uint8)
    floats = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    assert clip.embed_dim == embedding_size("lansar-desk") == 256
    torch.testing.assert_close(clip.encode_images(images), clip.encode_images(floats), rtol=0, atol=0)
    texts = F.normalize(clip.encode_texts(["open the drawer", "close the drawer", "lift the red block"]))
    assert (texts @ texts.T).fill_diagonal_(0).max() < 0.95
    with pytest.raises(ValueError, match="uint8"):
        clip.encode_images(images[0])
    torch.manual_seed(5)
    state = torch.get_rng_state()
    assert Clip(ClipConfig("lansar-desk", "")).weights_sha256 == clip.weights_sha256
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("load", [True, False])
def test_a_tags_weights_get_the_activation_and_the_scaling_they_were_trained_with(monkeypatch, load):
    import open_clip

    seen = {}

    def create_model(name, pretrained=None, **options):
        seen.update(options, pretrained=pretrained)
        raise RuntimeError("stop here")

    monkeypatch.setattr(open_clip, "create_model", create_model)
    with pytest.raises(RuntimeError, match="stop here"):
        Clip(ClipConfig(), load=load)
    assert seen.pop("force_preprocess_cfg")["mean"][0] == pytest.approx(0.4815, abs=1e-4)
    assert seen == {"pretrained": "openai" if load else None, "force_quick_gelu": True}
    with pytest.raises(RuntimeError, match="stop here"):
        Clip(ClipConfig("ViT-B-16-SigLIP", "webli"), load=load)
    assert seen["force_preprocess_cfg"]["mean"] == (0.5, 0.5, 0.5)
    with pytest.raises(ValueError, match="neither a weights file nor a tag"):
        Clip(ClipConfig("ViT-B-32", "no-such-tag"))


def test_a_trained_encoder_keeps_the_statistics_of_its_normalisation():
    from open_clip.modified_resnet import ModifiedResNet

    visual = ModifiedResNet([1, 1, 1, 1], output_dim=8, heads=2, image_size=32, width=8)
    encoder = ImageEncoder(visual, {"size": 32, "mean": [0.5] * 3, "std": [0.5] * 3}).train()
    before = {name: value.clone() for name, value in visual.named_buffers()}
    encoder(torch.rand(4, 3, 32, 32)).sum().backward()
    assert any("running_mean" in name for name in before)
    assert all(torch.equal(value, before[name]) for name, value in visual.named_buffers())
    assert visual.conv1.weight.grad.abs().max() > 0


@pytest.fixture(scope="module")
def desk_clip():
    return Clip(ClipConfig("lansar-desk", "v1"))


def test_the_packaged_weights_are_small_and_named_like_open_clips(desk_clip):
    assert (CLIP_MODELS / "lansar-desk-v1.safetensors").stat().st_size < 12e6
    assert weights_are_public(ClipConfig("lansar-desk", "v1"))
    assert not weights_are_public(ClipConfig("lansar-desk", ""))
    assert desk_clip.weights_sha256 != Clip(ClipConfig("lansar-desk", "")).weights_sha256
    with pytest.raises(ValueError, match=r"tag of lansar-desk \(v1\)"):
        Clip(ClipConfig("lansar-desk", "v0"))


def not_nearest(clip, pairs):
    """Of (task, sentence) pairs the sentences that are nearer to another task's training sentences."""

    def embed(sentences):
        return F.normalize(clip.encode_texts(sentences), dim=-1)

    centres = torch.stack([F.normalize(embed(COMMANDS["training"][task]).mean(0), dim=0) for task in TASKS])
    nearest = (embed([sentence for _, sentence in pairs]) @ centres.T).argmax(1).tolist()
    return [pair for pair, found in zip(pairs, nearest, strict=True) if list(TASKS)[found] != pair[0]]


def test_held_out_sentences_are_nearest_to_their_own_task(desk_clip):
    pairs = [(task, sentence) for task in TASKS for sentence in COMMANDS["validation"][task]]
    missed = not_nearest(desk_clip, pairs)
    assert len(missed) <= 0.05 * len(pairs), missed


def test_the_thesis_own_sentences_are_understood(desk_clip, spec):
    table = (spec / "thesis.md").read_text().partition("Table 4.1: All Tasks")[0].rpartition("Example Commands")[2]
    rows, task = {}, None
    for line in table.splitlines():
        name, tab, text = line.partition("\t")
        if tab and name:
            task = name.strip("$").replace(" ", "")
            rows[task] = text
        elif line:
            rows[task] += " " + line.strip()
    assert set(rows) == set(TASKS)
    pairs = [(task, sentence.strip()) for task, text in rows.items() for sentence in text.split(";")]
    pairs = [(task, sentence) for task, sentence in pairs if sentence not in COMMANDS["training"][task]]
    assert len(pairs) > 20
    missed = not_nearest(desk_clip, pairs)
    assert len(missed) <= 0.1 * len(pairs), missed


@pytest.mark.parametrize("scene", SCENE_NAMES)
def test_the_image_encoder_finds_the_blocks_and_the_hand_in_a_picture(desk_clip, scene):
    """Its first eight numbers are their rows and columns: to 3 of 112 pixels in the median."""
    encoder, size = desk_clip.model.visual.trunk, desk_clip.images.size[0]
    pictures, truth = [], []
    with Desk(scene, cameras=()) as desk:
        for seed in range(12):
            obs = desk.reset(seed=seed)
            points = [obs["scene_obs"][block_pose(k)][:3] for k in range(len(COLORS))] + [obs["robot_obs"][:3]]
            pictures.append(desk.render("static"))
            truth.append(np.array(points))
    found = desk_clip.encode_images(np.stack(pictures))[:, :8] / encoder.gain[:8].detach()
    found = (found.unflatten(1, (2, 4)).flip(1).mT.numpy() + 1) / 2 * (size - 4)  # (12, 4, column and row)
    seen = np.stack(truth) @ np.linalg.inv(static_camera_pose())[:3, :3].T + np.linalg.inv(static_camera_pose())[:3, 3]
    shown = seen @ intrinsics("static", size).T
    errors = np.linalg.norm(found - shown[..., :2] / shown[..., 2:], axis=-1)
    assert np.median(errors[:, :3]) < 3
    assert np.median(errors[:, 3]) < 3
