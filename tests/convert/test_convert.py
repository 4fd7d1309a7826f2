"""From a CALVIN split to a LeRobotDataset, as a user runs it."""

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_calvin import write_calvin

from dataset_convert import checks, convert
from dataset_convert.calvin import COLOURS, CalvinSplit
from dataset_convert.convert import ClipOptions, ConvertConfig
from dataset_convert.publish import publishing


def options(calvin, output_dir, **changes):
    return ConvertConfig(calvin.root, "me/desk", output_dir, **{"videos": False, **changes})


def load(folder):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("me/desk", root=folder)


def files_of(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


def test_every_item_is_the_source_frame_with_its_command(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", scene="A", overlap=3)
    dataset = load(convert.convert(options(calvin, tmp_path / "out")))
    assert (dataset.fps, dataset.num_episodes, dataset.num_frames) == (30, 4, 48)
    index = 0
    for episode, (start, end, _, sentence) in enumerate(calvin.windows):
        for offset, frame in enumerate(range(start, end)):
            item, source = dataset[index], calvin.frames[frame]
            assert (item["task"], item["calvin.frame"].item()) == (sentence, frame)
            assert (item["episode_index"].item(), item["frame_index"].item()) == (episode, offset)
            assert item["timestamp"].item() == pytest.approx(offset / 30, abs=1e-6)
            np.testing.assert_array_equal(item["action"], source["rel_actions"].astype(np.float32))
            np.testing.assert_array_equal(item["calvin.actions"], source["actions"].astype(np.float32))
            np.testing.assert_array_equal(item["observation.state"], source["robot_obs"].astype(np.float32))
            stored = item["observation.environment_state"].numpy()
            blocks = dict(zip(("pink", "blue", "red"), source["scene_obs"][6:].reshape(3, 6), strict=True))
            expected = np.concatenate([source["scene_obs"][:6], *(blocks[colour] for colour in COLOURS)])
            np.testing.assert_array_equal(stored, expected.astype(np.float32))
            index += 1


def test_absolute_actions_on_request(calvin, tmp_path):
    dataset = load(convert.convert(options(calvin, tmp_path / "out", action="abs")))
    source = calvin.frames[100]
    np.testing.assert_array_equal(dataset[0]["action"], source["actions"].astype(np.float32))
    np.testing.assert_array_equal(dataset[0]["calvin.rel_actions"], source["rel_actions"].astype(np.float32))
    assert dataset.meta.features["action"]["names"] == ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]


def test_the_manifest_and_the_card_say_where_the_data_come_from(calvin, tmp_path):
    out = convert.convert(options(calvin, tmp_path / "out"))
    manifest = json.loads((out / "meta" / "calvin_source.json").read_text())
    assert manifest["episodes"][1] == {
        "start": 112,
        "end": 124,
        "task": "lift_blue_block_table",
        "sentence": "pick up the blue block",
        "scene": "D",
    }
    assert manifest["scenes"] == {"D": {"frames": [100, 147], "block_order": ["red", "blue", "pink"]}}
    assert manifest["request"]["split"] == "training"
    card = (out / "README.md").read_text()
    assert "Privileged state" in card
    assert "lift_blue_block_table" in card
    assert str(tmp_path) not in card + json.dumps(manifest), "no path of this machine may be published"


def test_several_workers_and_shards_give_the_same_files(calvin, tmp_path, monkeypatch):
    monkeypatch.setattr(convert, "EPISODES_PER_SHARD", 1)
    one = convert.convert(options(calvin, tmp_path / "one"))
    two = convert.convert(options(calvin, tmp_path / "two", workers=2))
    assert len(list(one.glob("data/*/*.parquet"))) == 4
    assert files_of(one) == files_of(two)
    dataset = load(two)
    assert [dataset[i]["calvin.frame"].item() for i in range(48)] == list(range(100, 148))


def test_an_error_in_a_worker_reaches_the_user(calvin, tmp_path, monkeypatch):
    monkeypatch.setattr(convert, "EPISODES_PER_SHARD", 1)
    calvin.file(130).unlink()
    with pytest.raises(FileNotFoundError, match="episode_0000130"):
        convert.convert(options(calvin, tmp_path / "out", workers=2))
    assert os.listdir(tmp_path) == ["calvin"]


def test_a_failed_run_leaves_nothing(calvin, tmp_path):
    calvin.rewrite(140, scene_obs=np.full(24, np.inf))
    with pytest.raises(ValueError, match="episode_0000140"):
        convert.convert(options(calvin, tmp_path / "out"))
    assert os.listdir(tmp_path) == ["calvin"]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_leaves_nothing_that_loads_and_the_next_one_succeeds(
    calvin, tmp_path, monkeypatch, workers
):
    import dataset_convert.writer  # noqa: F401  imported before the fork, which is then quick

    out, marker = tmp_path / "out", tmp_path / "started"
    reading = CalvinSplit.read

    def stall(self, frames, keys):
        if frames == range(124, 136):
            marker.touch()
            time.sleep(60)
        return reading(self, frames, keys)

    child = os.fork()
    if child == 0:
        monkeypatch.setattr(CalvinSplit, "read", stall)
        convert.convert(options(calvin, out, workers=workers))
        os._exit(0)
    deadline = time.monotonic() + 30
    while not marker.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert marker.exists()
    assert not out.exists()
    stale = [p for p in tmp_path.iterdir() if p.name.endswith(".incomplete")]
    assert stale, "the kill came too late to test anything"
    (stale[0] / "leftover.parquet").touch()
    assert load(convert.convert(options(calvin, out))).num_frames == 48
    assert not (out / "leftover.parquet").exists()
    assert sorted(os.listdir(tmp_path)) == ["calvin", "out", "started"]


def test_two_runs_cannot_write_the_same_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("dataset_convert.publish._PATIENCE", 0.2)
    with publishing(tmp_path / "out") as first:
        (first / "kept").touch()
        with pytest.raises(ValueError, match="another process is writing"), publishing(tmp_path / "out"):
            pass
        assert (first / "kept").exists()
    assert (tmp_path / "out" / "kept").exists()


def test_the_same_request_again_changes_nothing_and_another_one_is_refused(calvin, tmp_path):
    out = convert.convert(options(calvin, tmp_path / "out"))
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    convert.convert(options(calvin, out))
    assert before == {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    with pytest.raises(ValueError, match="result of another conversion"):
        convert.convert(options(calvin, out, action="abs"))
    with pytest.raises(ValueError, match="something else"):
        convert.convert(options(calvin, calvin.root))


def run_main(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["lansar-convert", *arguments])
    try:
        code = convert.main()
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr()


def test_the_command_converts_and_says_where(calvin, tmp_path, monkeypatch, capsys):
    where = f"--output_dir={tmp_path / 'out'}"
    code, printed = run_main(
        monkeypatch,
        capsys,
        f"--root={calvin.root}",
        "--split=training",
        "--repo_id=me/desk",
        where,
        "--videos=false",
    )
    assert code == 0
    assert str(tmp_path / "out") in printed.out
    assert load(tmp_path / "out").num_episodes == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--split=validation", "--videos=false"], "--split=validation"),
        ([], "--videos=false"),
        (["--videos=false", "--embed=true"], "'rgb_static' is missing"),
        (["--videos=false", "--action=delta"], "--action=delta: expected rel or abs"),
        (["--videos=false", "--workers=0"], "--workers=0"),
        (["--videos=false", "--vcodec=mpeg1"], "--vcodec=mpeg1"),
        (["--videos=perhaps"], "videos"),
        (["--colour=red"], "--colour=red"),
    ],
)
def test_a_wrong_option_is_one_clear_message_and_exit_code_2(
    calvin, tmp_path, monkeypatch, capsys, arguments, message
):
    base = [f"--root={calvin.root}", "--repo_id=me/desk", f"--output_dir={tmp_path / 'out'}"]
    code, printed = run_main(monkeypatch, capsys, *base, *arguments)
    assert code == 2
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert not (tmp_path / "out").exists()


def test_a_missing_option_is_named(monkeypatch, capsys, calvin):
    code, printed = run_main(monkeypatch, capsys, f"--root={calvin.root}", "--repo_id=me/desk")
    assert code == 2
    assert "output_dir" in printed.err


def test_pushing_uses_lerobots_method_with_the_version_tag(calvin, tmp_path, monkeypatch, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    calls = []

    def push_to_hub(self, **kwargs):
        calls.append((self.repo_id, self.root, kwargs))

    monkeypatch.setattr(LeRobotDataset, "push_to_hub", push_to_hub)
    arguments = [
        f"--root={calvin.root}",
        "--repo_id=me/desk",
        f"--output_dir={tmp_path / 'out'}",
        "--videos=false",
    ]
    code, _ = run_main(monkeypatch, capsys, *arguments, "--push_to_hub=true", "--private=true")
    assert code == 0
    repo_id, root, kwargs = calls[0]
    assert (repo_id, root, kwargs["private"]) == ("me/desk", tmp_path / "out", True)
    assert kwargs.get("tag_version", True), (
        "a dataset without the version's tag cannot be loaded from the hub"
    )
    assert "Privileged state" in kwargs["dataset_description"]


def test_embeddings_are_those_of_the_source_pictures_in_the_order_of_index(tmp_path):
    clip_module = pytest.importorskip("lerobot_lansar.policy.clip")
    import torch

    calvin = write_calvin(tmp_path / "calvin", rgb=True, overlap=3, length=5)
    clip_options = ClipOptions(model="lansar-tiny", pretrained="")
    out = convert.convert(options(calvin, tmp_path / "out", embed=True, clip=clip_options))
    clip = clip_module.Clip(clip_module.ClipConfig(model="lansar-tiny", pretrained=""))
    frames = [frame for start, end, *_ in calvin.windows for frame in range(start, end)]
    for camera, name in (("rgb_static", "static"), ("rgb_gripper", "gripper")):
        stored = np.load(out / "clip" / f"observation.images.{name}.npy", mmap_mode="r")
        assert (stored.shape, stored.dtype) == ((len(frames), clip.embed_dim), np.float16)
        for index in (0, 7, len(frames) - 1):
            picture = calvin.frames[frames[index]][camera][None]
            expected = clip.encode_images(torch.from_numpy(picture))[0].numpy()
            np.testing.assert_allclose(stored[index], expected, atol=2e-3)
    from lerobot_lansar.policy.frames import dataset_fingerprint

    description = json.loads((out / "clip" / "clip.json").read_text())
    assert description["frames"] == len(frames)
    assert description["fingerprint"] == dataset_fingerprint(out)


def test_an_unknown_clip_is_reported_before_the_long_part(tmp_path, monkeypatch, capsys):
    pytest.importorskip("lerobot_lansar.policy.clip")
    calvin = write_calvin(tmp_path / "calvin", rgb=True, tasks=("open_drawer",), length=2)
    monkeypatch.setattr(convert, "_run", lambda *_: pytest.fail("converted first"))
    base = [f"--root={calvin.root}", "--repo_id=me/desk", f"--output_dir={tmp_path / 'out'}", "--embed=true"]
    code, printed = run_main(monkeypatch, capsys, *base, "--clip.model=nothing")
    assert code == 2
    assert "--clip.model=nothing" in printed.err


def test_actions_in_the_dataset_are_consistent_with_its_states(calvin, tmp_path):
    dataset = load(convert.convert(options(calvin, tmp_path / "out")))
    rows = dataset.hf_dataset.with_format("numpy")[:]
    expected = checks.relative_actions(rows["calvin.actions"], rows["observation.state"])
    np.testing.assert_allclose(rows["action"], expected, atol=1e-4)
