"""`lansar-replay`: recordings set and carried out again on the desk, from datasets and from CALVIN folders."""

import shutil
import sys

import av
import numpy as np
import pytest

from dataset_convert.convert import convert
from dataset_convert.options import ConvertConfig
from lerobot_lansar.calvin import BLOCK_ORDER, block_columns, wrap_angle
from lerobot_lansar.command import CommandError
from lerobot_lansar.datasets import MANIFEST
from lerobot_lansar.demos.record import record
from lerobot_lansar.demos.record_config import RecordConfig
from lerobot_lansar.desk import Desk, SimulationError
from lerobot_lansar.replay import replay as command
from lerobot_lansar.replay.outcome import carry_out_actions, deviations, set_states
from lerobot_lansar.replay.recordings import DatasetSource, FolderSource
from lerobot_lansar.replay.replay import ReplayConfig, replay

TASKS = ["lift_red_block_table", "open_drawer", "turn_on_led"]


def recorded(output_dir, **options):
    return record(RecordConfig(output_dir=output_dir, validation_episodes=1, noise=0.0, seed=1, **options))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Undisturbed demonstrations of three tasks in scene A, then in scene D, without pictures."""
    return recorded(tmp_path_factory.mktemp("folder") / "desk", scene=["A", "D"], tasks=TASKS, episodes=6, cameras=[])


@pytest.fixture(scope="module")
def dataset(folder):
    """The same as a LeRobotDataset of absolute actions."""
    target = folder.parent / "dataset"
    return convert(ConvertConfig(folder, "me/desk", target, action="abs", images="none"))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """One short demonstration with pictures."""
    return recorded(tmp_path_factory.mktemp("filmed") / "desk", tasks=["turn_on_led"], episodes=1)


def outcomes(dataset, **options):
    replays = replay(ReplayConfig(repo_id="me/desk", dataset_dir=dataset, episodes=6, **options))
    assert [one.recording.task for one in replays] == TASKS * 2
    states, actions = zip(*(one.outcomes.values() for one in replays), strict=True)
    return [one.recording.task for one in replays], states, actions


def test_states_and_absolute_actions_show_the_recording_again(dataset):
    tasks, states, actions = outcomes(dataset)
    assert all(task in outcome.fulfilled for task, outcome in zip(tasks * 2, (*states, *actions), strict=True))
    set_again, done_again = (np.max([outcome.largest for outcome in part], axis=0) for part in (states, actions))
    # A recorded TCP in motion is one simulation step old, a reset one is not: about a millimetre.
    np.testing.assert_array_less(set_again, [1.5, 0.2, 0.01, 0.5, 0.1])
    np.testing.assert_array_less(done_again, [0.1, 0.1, 0.1, 0.5, 0.2])


def test_relative_actions_drift_because_the_arm_lags_behind_what_it_is_told(dataset):
    config = ReplayConfig(repo_id="me/desk", dataset_dir=dataset, episode=1, control_mode="rel", video=False)
    ((states, actions),) = (one.outcomes.values() for one in replay(config))
    assert states.largest[0] < 1.5
    assert actions.largest[0] > 50


def test_a_dataset_holds_what_its_folder_holds_with_blocks_in_one_order(folder, dataset):
    one, other = DatasetSource("me/desk", dataset), FolderSource(folder, "training")
    assert (len(one), len(other), one.control_mode) == (6, 6, "abs")
    for number in range(6):
        a, b = one.read(number, True), other.read(number, True)
        assert (a.scene, a.task, a.sentence) == (b.scene, b.task, b.sentence)
        np.testing.assert_allclose(wrap_angle(a.robot_obs - b.robot_obs), 0, atol=1e-5)
        np.testing.assert_allclose(a.scene_obs, b.scene_obs, atol=1e-5)
        np.testing.assert_allclose(wrap_angle(a.actions["abs"] - b.actions["abs"]), 0, atol=1e-5)
        np.testing.assert_allclose(a.actions["rel"], b.actions["rel"], atol=1e-5)
        assert not a.pictures
        assert not b.pictures


def test_tasks_that_nobody_names_any_more_are_not_judged(dataset, tmp_path, monkeypatch):
    """As after a merge, which loses the manifest that names tasks beyond CALVIN's."""
    copy = shutil.copytree(dataset, tmp_path / "merged")
    (copy / MANIFEST).unlink()
    source = DatasetSource("me/desk", copy)
    assert source.read(0, False).task == TASKS[0]
    monkeypatch.setattr(source, "_task_names", source._task_names[:1])
    assert source.read(0, False).task == ""


def test_blocks_in_the_order_of_calvins_files_fulfil_another_task(folder):
    recording = FolderSource(folder, "training").read(0, False)
    assert (recording.scene, recording.task) == ("A", "lift_red_block_table")
    with Desk("A", cameras=()) as desk:
        assert "lift_red_block_table" in set_states(desk, recording).fulfilled
        recording.scene_obs = recording.scene_obs[:, block_columns(BLOCK_ORDER["A"])]
        assert "lift_red_block_table" not in set_states(desk, recording).fulfilled


def test_a_folder_may_lack_its_scene_and_hold_a_faulty_window(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "training/scene_info.npy").unlink()
    file = copy / "training/lang_annotations/auto_lang_ann.npy"
    annotations = np.load(file, allow_pickle=True).item()
    first, _ = annotations["info"]["indx"][1]
    annotations["info"]["indx"][1] = (first, first + 100_000)
    np.save(file, annotations, allow_pickle=True)
    with pytest.raises(FileNotFoundError, match="name it: --scene="):
        FolderSource(copy, "training")
    source = FolderSource(copy, "training", "A")
    assert source.whole() == [0, *range(2, len(source))]
    assert source.read(0, False).scene == "A"
    with pytest.raises(ValueError, match="window 1 cannot be replayed"):
        source.read(1, False)


def test_another_scene_shows(dataset):
    tasks, _, actions = outcomes(dataset, scene="B")
    assert all(outcome.largest.max() > 10 for outcome in actions)
    leds = [outcome for task, outcome in zip(tasks, actions, strict=True) if task == "turn_on_led"]
    assert not any("turn_on_led" in outcome.fulfilled for outcome in leds)  # its button is elsewhere


def test_deviations_are_distances_and_turns_whatever_the_angles_notation():
    robot_obs, scene_obs = np.zeros((1, 15)), np.zeros((1, 24))
    robot_obs[0, :6] = 0.001, 0.002, 0.002, np.pi - 0.01, 0, 0
    robot_obs[0, 9] = np.radians(3)
    then = np.zeros((1, 15))
    then[0, 3] = -np.pi - 2 * np.pi
    scene_obs[0, [1, 13]] = -0.02, 0.005  # the drawer; the blue block
    found = deviations(robot_obs, scene_obs, then, np.zeros((1, 24)))
    np.testing.assert_allclose(found, [[3, np.degrees(0.01), 3, 5, 20]])


def test_a_simulation_that_diverges_is_no_success(folder, monkeypatch):
    recording = FolderSource(folder, "training").read(2, False)
    with Desk("A", cameras=()) as desk:
        step = iter(range(3))

        def failing(*arguments):
            if next(step, None) is None:
                raise SimulationError("diverged")
            return Desk.step(desk, *arguments)

        monkeypatch.setattr(desk, "step", failing)
        outcome = carry_out_actions(desk, recording, "abs")
    assert outcome.diverged
    assert len(outcome.deviations) == 4
    assert np.isinf(outcome.largest).all()
    assert not outcome.fulfilled


def run(monkeypatch, *options):
    monkeypatch.setattr(sys, "argv", ["lansar-replay", *map(str, options)])
    return command.main()


def test_the_video_shows_recording_states_and_actions_side_by_side(filmed, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, f"--root={filmed}", "--window=0", f"--output_dir={tmp_path}") == 0
    printed = capsys.readouterr().out
    assert printed.count("fulfilled at frame") == 2
    with av.open(str(tmp_path / "window_000000.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == len(FolderSource(filmed, "training").read(0, False)) + 1  # after the last action
    assert frames[0].shape == (68 + 400 + 168, 3 * 400, 3)
    recorded, states, actions = (frames[-1][68:468, left : left + 400] for left in (0, 400, 800))
    assert np.abs(recorded - states).mean() < 2
    assert np.abs(recorded - actions).mean() < 2
    assert np.abs(frames[0][68:468, :400] - recorded).mean() > 3  # the arm has moved
    for left in (400, 800):  # each verdict, in green, right of the gripper camera's picture
        verdict = slice(468, None), slice(left + 168, left + 400)
        green = [(np.abs(frame[verdict] - (110, 230, 120)).max(-1) < 60).sum() for frame in frames]
        assert green[0] == 0 < green[-1]


def test_pictures_of_a_dataset_are_those_of_its_folder(filmed, tmp_path):
    folder = convert(ConvertConfig(filmed, "me/filmed", tmp_path / "dataset"))
    one = DatasetSource("me/filmed", folder).read(0, True).pictures
    other = FolderSource(filmed, "training").read(0, True).pictures
    for camera, size in (("static", 200), ("gripper", 84)):
        assert one[camera].shape == other[camera].shape == (len(one[camera]), size, size, 3)
        assert one[camera].dtype == other[camera].dtype == np.uint8
        assert np.abs(one[camera].astype(int) - other[camera]).mean() < 5  # a video's codec


def test_several_are_told_of_in_a_table_by_task(folder, tmp_path, monkeypatch, capsys):
    options = [f"--root={folder}", "--episodes=3", f"--output_dir={tmp_path / 'none'}"]
    tables = []
    for seed in (0, 0, 1):
        assert run(monkeypatch, *options, f"--seed={seed}") == 0
        tables.append(capsys.readouterr().out)
    assert tables[0] == tables[1] != tables[2]
    rows = [line.split()[:4] for line in tables[0].splitlines() if line.startswith("all ")]
    assert rows == [["all", "3", "100.0", "%"]] * 2
    assert "states set" in tables[0]
    assert "actions carried out (abs)" in tables[0]
    assert not (tmp_path / "none").exists()


def test_an_episode_of_several_commands_is_refused_with_advice(folder, tmp_path):
    play = tmp_path / "play"
    shutil.copytree(folder, play)
    bounds = np.load(play / "training/ep_start_end_ids.npy")
    np.save(play / "training/ep_start_end_ids.npy", [[bounds[0, 0], bounds[2, 1]]])  # scene A's three in one
    annotations = np.load(play / "training/lang_annotations/auto_lang_ann.npy", allow_pickle=True).item()
    kept = {key: values[:3] for key, values in annotations["language"].items()}
    annotations = {"language": kept, "info": {"indx": annotations["info"]["indx"][:3]}}
    np.save(play / "training/lang_annotations/auto_lang_ann.npy", annotations, allow_pickle=True)
    target = convert(ConvertConfig(play, "me/play", tmp_path / "dataset", mode="play", images="none"))
    with pytest.raises(CommandError, match="several commands: convert with --mode=windows"):
        DatasetSource("me/play", target).read(0, False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either --repo_id=… "),
        ({"root": True, "repo_id": "me/desk"}, "either --repo_id=… "),
        ({"root": True}, "either --window=… "),
        ({"root": True, "window": 0, "episodes": 2}, "either --window=… "),
        ({"root": True, "episode": 0}, "--episode does not go with --root; give --window=…"),
        ({"root": True, "window": 6}, "--window=6: there are windows 0 to 5"),
        ({"root": True, "window": 0, "control_mode": "joints"}, "expected rel or abs"),
        ({"root": True, "window": 0, "scene": "E"}, "scene 'E' is unknown"),
    ],
)
def test_options_that_cannot_be_carried_out_are_named(folder, options, message):
    if "root" in options:
        options = {**options, "root": folder}
    with pytest.raises((CommandError, ValueError), match=message):
        replay(ReplayConfig(**options))
