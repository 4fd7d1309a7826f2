"""Recording demonstrations: CALVIN's layout, the same data from any number of workers, nothing half-written."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml

import lerobot_lansar.demos.record as record_module
from lerobot_lansar.calvin import CAMERAS, CONTROL_HZ, DRAWER, relative_action
from lerobot_lansar.demos.record import RecordConfig, record
from lerobot_lansar.demos.record_config import SPLITS, group_by_scene
from lerobot_lansar.demos.skills import SKILLS
from lerobot_lansar.desk import SCENES, DeskError
from lerobot_lansar.desk.sentences import COMMANDS
from lerobot_lansar.jobs.work import SlurmConfig, WorkerDied
from lerobot_lansar.pictures import resize


def options(output_dir, **changes):
    defaults = {
        "output_dir": output_dir,
        "tasks": ["turn_on_led", "lift_red_block_table"],
        "cameras": [],
        "seed": 3,
    }
    if changes.get("mode", "windows") == "windows":
        defaults |= {"episodes": 4, "validation_episodes": 2}
    return RecordConfig(**(defaults | changes))


def frames(folder):
    return {file.name: dict(np.load(file)) for file in sorted(folder.glob("episode_*.npz"))}


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[n][k], b[n][k]) for n in a for k in a[n])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return record(options(tmp_path_factory.mktemp("recording") / "desk"))


def test_folder_has_calvins_layout(recording):
    for split, episodes in (("training", 4), ("validation", 2)):
        folder = recording / split
        language = np.load(folder / "lang_annotations" / "auto_lang_ann.npy", allow_pickle=True).item()
        bounds = np.load(folder / "ep_start_end_ids.npy")
        numbers = [int(file.stem.removeprefix("episode_")) for file in sorted(folder.glob("episode_*.npz"))]
        assert len(language["language"]["ann"]) == len(bounds) == episodes
        assert numbers == list(range(bounds[0, 0], bounds[-1, 1] + 1))
        assert [end - 1 for _, end in language["info"]["indx"]] == bounds[:, 1].tolist()  # windows end exclusive
        assert set(language["language"]["task"]) == {"turn_on_led", "lift_red_block_table"}
        assert np.load(folder / "scene_info.npy", allow_pickle=True).item() == {
            "calvin_scene_D": [numbers[0], numbers[-1]]
        }
        frame = np.load(folder / f"episode_{numbers[0]:07d}.npz")
        assert {key: frame[key].shape for key in frame} == {
            "robot_obs": (15,),
            "scene_obs": (24,),
            "actions": (7,),
            "rel_actions": (7,),
        }
    assert not (recording / ".recording").exists()


def test_rel_actions_follow_from_actions_and_robot_obs(recording):
    for frame in frames(recording / "training").values():
        np.testing.assert_allclose(frame["rel_actions"], relative_action(frame["actions"], frame["robot_obs"]))
        moved = frame["rel_actions"][:3] * 0.02
        np.testing.assert_allclose(frame["robot_obs"][:3] + moved, frame["actions"][:3], atol=1e-9)


def same_folders(a, b):
    """Frames, bounds, scenes, statistics, windows and sentences of both splits."""
    for split in ("training", "validation"):
        assert same(frames(a / split), frames(b / split))
        files = [{f.relative_to(x / split) for f in (x / split).rglob("*")} for x in (a, b)]
        assert files[0] == files[1]
        for name in files[0]:
            one, other = a / split / name, b / split / name
            if one.suffix != ".npz" and one.is_file():
                assert one.read_bytes() == other.read_bytes(), name
    return True


def test_two_workers_record_the_same_as_one(recording, tmp_path):
    assert same_folders(record(options(tmp_path / "desk", workers=2)), recording)


@pytest.mark.parametrize("mode", ["play", "chains"])
def test_two_workers_play_the_same_as_one(mode, tmp_path):
    minutes = {"mode": mode, "hours": 0.5 / 60, "validation_hours": 0.25 / 60, "session_minutes": 0.25}
    minutes |= {"tasks": list(SKILLS), "cameras": ["static"], "scene": ["A", "B"]}
    one = record(options(tmp_path / "one", **minutes))
    assert same_folders(record(options(tmp_path / "two", **minutes, workers=2)), one)
    sentences = np.load(one / "training/lang_annotations/auto_lang_ann.npy", allow_pickle=True).item()
    assert sentences["language"]["ann"]


def test_every_scene_gets_every_task(tmp_path):
    config = options(tmp_path / "desk", scene=["A", "B", "C"], episodes=12, validation_episodes=None)
    config = RecordConfig(**{**vars(config), "validation_episodes": None})
    assert config.validation_episodes == 6
    training, validation = config.counts()
    slots = [config.slot(index) for index in range(training + validation)]
    found = {split: [(s.scene, s.number % 2) for s in slots if s.split == split] for split in SPLITS}
    assert {pair: found["training"].count(pair) for pair in found["training"]} == {
        (scene, task): 2 for scene in "ABC" for task in (0, 1)
    }
    assert sorted(found["validation"]) == [(scene, task) for scene in "ABC" for task in (0, 1)]


def test_demonstrations_on_the_original_desk_look_like_it(original_assets, tmp_path):
    made = {}
    for assets in (None, str(original_assets)):
        made[assets] = record(
            options(
                tmp_path / f"desk_{assets is None}",
                tasks=["open_drawer"],
                episodes=1,
                validation_episodes=1,
                cameras=["static", "gripper"],
                assets=assets,
                renderer="tiny",
            )
        )
        config = yaml.safe_load((made[assets] / "training/.hydra/merged_config.yaml").read_text())
        assert config["assets_used"] == ("original" if assets else "built-in")
        shown = list(frames(made[assets] / "training").values())
        assert shown[0]["rgb_static"].shape == (200, 200, 3)
        assert shown[0]["rgb_gripper"].shape == (84, 84, 3)
        drawer = [frame["scene_obs"][DRAWER] for frame in shown]
        assert drawer[-1] - drawer[0] > 0.12
    first = [next(iter(frames(folder / "training").values())) for folder in made.values()]
    assert np.abs(first[0]["rgb_static"].astype(int) - first[1]["rgb_static"]).mean() > 10


def test_blocks_go_to_disk_in_the_scenes_original_order(tmp_path):
    folder = (
        record(options(tmp_path / "desk", scene="A", tasks=["lift_red_block_table"], episodes=1, validation_episodes=1))
        / "training"
    )
    heights = np.array([frame["scene_obs"][[8, 14, 20]] for frame in frames(folder).values()])
    assert np.argmax(heights[-1] - heights[0]) == list(SCENES["A"].blocks).index("red") == 2


def start(target, **popen):
    """The command of `options(target)`, with two workers, in a process of its own."""
    flags = ["--seed=3", "--cameras=[]", "--tasks=[turn_on_led,lift_red_block_table]", "--episodes=4"]
    flags += ["--validation_episodes=2", "--workers=2", f"--output_dir={target}"]
    command = [sys.executable, "-m", "lerobot_lansar.demos.record", *flags]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, text=True, **popen)


def first_file(folder, pattern, seconds=120):
    """The first file of that pattern, as soon as there is one."""
    deadline = time.time() + seconds
    while time.time() < deadline:
        for file in folder.glob(pattern):
            return file
        time.sleep(0.005)
    raise TimeoutError(f"no {pattern} in {folder} within {seconds} s")


def test_depth_and_size_are_recorded_when_asked(tmp_path):
    one_task = {"tasks": ["turn_on_led"], "episodes": 1, "validation_episodes": 1, "depth": True}
    own = record(options(tmp_path / "own", cameras=["static", "gripper"], **one_task))
    small = record(options(tmp_path / "small", cameras=["static", "gripper"], image_size=64, **one_task))
    look = yaml.safe_load((small / "training" / ".hydra" / "merged_config.yaml").read_text())
    assert {key: look[key] for key in ("renderer", "assets_used", "image_size", "depth")} == {
        "renderer": "gl",
        "assets_used": "built-in",
        "image_size": 64,
        "depth": True,
    }
    file = "training/episode_0000003.npz"
    with np.load(own / file) as frame, np.load(small / file) as shrunk:
        for camera, size in CAMERAS.items():
            assert frame[f"depth_{camera}"].dtype == shrunk[f"depth_{camera}"].dtype == np.float32
            assert frame[f"depth_{camera}"].shape == (size, size)
            for key in (f"rgb_{camera}", f"depth_{camera}"):
                np.testing.assert_array_equal(shrunk[key], resize(frame[key], 64))
        np.testing.assert_array_equal(frame["robot_obs"], shrunk["robot_obs"])


def test_a_killed_recording_leaves_no_split_and_goes_on(recording, tmp_path):
    target = tmp_path / "desk"
    process = start(target, stderr=subprocess.DEVNULL, start_new_session=True)
    first_file(target / ".recording", "0*.json")
    os.killpg(process.pid, signal.SIGSTOP)
    assert 1 <= len(list((target / ".recording").glob("0*.json"))) < 6
    with pytest.raises(ValueError, match="another process is writing"):
        record(options(target))
    process.kill()
    process.wait()
    os.killpg(process.pid, signal.SIGCONT)
    assert is_gone(process.pid)  # the workers notice that their parent is gone
    assert not (target / "training").exists()
    with pytest.raises(ValueError, match="begun with other options"):
        record(options(target, seed=4))
    before = {f.name: f.stat().st_mtime_ns for f in (target / ".recording").glob("0*.json")}
    assert before
    record(options(target))
    for split in ("training", "validation"):
        assert same(frames(target / split), frames(recording / split))
    with pytest.raises(DeskError, match="already holds a recording"):
        record(options(target))


def is_gone(group, seconds=60):
    """Whether all processes of a group end, by themselves and in time."""
    deadline = time.time() + seconds
    while time.time() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_an_interrupted_recording_ends_its_workers_and_goes_on(recording, tmp_path):
    target = tmp_path / "desk"
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # the tests may run where Ctrl-C is ignored
    process = start(target, stderr=subprocess.PIPE, start_new_session=True, preexec_fn=heed)
    first_file(target / ".recording", "0*.json")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.endswith("lansar-record: interrupted; the same command goes on where it stopped\n")
    assert "Traceback" not in errors
    assert is_gone(process.pid)
    assert not (target / "training").exists()
    record(options(target))
    for split in ("training", "validation"):
        assert same(frames(target / split), frames(recording / split))


def test_leftovers_of_an_unknown_recording_are_not_adopted(recording, tmp_path):
    target = tmp_path / "desk"
    stale = target / ".recording"
    (stale / "000000").mkdir(parents=True)
    (stale / "000000.json").write_text('{"task": "turn_on_led", "frames": 1, "attempts": 1}')
    record(options(target))
    assert same(frames(target / "training"), frames(recording / "training"))


def test_a_killed_worker_ends_the_run_and_the_next_one_goes_on(recording, tmp_path):
    target = tmp_path / "desk"
    process = start(target, stderr=subprocess.PIPE)
    unfinished = first_file(target / ".recording", "0*-*.partial")  # its name ends with the worker's process id
    os.kill(int(unfinished.stem.split("-")[-1]), signal.SIGKILL)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "a worker process was killed" in errors
    assert WorkerDied.__name__ not in errors
    record(options(target))
    assert same(frames(target / "training"), frames(recording / "training"))


def test_splits_speak_different_sentences(recording):
    for split in ("training", "validation"):
        annotations = recording / split / "lang_annotations" / "auto_lang_ann.npy"
        language = np.load(annotations, allow_pickle=True).item()["language"]
        for task, sentence in zip(language["task"], language["ann"], strict=True):
            assert sentence in COMMANDS[split][task]
    benchmark = np.load(recording / "validation" / "lang_annotations" / "embeddings.npy", allow_pickle=True).item()
    assert {task: entry["ann"] for task, entry in benchmark.items()} == {
        task: sentences[:1] for task, sentences in COMMANDS["validation"].items()
    }


def test_a_split_that_is_there_already_is_never_replaced(tmp_path):
    mine = tmp_path / "desk" / "training"
    mine.mkdir(parents=True)
    (mine / "precious").touch()
    with pytest.raises(DeskError, match=r"already holds a recording \(training\)"):
        record(options(tmp_path / "desk"))
    assert (mine / "precious").exists()


def test_a_publication_that_failed_is_repeated(recording, tmp_path, monkeypatch):
    target = tmp_path / "desk"
    publish = record_module.publish_split

    def fails_in_the_middle(folder, *arguments):
        if folder.name == "validation":
            raise OSError("disk full")
        return publish(folder, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(record_module, "publish_split", fails_in_the_middle)
        with pytest.raises(OSError, match="disk full"):
            record(options(target))
    assert not (target / "validation").exists()
    record(options(target))
    for split in ("training", "validation"):
        assert same(frames(target / split), frames(recording / split))
    assert sorted(file.name for file in target.iterdir()) == ["training", "validation"]


def test_a_mistaken_request_can_be_corrected_before_anything_was_recorded(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise OSError("no")

    with monkeypatch.context() as patch:
        patch.setattr(record_module, "run_shards", fails)
        with pytest.raises(OSError, match="no"):
            record(options(tmp_path / "desk", seed=8))
    record(options(tmp_path / "desk", seed=9, episodes=1, validation_episodes=1))


def test_a_refused_submission_leaves_no_mark_of_jobs_under_way(tmp_path, monkeypatch):
    (tmp_path / "sbatch").write_text("#!/bin/sh\n")
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def refused(*_, **__):
        raise subprocess.CalledProcessError(1, ["sbatch"])

    monkeypatch.setattr(record_module, "run_shards", refused)
    for _ in range(2):  # the second time too, and not "were submitted already"
        with pytest.raises(subprocess.CalledProcessError):
            record(options(tmp_path / "desk", executor="slurm", slurm=SlurmConfig(partition="cpu")))


def test_validation_is_not_a_part_of_a_longer_training(tmp_path):
    short = record(options(tmp_path / "short", tasks=["turn_on_led"], episodes=1, validation_episodes=1))
    long = record(options(tmp_path / "long", tasks=["turn_on_led"], episodes=2, validation_episodes=1))
    (held_out,) = starts(short / "validation")
    assert not any(np.array_equal(held_out, start) for start in starts(long / "training"))
    assert np.array_equal(starts(short / "training")[0], starts(long / "training")[0])
    assert np.array_equal(starts(short / "validation")[0], starts(long / "validation")[0])
    said = [x / "validation/lang_annotations/auto_lang_ann.npy" for x in (short, long)]
    one, other = (np.load(file, allow_pickle=True).item()["language"]["ann"] for file in said)
    assert one == other


def starts(folder):
    """The first robot_obs of each recording."""
    bounds = np.load(folder / "ep_start_end_ids.npy")
    return [np.load(folder / f"episode_{first:07d}.npz")["robot_obs"] for first, _ in bounds]


def test_users_sentences_are_used(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("turn_on_led: [light up]\n")
    folder = record(
        options(tmp_path / "desk", tasks=["turn_on_led"], episodes=1, validation_episodes=1, annotations=str(file))
    )
    language = np.load(folder / "training" / "lang_annotations" / "auto_lang_ann.npy", allow_pickle=True).item()
    assert language["language"]["ann"] == ["light up"]


def test_units_are_divided_evenly_among_scenes_and_grouped_by_scene():
    assert group_by_scene(["A", "B", "C"], 7) == ["A", "A", "A", "B", "B", "C", "C"]
    assert group_by_scene(["A", "B", "C"], 1) == ["A"]
    for hours in (0.1, 1.0, 4.0):
        config = RecordConfig(Path("desk"), scene=["A", "B", "C", "D"], mode="chains", hours=hours)
        for split in SPLITS:
            frames = {scene: sum(n for s, n in config.sessions(split) if s == scene) for scene in "ABCD"}
            assert max(frames.values()) - min(frames.values()) <= 1
            assert max(n for _, n in config.sessions(split)) <= 2 * 60 * CONTROL_HZ
    config = RecordConfig(Path("desk"), scene=["A", "B", "C", "D"])
    told = [config.tasks[config.slot(index).number % len(config.tasks)] for index in range(config.episodes)]
    assert set(told) == set(config.tasks), "25 episodes of each scene do not leave out the same nine tasks"


def test_frames_of_a_recording_are_grouped_by_scene(tmp_path):
    folder = record(options(tmp_path / "desk", scene=["A", "C"], tasks=["turn_on_led"], episodes=3)) / "training"
    scenes = np.load(folder / "scene_info.npy", allow_pickle=True).item()
    bounds = np.load(folder / "ep_start_end_ids.npy")
    assert scenes == {
        "calvin_scene_A": [bounds[0, 0], bounds[1, 1]],
        "calvin_scene_C": [bounds[2, 0], bounds[2, 1]],
    }


def test_summary_counts_tries_and_windows(tmp_path, capsys):
    record(options(tmp_path / "desk", tasks=["turn_on_led"], episodes=2, validation_episodes=1))
    (row,) = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("turn_on_led")]
    assert int(row[1]) >= 3
    assert row[2:4] == ["3", "3"]


CHAINS = {"mode": "chains", "tasks": list(SKILLS)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tasks": ["juggle"]}, "there is no task 'juggle'"),
        ({"scene": ["A", "A"]}, "--scene must name one scene, or different ones"),
        ({"mode": "work"}, "--mode is one of windows, play, chains"),
        ({"executor": "pigeon"}, "--executor is one of local, slurm, ray"),
        ({"variety": 2.0}, "--variety lies between 0 and 1"),
        ({"noise": -0.1}, "--noise lies between 0 and 0.5"),
        ({"mode": "play", "hours": 0.0}, "--hours must be at least 6 seconds"),
        ({"mode": "play", "session_minutes": float("inf")}, "--session_minutes must be at least"),
        ({"annotations": "nowhere.yaml"}, "--annotations: annotations file .*nowhere.yaml does not exist"),
        ({"validation_annotations": "nowhere.yaml"}, "--validation_annotations: annotations file"),
        ({"seed": -1}, "--seed must be 0 or more"),
        ({"scene": "D_eval"}, "--scene: 'D_eval' is none of A, B, C, D"),
        ({"mode": "play"}, "--tasks goes with --mode=windows"),
        ({"hours": 5.0}, "--hours has no effect with --mode=windows"),
        ({"validation_hours": 5.0}, "--validation_hours has no effect with --mode=windows"),
        ({"episodes": 3, **CHAINS}, "--episodes has no effect with --mode=chains"),
        ({"validation_episodes": 5, **CHAINS}, "--validation_episodes has no effect with --mode=chains"),
        (
            {"weights": {"lift": 2.0}, **CHAINS},
            "--weights: there is no kind of task 'lift'; choose among",
        ),
        ({"weights": {"lift_slider": -1.0}, **CHAINS}, "--weights: a weight lies between 0 and 100, got -1.0"),
        ({"weights": {"lift_slider": 2.0}}, "--weights goes with --mode=play, chains or takeovers"),
        ({"scene": "E"}, "--scene: 'E' is none of A, B, C, D"),
        ({"episodes": 0}, "--episodes must be at least 1"),
        ({"cameras": ["wrist"]}, "camera 'wrist'"),
        ({"image_size": 300}, "--image_size must be between 1 and 256"),
        ({"depth": True}, "--depth=true needs --cameras"),
        ({"assets": "nowhere"}, "is missing"),
    ],
)
def test_impossible_requests_are_refused_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        record(options(tmp_path / "desk", **change))
    assert not (tmp_path / "desk").exists()
