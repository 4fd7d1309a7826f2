"""Recording demonstrations: CALVIN's layout, the same data from any number of workers, nothing half-written."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from lerobot_lansar.demos.demonstrator import demonstrate, relative_action
from lerobot_lansar.demos.record import RecordConfig, record
from lerobot_lansar.demos.skills import SKILLS
from lerobot_lansar.desk import SCENES, TASKS, Desk, DeskError


def options(output_dir, **changes):
    defaults = {
        "output_dir": output_dir,
        "tasks": ["turn_on_led", "lift_red_block_table"],
        "episodes": 4,
        "validation_episodes": 2,
        "cameras": [],
        "seed": 3,
    }
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
        assert [end - 1 for _, end in language["info"]["indx"]] == bounds[
            :, 1
        ].tolist()  # windows end exclusive
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
        np.testing.assert_allclose(
            frame["rel_actions"], relative_action(frame["actions"], frame["robot_obs"])
        )
        assert np.abs(frame["rel_actions"]).max() <= 1
        moved = frame["rel_actions"][:3] * 0.02
        np.testing.assert_allclose(frame["robot_obs"][:3] + moved, frame["actions"][:3], atol=1e-9)


def test_two_workers_record_the_same_as_one(recording, tmp_path):
    other = record(options(tmp_path / "desk", workers=2))
    for split in ("training", "validation"):
        assert same(frames(other / split), frames(recording / split))


def test_blocks_go_to_disk_in_the_scenes_original_order(tmp_path):
    folder = record(options(tmp_path / "desk", scene="A", tasks=["lift_red_block_table"], episodes=1,
                            validation_episodes=1)) / "training"  # fmt: skip
    heights = np.array([frame["scene_obs"][[8, 14, 20]] for frame in frames(folder).values()])
    assert np.argmax(heights[-1] - heights[0]) == list(SCENES["A"].blocks).index("red") == 2


def test_a_killed_recording_leaves_no_split_and_goes_on(recording, tmp_path):
    target = tmp_path / "desk"
    command = [
        sys.executable, "-m", "lerobot_lansar.demos.record", f"--output_dir={target}", "--seed=3", "--cameras=[]",
        "--tasks=[turn_on_led,lift_red_block_table]", "--episodes=4", "--validation_episodes=2", "--workers=2",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.time() + 120
    while not list((target / ".recording").glob("0*.json")) and time.time() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGSTOP)
    assert 1 <= len(list((target / ".recording").glob("0*.json"))) < 6
    with pytest.raises(DeskError, match="another process is recording"):
        record(options(target))
    process.kill()
    process.wait()
    os.killpg(process.pid, signal.SIGCONT)
    while _alive(process.pid) and time.time() < deadline:  # the workers notice and end
        time.sleep(0.05)
    assert not _alive(process.pid)
    assert not (target / "training").exists()
    with pytest.raises(DeskError, match="begun with other options"):
        record(options(target, seed=4))
    before = {f.name: f.stat().st_mtime_ns for f in (target / ".recording").glob("0*.json")}
    assert before
    record(options(target))
    for split in ("training", "validation"):
        assert same(frames(target / split), frames(recording / split))
    with pytest.raises(DeskError, match="already holds a recording"):
        record(options(target))


def _alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_leftovers_of_an_unknown_recording_are_not_adopted(recording, tmp_path):
    target = tmp_path / "desk"
    stale = target / ".recording"
    (stale / "000000").mkdir(parents=True)
    (stale / "000000.json").write_text('{"task": "turn_on_led", "frames": 1, "attempts": 1}')
    record(options(target))
    assert same(frames(target / "training"), frames(recording / "training"))


def test_recorded_actions_fulfil_the_task_again_without_noise():
    with Desk("D", cameras=()) as desk:
        for task in ("move_slider_right", "turn_off_lightbulb"):
            demonstration = demonstrate(desk, task, np.random.default_rng(2), noise=0.0)
            first = {key: values[0] for key, values in demonstration.frames.items()}
            desk.reset(first["robot_obs"], first["scene_obs"])
            start = desk.snapshot()
            for action in demonstration.frames["actions"]:
                desk.step(action, "abs")
            assert TASKS[task](start, desk.snapshot()), task


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("task", SKILLS)
def test_every_skill_succeeds_in_most_starts_of_every_scene(scene, task):
    with Desk(scene, cameras=()) as desk:
        done = [demonstrate(desk, task, np.random.default_rng([9, k])) is not None for k in range(5)]
    assert sum(done) >= 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tasks": ["stack_block"]}, "'stack_block' cannot be demonstrated"),
        ({"scene": "E"}, "scene 'E' is unknown"),
        ({"episodes": 0}, "--episodes must be at least 1"),
        ({"cameras": ["wrist"]}, "camera 'wrist'"),
        ({"assets": "nowhere"}, "is missing"),
    ],
)
def test_impossible_requests_are_refused_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(DeskError, match=message):
        record(options(tmp_path / "desk", **change))
    assert not (tmp_path / "desk").exists()
