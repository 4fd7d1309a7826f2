"""``lansar-embed`` on a finished dataset."""

import json
import shutil
import sys

import numpy as np
import pytest
from fake_calvin import write_calvin

from dataset_convert import embed
from dataset_convert.convert import ClipOptions, ConvertConfig, convert

clip_module = pytest.importorskip("lerobot_lansar.policy.clip")

TINY = ClipOptions(model="lansar-tiny", pretrained="")
ARGUMENTS = ["--repo_id=me/desk", "--clip.model=lansar-tiny", "--clip.pretrained="]
FILES = [f"clip/observation.images.{camera}.npy" for camera in ("static", "gripper")]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The same frames as exact pictures, as videos and without pictures; the first with embeddings of the source."""
    folder = tmp_path_factory.mktemp("made")
    source = write_calvin(folder / "calvin", rgb=True, overlap=2, length=8)
    for images, options in (("png", {"embed": True, "clip": TINY}), ("video", {}), ("none", {})):
        convert(ConvertConfig(source.root, "me/desk", folder / images, images=images, **options))
    return folder


@pytest.fixture
def run(monkeypatch, capsys):
    def command(dataset, *arguments):
        monkeypatch.setattr(sys, "argv", ["lansar-embed", f"--dataset_dir={dataset}", *ARGUMENTS, *arguments])
        return embed.main(), capsys.readouterr()

    return command


def without_clip(made, images, tmp_path):
    """A copy without embeddings."""
    copy = shutil.copytree(made / images, tmp_path / images)
    shutil.rmtree(copy / "clip", ignore_errors=True)
    return copy


def test_exact_pictures_give_the_embeddings_of_the_source(made, run, tmp_path):
    dataset = without_clip(made, "png", tmp_path)
    code, printed = run(dataset, "--batch_size=5")
    assert code == 0, printed.err
    assert str(dataset / "clip") in printed.out
    for name in FILES:
        mine, sources = np.load(dataset / name), np.load(made / "png" / name)
        assert (mine.shape, mine.dtype) == (sources.shape, np.float16) == ((32, sources.shape[1]), np.float16)
        np.testing.assert_allclose(mine.astype(float), sources.astype(float), atol=2e-3)
    told, other = (json.loads((where / "clip/clip.json").read_text()) for where in (dataset, made / "png"))
    assert told.pop("pictures") == "dataset"
    assert other.pop("pictures") == "source"
    assert told == other
    assert "lansar-tiny" in (dataset / "README.md").read_text(), "the card tells of them"


def test_videos_are_decoded_by_other_processes(made, run, tmp_path):
    dataset = without_clip(made, "video", tmp_path)
    code, printed = run(dataset, "--num_workers=2", "--batch_size=3")
    assert code == 0, printed.err
    for name in FILES:
        mine, sources = np.load(dataset / name).astype(float), np.load(made / "png" / name).astype(float)
        cosine = (mine * sources).sum(1) / np.linalg.norm(mine, axis=1) / np.linalg.norm(sources, axis=1)
        assert cosine.min() > 0.99


def test_an_interrupted_pass_goes_on(made, run, tmp_path, monkeypatch):
    dataset = without_clip(made, "png", tmp_path)
    monkeypatch.setattr(embed, "_SAVE_EVERY", 1)
    encode, encoded = clip_module.Clip.encode_images, []

    def interrupted(self, pictures):
        if sum(encoded) >= 24:  # three batches of four, two cameras
            raise KeyboardInterrupt
        encoded.append(len(pictures))
        return encode(self, pictures)

    monkeypatch.setattr(clip_module.Clip, "encode_images", interrupted)
    code, printed = run(dataset, "--batch_size=4")
    assert code == 130
    assert "goes on where it stopped" in printed.err
    assert not (dataset / "clip").exists()

    encoded.clear()
    monkeypatch.setattr(
        clip_module.Clip, "encode_images", lambda self, p: (encoded.append(len(p)), encode(self, p))[1]
    )
    code, printed = run(dataset, "--batch_size=4")
    assert code == 0, printed.err
    assert sum(encoded) == 2 * (32 - 12)
    for name in FILES:
        mine, sources = np.load(dataset / name).astype(float), np.load(made / "png" / name).astype(float)
        np.testing.assert_allclose(mine, sources, atol=2e-3)
    assert not (dataset / "clip.partial").exists()


def test_what_another_clip_began_is_not_continued(made, run, tmp_path):
    dataset = without_clip(made, "png", tmp_path)
    (dataset / "clip.partial").mkdir()
    state = {"description": {"model": "other"}, "done": 30}
    (dataset / "clip.partial/state.json").write_text(json.dumps(state))
    code, printed = run(dataset)
    assert code == 0, printed.err
    assert all(np.load(dataset / name).any(axis=1).all() for name in FILES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights_sha256": "0"}, "embeddings of another CLIP"),
        ({"fingerprint": "0"}, "embeddings of other frames"),
    ],
)
def test_embeddings_of_something_else_are_not_overwritten(made, run, tmp_path, changes, message):
    dataset = shutil.copytree(made / "png", tmp_path / "png")
    description = json.loads((dataset / "clip/clip.json").read_text())
    (dataset / "clip/clip.json").write_text(json.dumps({**description, **changes}))
    code, printed = run(dataset)
    assert code == 2
    assert message in printed.err
    assert "delete that folder" in printed.err


def test_the_same_again_does_nothing(made, run):
    before = {name: (made / "png" / name).stat().st_mtime_ns for name in FILES}
    code, printed = run(made / "png")
    assert code == 0
    assert "already holds these embeddings" in printed.err
    assert before == {name: (made / "png" / name).stat().st_mtime_ns for name in FILES}


def test_bad_input_is_one_clear_message(made, run, tmp_path):
    for arguments, message in (
        ((made / "none",), "has no observation.images.gripper, observation.images.static: convert it with"),
        ((tmp_path,), "holds no LeRobotDataset"),
        ((made / "video", "--clip.model=nothing"), "--clip.model=nothing"),
        ((made / "video", "--batch_size=0"), "--batch_size"),
    ):
        code, printed = run(*arguments)
        assert code == 2, arguments
        assert message in printed.err
        assert "Traceback" not in printed.err
        assert not (arguments[0] / "clip").exists() or arguments[0] == made / "png"
