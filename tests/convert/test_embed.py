"""`lansar-embed` on a finished dataset."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_calvin import write_calvin
from filelock import FileLock
from huggingface_hub.utils import DEFAULT_IGNORE_PATTERNS, filter_repo_objects

from dataset_convert import embed
from dataset_convert.convert import convert
from dataset_convert.options import ConvertConfig
from dataset_convert.verify import Mismatch, VerifyConfig, verify
from lerobot_lansar.clip import store
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.store import PARTIAL, sha256

clip_module = pytest.importorskip("lerobot_lansar.clip.model")

TINY = ClipConfig(model="lansar-desk", pretrained="")
ARGUMENTS = ["--repo_id=me/desk", "--clip.model=lansar-desk", "--clip.pretrained="]
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
    """A copy without embeddings, and without `.cache`, which LeRobot does not upload: the lock of the first pass."""
    copy = shutil.copytree(made / images, tmp_path / images, ignore=shutil.ignore_patterns(".cache"))
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
    for where, description in ((dataset, told), (made / "png", other)):
        assert description.pop("files") == {Path(name).name: sha256(where / name) for name in FILES}
    assert told.pop("pictures") == "dataset"
    assert other.pop("pictures") == "source"
    assert told == other
    assert "lansar-desk" in (dataset / "README.md").read_text(), "the card tells of them"


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
    files = [path.relative_to(dataset).as_posix() for path in dataset.rglob("*") if path.is_file()]
    uploaded = set(filter_repo_objects(files, ignore_patterns=DEFAULT_IGNORE_PATTERNS))
    assert {name for name in files if "clip" in name}, "what is done of it is kept"
    assert not {name for name in uploaded if "clip" in name}, "but a push to the hub would leave it alone"

    encoded.clear()
    monkeypatch.setattr(clip_module.Clip, "encode_images", lambda self, p: (encoded.append(len(p)), encode(self, p))[1])
    code, printed = run(dataset, "--batch_size=4")
    assert code == 0, printed.err
    assert sum(encoded) == 2 * (32 - 12)
    for name in FILES:
        mine, sources = np.load(dataset / name).astype(float), np.load(made / "png" / name).astype(float)
        np.testing.assert_allclose(mine, sources, atol=2e-3)
    assert not (dataset / store.PARTIAL).exists()


class Killed(BaseException):
    """Nothing catches it."""


@pytest.mark.parametrize(
    ("step", "name"),
    [("write_text", "clip.json"), ("rename", store.PARTIAL.name), ("unlink", "state.json")],
    ids=["before it is described", "before it is published", "before it is tidied"],
)
def test_a_kill_in_the_last_steps_loses_nothing(made, run, tmp_path, monkeypatch, step, name):
    dataset = without_clip(made, "png", tmp_path)
    right = getattr(Path, step)

    def dies(self, *arguments, **options):
        if self.name == name:
            raise Killed
        return right(self, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, step, dies)
        with pytest.raises(Killed):
            run(dataset)
    monkeypatch.setattr(clip_module.Clip, "encode_images", lambda *_: pytest.fail("embedded again"))
    code, printed = run(dataset)
    assert code == 0, printed.err
    assert not (dataset / store.PARTIAL).exists()
    assert {path.name for path in (dataset / "clip").iterdir()} == {
        "clip.json",
        *(Path(name).name for name in FILES),
    }
    for name in FILES:
        mine, sources = np.load(dataset / name).astype(float), np.load(made / "png" / name).astype(float)
        np.testing.assert_allclose(mine, sources, atol=2e-3)


def test_what_another_clip_began_is_not_continued(made, run, tmp_path):
    dataset = without_clip(made, "png", tmp_path)
    (dataset / store.PARTIAL).mkdir(parents=True)
    state = {"description": {"model": "other"}, "done": 30}
    (dataset / store.PARTIAL / "state.json").write_text(json.dumps(state))
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


def test_only_one_pass_at_a_time(made, run, tmp_path, monkeypatch):
    copy = without_clip(made, "png", tmp_path)
    monkeypatch.setattr(embed, "_PATIENCE", 0.1)
    with FileLock((copy / PARTIAL).with_suffix(".lock")):
        code, printed = run(copy)
    assert code == 2
    assert f"another process is embedding the pictures of {copy}" in printed.err
    assert run(copy)[0] == 0


def test_the_same_again_does_nothing(made, run):
    before = {name: (made / "png" / name).stat().st_mtime_ns for name in FILES}
    code, printed = run(made / "png")
    assert code == 0
    assert "already holds these embeddings" in printed.err
    assert before == {name: (made / "png" / name).stat().st_mtime_ns for name in FILES}


def test_verify_looks_at_embeddings_too(made, tmp_path):
    dataset = shutil.copytree(made / "png", tmp_path / "png")
    config = VerifyConfig("me/desk", made / "calvin", dataset)
    (dataset / "clip/state.json").touch()  # of a pass that was killed after its last step but one
    assert "clip: as lansar-desk untrained left it, for these frames" in verify(config)
    other = json.loads((dataset / "clip/clip.json").read_text()) | {"fingerprint": "0"}
    (dataset / "clip/clip.json").write_text(json.dumps(other))
    with pytest.raises(Mismatch, match="embeddings of other frames"):
        verify(config)
    with open(dataset / FILES[0], "r+b") as file:
        file.seek(-1, 2)
        file.write(b"!")
    with pytest.raises(Mismatch, match=r"static.npy was changed since it was embedded"):
        verify(config)
    (dataset / FILES[0]).unlink()
    with pytest.raises(Mismatch, match=r"missing or surplus files: observation.images.static.npy"):
        verify(config)
    (dataset / "clip/clip.json").unlink()
    with pytest.raises(Mismatch, match=r"holds no clip.json"):
        verify(config)


def test_a_download_from_the_hub_is_embedded_without_touching_the_cache(made, run, tmp_path, monkeypatch):
    """Its files are links to blobs that other snapshots share."""
    copy = without_clip(made, "png", tmp_path)
    home = tmp_path / "home"
    repository = home / "hub/datasets--me--desk"
    snapshot = repository / "snapshots/0123"
    for path in [path for path in copy.rglob("*") if path.is_file()]:
        link = snapshot / path.relative_to(copy)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(path)
    (repository / "refs").mkdir()
    (repository / "refs/v3.0").write_text("0123")
    before = (copy / "README.md").read_text()
    monkeypatch.setenv("HF_LEROBOT_HOME", str(home))
    monkeypatch.setattr(sys, "argv", ["lansar-embed", *ARGUMENTS])
    assert embed.main() == 0
    assert (copy / "README.md").read_text() == before
    assert "lansar-desk" in (snapshot / "README.md").read_text()
    assert "clip: as lansar-desk" in verify(VerifyConfig("me/desk", made / "calvin"))


def test_a_dataset_of_an_earlier_version_is_refused(made, run, tmp_path):
    dataset = without_clip(made, "png", tmp_path)
    manifest = json.loads((dataset / "meta/calvin_source.json").read_text())
    del manifest["request"]["format"]
    (dataset / "meta/calvin_source.json").write_text(json.dumps(manifest))
    code, printed = run(dataset)
    assert code == 2
    assert "convert again" in printed.err


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
