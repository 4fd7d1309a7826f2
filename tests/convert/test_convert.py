"""From a CALVIN split to a LeRobotDataset, as a user runs it."""

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_calvin import COMMANDS, without_jumps, write_calvin

from dataset_convert import convert
from dataset_convert.calvin import CalvinSplit
from dataset_convert.options import ConvertConfig
from lerobot_lansar.calvin import COLORS, TASKS, relative_action
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.jobs import staging


def options(calvin, output_dir, **changes):
    return ConvertConfig(calvin.root, "me/desk", output_dir, **{"images": "none", **changes})


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
            np.testing.assert_array_equal(item["calvin.actions"], without_jumps(source["actions"]))
            np.testing.assert_array_equal(item["observation.state"], without_jumps(source["robot_obs"]))
            stored = item["observation.environment_state"].numpy()
            blocks = dict(zip(("pink", "blue", "red"), source["scene_obs"][6:].reshape(3, 6), strict=True))
            expected = np.concatenate([source["scene_obs"][:6], *(blocks[color] for color in COLORS)])
            np.testing.assert_array_equal(stored, expected.astype(np.float32))
            index += 1


def test_absolute_actions_on_request(calvin, tmp_path):
    dataset = load(convert.convert(options(calvin, tmp_path / "out", action="abs")))
    for item in dataset:
        source = calvin.frames[item["calvin.frame"].item()]
        np.testing.assert_array_equal(item["calvin.rel_actions"], source["rel_actions"].astype(np.float32))
        np.testing.assert_array_equal(item["action"], without_jumps(source["actions"]))
    assert dataset.meta.features["action"]["names"] == ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]


def test_lerobots_relative_actions_do_not_jump_where_calvins_roll_does(calvin, tmp_path):
    import torch
    from lerobot.processor import RelativeActionsProcessorStep, TransitionKey

    dataset = load(convert.convert(options(calvin, tmp_path / "out", action="abs")))
    rows = dataset.hf_dataset.with_format("numpy")[:]
    step = RelativeActionsProcessorStep(enabled=True)
    state, action = torch.from_numpy(rows["observation.state"]), torch.from_numpy(rows["action"])
    done = step({TransitionKey.OBSERVATION: {"observation.state": state}, TransitionKey.ACTION: action})
    recorded = np.array([[content["robot_obs"][3], content["actions"][3]] for content in calvin.frames.values()])
    assert np.ptp(recorded, axis=0).min() > 6, "the recorded rolls of states and of actions jump"
    assert np.abs(np.diff(recorded)).max() > 6, "and lie on different sides"
    assert np.ptp(state[:, 3].numpy()) < 0.1
    assert done[TransitionKey.ACTION][:, 3].abs().max() < 0.1


def test_the_commanded_task_is_told_in_the_state_on_request(calvin, tmp_path):
    dataset = load(convert.convert(options(calvin, tmp_path / "out", mode="play", task_in_state=True)))
    feature = dataset.meta.features["observation.environment_state"]
    assert feature["shape"] == (58,)
    assert feature["names"][24:] == [f"task_{task}" for task in TASKS]
    for index in range(dataset.num_frames):
        item = dataset[index]
        state = item["observation.environment_state"].numpy()
        expected = np.zeros(34)
        window = item["calvin.window"].item()
        if window >= 0:
            expected[list(TASKS).index(calvin.windows[window][2])] = 1
        np.testing.assert_array_equal(state[24:], expected)
        scene = calvin.frames[item["calvin.frame"].item()]["scene_obs"].astype(np.float32)
        np.testing.assert_array_equal(state[:24], scene)
    card = (tmp_path / "out" / "README.md").read_text()
    assert "1 for the commanded task" in card
    assert "--policy.type=act" in card
    assert "--env.task_in_state=true" in card
    assert "--policy.type=lansar" not in card
    with pytest.raises(ValueError, match="another conversion"):
        convert.convert(options(calvin, tmp_path / "out", mode="play"))


@pytest.mark.parametrize("told", [True, False])
def test_the_scenes_state_is_left_out_on_request(calvin, tmp_path, told):
    out = convert.convert(options(calvin, tmp_path / "out", scene_state=False, task_in_state=told))
    features, card = load(out).meta.features, (out / "README.md").read_text()
    assert "**Privileged state:** none" in card
    assert "--env.scene_state=false" in card
    assert ("--policy.type=act" in card) == told
    assert ("`--policy.use_spatial_context=false`" in card) == (not told)
    assert ("`observation.environment_state` |" in card) == told
    if told:
        assert features["observation.environment_state"]["names"] == [f"task_{task}" for task in TASKS]
        assert (np.stack(load(out).hf_dataset["observation.environment_state"]).sum(axis=1) == 1).all()
    else:
        assert "observation.environment_state" not in features


def test_a_task_that_calvin_does_not_know_cannot_be_told_in_the_state(tmp_path):
    calvin = write_calvin(tmp_path / "calvin")
    index = calvin.root / "training/lang_annotations/auto_lang_ann.npy"
    annotations = np.load(index, allow_pickle=True).item()
    annotations["language"]["task"][0] = "juggle"
    np.save(index, annotations)
    with pytest.raises(ValueError, match="--task_in_state=true: juggle is none"):
        convert.convert(options(calvin, tmp_path / "out", task_in_state=True))
    assert not (tmp_path / "out").exists()


def test_the_manifest_and_the_card_say_where_the_data_come_from(calvin, tmp_path):
    out = convert.convert(options(calvin, tmp_path / "out"))
    manifest = json.loads((out / "meta" / "calvin_source.json").read_text())
    episode = {key: value for key, value in manifest["episodes"][1].items() if key != "sha256"}
    assert episode == {"start": 112, "end": 124, "scene": "D", "windows": [1]}
    assert manifest["windows"][1] == {
        "start": 112,
        "end": 124,
        "task": "lift_blue_block_table",
        "sentence": "pick up the blue block",
        "scene": "D",
    }
    for name, sha in manifest["files"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == sha
    assert manifest["scenes"] == {"D": {"frames": [100, 147], "block_order": ["red", "blue", "pink"]}}
    assert manifest["request"]["split"] == "training"
    card = (out / "README.md").read_text()
    assert "Privileged state" in card
    assert "lift_blue_block_table" in card
    assert str(tmp_path) not in card + json.dumps(manifest), "no path of this machine may be published"


def test_several_workers_and_shards_give_the_same_files(calvin, tmp_path):
    one = convert.convert(options(calvin, tmp_path / "one"))
    two = convert.convert(options(calvin, tmp_path / "two", workers=2))
    assert len(list(one.glob("data/*/*.parquet"))) == 4
    assert files_of(one) == files_of(two)
    dataset = load(two)
    assert [dataset[i]["calvin.frame"].item() for i in range(48)] == list(range(100, 148))


def test_an_error_in_a_worker_reaches_the_user_and_leaves_what_is_done_for_the_next_run(calvin, tmp_path):
    calvin.rewrite(130, scene_obs=np.full(24, np.inf))
    with pytest.raises(ValueError, match="episode_0000130"):
        convert.convert(options(calvin, tmp_path / "out", workers=2))
    assert sorted(os.listdir(tmp_path)) == [".out.incomplete", "calvin"]
    calvin.rewrite(130)
    with pytest.raises(ValueError, match="begun with other options"):
        convert.convert(options(calvin, tmp_path / "out", action="abs"))
    assert load(convert.convert(options(calvin, tmp_path / "out"))).num_frames == 48
    assert sorted(os.listdir(tmp_path)) == ["calvin", "out"]


def test_a_failed_run_leaves_nothing(calvin, tmp_path):
    calvin.rewrite(100, actions=np.full(7, np.inf))
    with pytest.raises(ValueError, match="episode_0000100"):
        convert.convert(options(calvin, tmp_path / "out"))
    assert os.listdir(tmp_path) == ["calvin"]


def converting(calvin, out, workers):
    """The command in a process group of its own."""
    command = [sys.executable, "-m", "dataset_convert", f"--root={calvin.root}", "--repo_id=me/desk"]
    command += [f"--output_dir={out}", "--images=none", f"--workers={workers}"]
    return subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert condition()


@pytest.mark.parametrize("whom", ["everybody", "a worker", "the parent"])
def test_a_killed_run_leaves_nothing_that_loads_and_the_next_one_goes_on(tmp_path, whom):
    calvin = write_calvin(tmp_path / "calvin", tasks=tuple(COMMANDS) * 8, length=25)
    whole = convert.convert(options(calvin, tmp_path / "whole"))
    out, staging = tmp_path / "out", tmp_path / ".out.incomplete"
    stalled = calvin.file(712)  # reading it waits for somebody to write
    content = stalled.read_bytes()
    stalled.unlink()
    os.mkfifo(stalled)
    run = converting(calvin, out, workers=2)
    wait_for(lambda: len(list(staging.glob("shards/*.json"))) >= 5 and any(map(waits_for_a_pipe, workers_of(run.pid))))
    if whom == "everybody":
        os.killpg(run.pid, signal.SIGKILL)
    elif whom == "the parent":
        os.kill(run.pid, signal.SIGKILL)
    else:
        os.kill(max(workers_of(run.pid), key=waits_for_a_pipe), signal.SIGKILL)
    assert run.wait(60) != 0
    assert not out.exists()
    stalled.unlink()
    stalled.write_bytes(content)
    damaged, *intact = sorted(staging.glob("shards/*.json"))
    for name in json.loads(damaged.read_text())["files"]:  # what is on disk is checked before it is believed
        (staging / "dataset" / name).write_bytes(b"half of a file")
    done = [name for note in intact for name in json.loads(note.read_text())["files"]]
    written = {name: (staging / "dataset" / name).stat().st_mtime_ns for name in done}
    assert len(written) >= 4
    convert.convert(options(calvin, out))
    assert files_of(out) == files_of(whole)
    assert {name: (out / name).stat().st_mtime_ns for name in done} == written, "what was done was done again"
    assert sorted(os.listdir(tmp_path)) == ["calvin", "out", "whole"]


def test_a_fault_of_the_machine_is_no_defect_of_the_data(calvin, tmp_path, monkeypatch):
    """Or --skip_bad=true would leave good episodes out of it for good."""
    read = CalvinSplit.read

    def out_of_files(self, frames, keys):
        if 105 in frames:
            raise OSError(errno.EMFILE, "Too many open files")
        return read(self, frames, keys)

    with monkeypatch.context() as patch:
        patch.setattr(CalvinSplit, "read", out_of_files)
        with pytest.raises(OSError, match="Too many open files"):
            convert.convert(options(calvin, tmp_path / "out", skip_bad=True))
    assert not (tmp_path / "out").exists()
    convert.convert(options(calvin, tmp_path / "out", skip_bad=True))
    assert json.loads((tmp_path / "out/meta/calvin_source.json").read_text())["left_out"] == []


def test_a_finished_datasets_licence_is_not_changed_in_passing(calvin, tmp_path):
    out = convert.convert(options(calvin, tmp_path / "out", license="cc-by-4.0"))
    before = files_of(out)
    with pytest.raises(ValueError, match=r"--license=mit: .* was made with --license=cc-by-4.0"):
        convert.convert(options(calvin, out))
    assert files_of(convert.convert(options(calvin, out, license="cc-by-4.0"))) == before


def workers_of(parent):
    """Processes of a session, but not the one that began it."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                session = int((entry / "stat").read_text().rpartition(")")[2].split()[3])
            except (FileNotFoundError, ProcessLookupError):
                continue
            if session == parent and int(entry.name) != parent:
                found.append(int(entry.name))
    return found


def waits_for_a_pipe(pid):
    """Whether a process is opening a named pipe, which blocks until another process opens it too."""
    try:
        place = Path(f"/proc/{pid}/wchan").read_text()
    except OSError:
        return False
    return "fifo" in place or "wait_for_partner" in place


def any_file(folder):
    return any(folder.glob("*/*"))


def test_two_runs_cannot_write_the_same_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_lansar.jobs.staging._PATIENCE", 0.2)
    folder, out = tmp_path / ".out.incomplete", tmp_path / "out"
    with staging.staging(folder, out, {"a": 1}, any_file):
        (folder / "dataset").mkdir()
        (folder / "dataset" / "kept").touch()
        with (
            pytest.raises(ValueError, match="another process is writing"),
            staging.staging(folder, out, {}, any_file),
        ):
            pass
        staging.publish(folder, folder / "dataset", out)
    assert (tmp_path / "out" / "kept").exists()
    assert os.listdir(tmp_path) == ["out"]


def test_a_run_killed_just_after_it_published_is_in_nobodys_way(calvin, tmp_path, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(staging, "shutil", SimpleNamespace(rmtree=killed))
        with pytest.raises(KeyboardInterrupt):
            convert.convert(options(calvin, tmp_path / "out"))
    whole = files_of(tmp_path / "out")
    leftover = tmp_path / ".out.incomplete"
    shutil.copytree(leftover, tmp_path / "leftover")
    convert.convert(options(calvin, tmp_path / "out"))
    assert sorted(os.listdir(tmp_path)) == ["calvin", "leftover", "out"], "the next run tidies up"

    shutil.rmtree(tmp_path / "out")
    shutil.copytree(tmp_path / "leftover", leftover)
    assert load(convert.convert(options(calvin, tmp_path / "out", action="abs"))).num_frames == 48
    shutil.rmtree(tmp_path / "out")
    shutil.copytree(tmp_path / "leftover", leftover)
    convert.convert(options(calvin, tmp_path / "out"))
    assert files_of(tmp_path / "out") == whole


def test_a_submission_that_fails_does_not_count_as_one(tmp_path):
    folder = tmp_path / ".out.incomplete"

    def submit():
        with staging.staging(folder, tmp_path / "out", {"a": 1}, any_file, submitting=True):
            (folder / "shards").mkdir(exist_ok=True)
            (folder / "shards" / "000000.json").touch()  # a shard of an earlier try, which must not be lost
            raise RuntimeError

    for _ in range(2):
        with pytest.raises(RuntimeError):
            submit()
    assert (folder / "shards" / "000000.json").exists()


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
        "--images=none",
    )
    assert code == 0
    assert str(tmp_path / "out") in printed.out
    assert load(tmp_path / "out").num_episodes == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--split=validation", "--images=none"], "--split=validation"),
        ([], "--images=none"),
        (["--images=none", "--embed=true"], "'rgb_static' is missing"),
        (["--images=none", "--action=delta"], "--action=delta: expected rel or abs"),
        (["--images=none", "--workers=0"], "--workers=0"),
        (["--rgb_encoder.vcodec=mpeg1"], "--rgb_encoder.vcodec=mpeg1"),
        (["--images=perhaps"], "--images=perhaps"),
        (["--colour=red"], "--colour=red"),
        (["--images=none", "--mode=both"], "--mode=both: expected windows or play"),
        (["--images=none", "--mode=play", "--dedup=task"], "--dedup needs --mode=windows"),
        (["--images=none", "--depth=true"], "--images=none"),
        (["--images=none", "--clip.model=lansar-desk"], "--clip.pretrained need --embed=true"),
        (["--images=png", "--rgb_encoder.crf=20"], "--rgb_encoder needs --images=video"),
        (["--images=none", "--private=true"], "--private=true needs --push_to_hub=true"),
        (["--images=none", "--executor=cloud"], "--executor is one of"),
        (["--images=none", "--split=training", "--exclude_shared=perhaps"], "exclude_shared"),
    ],
)
def test_a_wrong_option_is_one_clear_message_and_exit_code_2(calvin, tmp_path, monkeypatch, capsys, arguments, message):
    base = [f"--root={calvin.root}", "--repo_id=me/desk", f"--output_dir={tmp_path / 'out'}"]
    code, printed = run_main(monkeypatch, capsys, *base, *arguments)
    assert code == 2
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert not (tmp_path / "out").exists()


def test_without_a_folder_it_goes_where_lerobot_looks(calvin, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path / "home"))
    code, _ = run_main(monkeypatch, capsys, f"--root={calvin.root}", "--repo_id=me/desk", "--images=none")
    assert code == 0
    assert load(tmp_path / "home" / "me" / "desk").num_episodes == 4


def test_embeddings_are_those_of_the_source_pictures_in_the_order_of_index(tmp_path):
    clip_module = pytest.importorskip("lerobot_lansar.clip.model")
    import torch

    calvin = write_calvin(tmp_path / "calvin", rgb=True, overlap=3, length=5)
    clip_options = ClipConfig(model="lansar-desk", pretrained="")
    out = convert.convert(options(calvin, tmp_path / "out", embed=True, clip=clip_options))
    clip = clip_module.Clip(clip_module.ClipConfig(model="lansar-desk", pretrained=""))
    frames = [frame for start, end, *_ in calvin.windows for frame in range(start, end)]
    for camera, name in (("rgb_static", "static"), ("rgb_gripper", "gripper")):
        stored = np.load(out / "clip" / f"observation.images.{name}.npy", mmap_mode="r")
        assert (stored.shape, stored.dtype) == ((len(frames), clip.embed_dim), np.float16)
        for index in (0, 7, len(frames) - 1):
            picture = calvin.frames[frames[index]][camera][None]
            expected = clip.encode_images(torch.from_numpy(picture))[0].numpy()
            np.testing.assert_allclose(stored[index], expected, atol=2e-3)
    from lerobot_lansar.clip.store import dataset_fingerprint

    description = json.loads((out / "clip" / "clip.json").read_text())
    assert description["frames"] == len(frames)
    assert description["fingerprint"] == dataset_fingerprint(out)


def test_an_unknown_clip_is_reported_before_the_long_part(tmp_path, monkeypatch, capsys):
    pytest.importorskip("lerobot_lansar.clip.model")
    calvin = write_calvin(tmp_path / "calvin", rgb=True, tasks=("open_drawer",), length=2)
    monkeypatch.setattr(convert, "run_shards", lambda *_, **__: pytest.fail("converted first"))
    base = [f"--root={calvin.root}", "--repo_id=me/desk", f"--output_dir={tmp_path / 'out'}", "--embed=true"]
    code, printed = run_main(monkeypatch, capsys, *base, "--clip.model=nothing")
    assert code == 2
    assert "--clip.model=nothing" in printed.err


def test_actions_in_the_dataset_are_consistent_with_its_states(calvin, tmp_path):
    dataset = load(convert.convert(options(calvin, tmp_path / "out")))
    rows = dataset.hf_dataset.with_format("numpy")[:]
    expected = relative_action(rows["calvin.actions"], rows["observation.state"])
    np.testing.assert_allclose(rows["action"], expected, atol=1e-4)
