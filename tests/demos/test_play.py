"""Play: uninterrupted recordings, windows of at most 64 frames that hold one fulfilled task each."""

import itertools
from collections import Counter

import numpy as np
import pytest

from lerobot_lansar.calvin import BULB, CHAIN_LENGTH, CONTROL_HZ, LED, TASKS, WINDOW_FRAMES, relative_action
from lerobot_lansar.demos.calvin_folder import FrameWriter
from lerobot_lansar.demos.play import choose_task, cut_windows, feasible_tasks, record_play, whole_windows
from lerobot_lansar.demos.record import RecordConfig, record
from lerobot_lansar.desk import Desk, completed_tasks, is_fulfilled
from lerobot_lansar.desk.starts import sample_start


@pytest.fixture(scope="module")
def play(tmp_path_factory):
    return record(
        RecordConfig(
            tmp_path_factory.mktemp("play") / "desk",
            scene=["B", "D"],
            mode="play",
            hours=2 / 60,
            validation_hours=1 / 60,
            session_minutes=1,
            cameras=[],
        )
    )


def load(folder, name):
    return np.load(folder / name, allow_pickle=True)


def test_all_frames_of_all_sessions_are_there(play):
    number = 0
    for split, minutes in (("training", 2), ("validation", 1)):
        bounds = load(play / split, "ep_start_end_ids.npy")
        frames = minutes * 60 * CONTROL_HZ
        assert bounds[0, 0] == number
        assert (bounds[1:, 0] == bounds[:-1, 1] + 1).all()
        assert bounds[-1, 1] == number + frames - 1
        assert len(list((play / split).glob("episode_*.npz"))) == frames
        number += frames
    scenes = load(play / "training", "scene_info.npy").item()
    assert list(scenes) == ["calvin_scene_B", "calvin_scene_D"]


def test_nothing_jumps_within_a_recording(play):
    folder = play / "training"
    for first, last in load(folder, "ep_start_end_ids.npy"):
        rows = [np.load(folder / f"episode_{k:07d}.npz") for k in range(first, last + 1)]
        robot = np.array([row["robot_obs"] for row in rows])
        assert np.abs(np.diff(robot[:, :3], axis=0)).max() < 0.035  # a push in the hand's own direction
        blocks = np.array([row["scene_obs"][6:] for row in rows])[:, [0, 1, 2, 6, 7, 8, 12, 13, 14]]
        assert np.abs(np.diff(blocks, axis=0)).max() < 0.1  # m per control step: what falls is not faster
        for row in rows:
            np.testing.assert_allclose(row["rel_actions"], relative_action(row["actions"], row["robot_obs"]))


def test_windows_hold_one_fulfilled_task_each(play):
    """Checked from the files: between a window's first and last state the oracle sees that task, on a fresh desk."""
    agreed = 0
    folder = play / "training"
    language = load(folder, "lang_annotations/auto_lang_ann.npy").item()
    scenes = load(folder, "scene_info.npy").item()
    windows = list(zip(language["info"]["indx"], language["language"]["task"], strict=True))
    assert len(windows) > 20
    assert len({task for _, task in windows}) > 8
    bounds = load(folder, "ep_start_end_ids.npy")
    order = {"calvin_scene_B": ("red", "blue", "pink"), "calvin_scene_D": ("red", "blue", "pink")}
    assert order.keys() == scenes.keys()  # in both scenes files have the blocks in our order
    desks = {name: Desk(name[-1], cameras=()) for name in scenes}
    for (start, end), task in windows:
        assert 0 < end - start <= WINDOW_FRAMES
        assert any(first <= start and end - 1 <= last for first, last in bounds)
        desk = desks[next(name for name, (first, last) in scenes.items() if first <= start <= last)]
        snapshots = []
        for number in (start, end - 1):
            frame = np.load(folder / f"episode_{number:07d}.npz")
            desk.reset(frame["robot_obs"], frame["scene_obs"])
            snapshots.append(desk.snapshot())
        agreed += completed_tasks(*snapshots) == {task}
    for desk in desks.values():
        desk.close()
    # a reset restores no velocities and contact forces: what is just being let go may differ
    assert agreed >= 0.85 * len(windows)


def test_what_is_feasible_in_play_succeeds(tmp_path):
    tried, accepted = Counter(), Counter()
    for scene, seed in (("A", 1), ("C", 2), ("D", 3)):
        with Desk(scene, cameras=()) as desk, FrameWriter(tmp_path / scene, desk.scene) as writer:
            unit = record_play(desk, 90 * CONTROL_HZ, np.random.default_rng(seed), writer, 0.2, 1.0)
        tried.update(unit.tried)
        accepted.update(unit.accepted)
    assert tried.total() > 60
    assert accepted.total() >= 0.9 * (tried.total() - 3)  # the last one of each recording is cut off


def test_weights_decide_how_often_a_group_of_tasks_is_chosen():
    tasks = [TASKS[name] for name in ("lift_red_block_slider", "lift_blue_block_slider", "open_drawer", "turn_on_led")]
    rng, weights = np.random.default_rng(0), {"lift_slider": 3.0, "turn_on_led": 0.0}
    chosen = Counter(choose_task(tasks, None, rng, weights) for _ in range(400))
    assert set(chosen) == {"lift_red_block_slider", "lift_blue_block_slider", "open_drawer"}
    assert 70 <= chosen["open_drawer"] <= 130  # a quarter
    assert choose_task([TASKS["turn_on_led"]], None, rng, weights) == "turn_on_led"  # nothing else can be done


def test_a_sampled_start_of_a_task_is_feasible_in_play():
    feasible = Counter()
    with Desk("D", cameras=()) as desk:
        for task in TASKS:
            for seed in range(4):
                obs = desk.reset(*sample_start(desk, task, np.random.default_rng(seed)))
                feasible[task] += TASKS[task] in feasible_tasks(desk.scene, desk.snapshot(), obs)
    assert {task: count for task, count in feasible.items() if count < 3} == {}


def test_after_unstacking_the_benchmarks_other_commands_are_feasible_with_the_block_in_the_hand():
    with Desk("D", cameras=()) as desk:
        obs = desk.reset(*sample_start(desk, "place_in_drawer", np.random.default_rng(0)))
        holding = feasible_tasks(desk.scene, desk.snapshot(), obs, before="lift_red_block_table")
        unstacked = feasible_tasks(desk.scene, desk.snapshot(), obs, before="unstack_block")
    assert {task.kind for task in holding} <= {"place_block", "stack_block"}
    assert {"place_block", "close_drawer"} <= {task.kind for task in unstacked}


def test_whole_windows_end_when_the_task_has_stayed_fulfilled_and_may_waver_before():
    with Desk("D", cameras=()) as desk:
        scene_obs, snapshots = desk.reset()["scene_obs"].copy(), []
        for lit in (0, 0, 1, 0, 1, 1, 1, 1, 0):
            scene_obs[LED] = lit
            desk.reset(scene_obs=scene_obs)
            snapshots.append(desk.snapshot())
    assert whole_windows(snapshots, []) == []
    assert whole_windows(snapshots, [(0, 2, "turn_on_led")]) == [(0, 7, "turn_on_led")]
    assert whole_windows(snapshots[:6], [(0, 2, "turn_on_led")]) == []
    both = [(0, 2, "turn_on_led"), (5, 8, "turn_off_led")]  # the second began too early for the first to last
    assert whole_windows(snapshots, both) == []


def test_windows_end_after_the_task_and_name_no_other():
    with Desk("D", cameras=()) as desk:
        obs = desk.reset()["scene_obs"].copy()
        snapshots = []
        for frame in range(130):
            state = obs.copy()
            state[LED] = float(frame >= 70)
            state[BULB] = float(frame >= 120)
            desk.reset(scene_obs=state)
            snapshots.append(desk.snapshot())
    windows = cut_windows(
        snapshots, [(50, 70, "turn_on_led"), (90, 120, "turn_on_lightbulb")], np.random.default_rng(0)
    )
    assert {task for *_, task in windows} == {"turn_on_led", "turn_on_lightbulb"}
    for first, end, task in windows:
        changed = {"turn_on_led": 70, "turn_on_lightbulb": 120}[task]
        assert first < changed < end <= len(snapshots)
        assert task == "turn_on_led" or first >= 70


def test_windows_of_chains_are_whole_subtasks_that_follow_each_other(tmp_path):
    folder = record(
        RecordConfig(
            tmp_path / "desk",
            mode="chains",
            hours=1.5 / 60,
            validation_hours=0.1 / 60,
            session_minutes=1.5,
            cameras=[],
        )
    )
    folder /= "training"
    language = load(folder, "lang_annotations/auto_lang_ann.npy").item()
    windows = list(zip(language["info"]["indx"], language["language"]["task"], strict=True))
    bounds = load(folder, "ep_start_end_ids.npy")
    assert len(windows) > 10
    assert max(end - start for (start, end), _ in windows) > WINDOW_FRAMES
    agreed = followed = 0
    with Desk("D", cameras=()) as desk:
        for (start, end), task in windows:
            snapshots = []
            for number in (start, end - 1):
                frame = np.load(folder / f"episode_{number:07d}.npz")
                desk.reset(frame["robot_obs"], frame["scene_obs"])
                snapshots.append(desk.snapshot())
            agreed += is_fulfilled(task, *snapshots)
    for first, last in bounds:
        inside = [window for window, _ in windows if first <= window[0] and window[1] - 1 <= last]
        assert len(inside) <= CHAIN_LENGTH
        assert all(0 <= after[0] - before[1] < 6 for before, after in itertools.pairwise(inside))
        followed += len(inside) > 1
    assert followed > 0
    assert agreed >= 0.85 * len(windows)  # as above
