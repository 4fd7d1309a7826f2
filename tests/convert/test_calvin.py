"""Reading CALVIN's files: what is admitted, and how each defect is reported."""

import os
import pickle

import numpy as np
import pytest
from fake_calvin import write_calvin

from dataset_convert import checks
from dataset_convert.calvin import VECTORS, CalvinSplit, load_object_array


def read_all(calvin):
    split = CalvinSplit(calvin.root, "training")
    for window in split.windows:
        frames = range(window.start, window.end)
        checks.check_frames(split.read(frames, VECTORS), frames, split)


def test_a_valid_split_passes_every_check(calvin):
    read_all(calvin)


def test_the_end_of_a_window_is_exclusive(calvin):
    split = CalvinSplit(calvin.root, "training")
    assert [(w.start, w.end, len(w)) for w in split.windows] == [(s, e, 12) for s, e, *_ in calvin.windows]
    assert split.windows[0].end == split.windows[1].start


def test_an_index_file_that_names_code_is_refused_and_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "exploded"),)

    path = tmp_path / "bomb.npy"
    np.save(path, {"language": Bomb()}, allow_pickle=True)
    with pytest.raises(ValueError, match=r"bomb\.npy.*refused to load"):
        load_object_array(path)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_index_files_of_older_numpy_and_pickle_versions_load(tmp_path, protocol):
    stored = {"info": {"indx": [(np.int64(1), np.int64(2))]}, "emb": np.ones((1, 1, 3)), "ann": ["açai"]}
    path = tmp_path / "old.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        content = pickle.dumps(np.array(stored, dtype=object), protocol=protocol)
        file.write(
            content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray") if protocol < 4 else content
        )
    loaded = load_object_array(path)
    assert loaded["ann"] == ["açai"]
    assert loaded["info"]["indx"] == [(1, 2)]
    np.testing.assert_array_equal(loaded["emb"], stored["emb"])


def test_a_missing_frame_is_named(calvin):
    calvin.file(105).unlink()
    with pytest.raises(FileNotFoundError, match=r"episode_0000105\.npz is missing"):
        read_all(calvin)


@pytest.mark.parametrize("keep", [0, 100, -30])
def test_a_truncated_frame_is_named(calvin, keep):
    content = calvin.file(105).read_bytes()
    calvin.file(105).write_bytes(content[:keep])
    with pytest.raises(ValueError, match=r"episode_0000105\.npz: truncated"):
        read_all(calvin)


def test_a_flipped_byte_inside_a_frame_is_noticed(calvin):
    content = bytearray(calvin.file(105).read_bytes())
    content[200] ^= 1
    calvin.file(105).write_bytes(bytes(content))
    with pytest.raises(ValueError, match=r"episode_0000105\.npz"):
        read_all(calvin)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("scene_obs", None, "array 'scene_obs' is missing"),
        ("robot_obs", np.zeros(14), r"'robot_obs' is float64 \(14,\), expected float \(15,\)"),
        ("actions", np.zeros(7, dtype=np.int64), r"'actions' is int64 \(7,\), expected float"),
        ("scene_obs", np.full(24, np.nan), "'scene_obs' holds a number that is not finite"),
        ("actions", np.full(7, 0.5), "gripper command 0.5"),
        ("rel_actions", np.full(7, 0.123), r"rel_actions\[0\] is 0.123000, but"),
    ],
)
def test_a_wrong_array_is_reported_with_its_file(calvin, key, value, message):
    calvin.rewrite(107, **{key: value})
    with pytest.raises(ValueError, match=rf"episode_0000107\.npz.*{message}"):
        read_all(calvin)


def test_object_arrays_in_a_frame_are_refused(calvin):
    calvin.rewrite(107, actions=np.array([{}] * 7, dtype=object))
    with pytest.raises(ValueError, match=r"episode_0000107\.npz"):
        read_all(calvin)


def test_a_window_across_two_recordings_is_refused(calvin):
    np.save(calvin.root / "training" / "ep_start_end_ids.npy", np.array([[100, 105], [106, 147]]))
    with pytest.raises(ValueError, match=r"window \[100, 112\) is not inside one recording"):
        CalvinSplit(calvin.root, "training")


def test_a_window_outside_every_scene_is_refused(calvin):
    np.save(calvin.root / "training" / "scene_info.npy", {"calvin_scene_D": [100, 120]}, allow_pickle=True)
    with pytest.raises(ValueError, match="lies in no scene"):
        CalvinSplit(calvin.root, "training")


@pytest.mark.parametrize(
    "name", ["scene_info.npy", "ep_start_end_ids.npy", "lang_annotations/auto_lang_ann.npy"]
)
def test_a_missing_or_damaged_index_file_is_named(calvin, name):
    path = calvin.root / "training" / name
    path.write_bytes(path.read_bytes()[:90])
    with pytest.raises(ValueError, match=path.name):
        CalvinSplit(calvin.root, "training")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=path.name):
        CalvinSplit(calvin.root, "training")


def test_a_missing_split_is_reported_with_those_found(calvin):
    with pytest.raises(FileNotFoundError, match=r"--split=validation.*splits found: training"):
        CalvinSplit(calvin.root, "validation")


def test_relative_actions_wrap_angles_and_clip():
    robot_obs = np.zeros((1, 15))
    robot_obs[0, 3:6] = 3.13, -3.13, 0.0
    actions = np.array([[0.01, -1.0, 0.0, -3.13, 3.13, 0.025, -1.0]])
    turn = 2 * np.pi - 6.26
    expected = [[0.5, -1, 0, turn / 0.05, -turn / 0.05, 0.5, -1]]
    np.testing.assert_allclose(checks.relative_actions(actions, robot_obs), expected, atol=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_half_a_turn_may_be_stored_with_either_sign(calvin, sign):
    robot_obs, actions = calvin.frames[103]["robot_obs"].copy(), calvin.frames[103]["actions"].copy()
    actions[4] = robot_obs[4] + np.pi
    rel = checks.relative_actions(actions[None], robot_obs[None])[0]
    rel[4] = sign
    calvin.rewrite(103, actions=actions, rel_actions=rel)
    read_all(calvin)
    rel[4] = 0.9
    calvin.rewrite(103, actions=actions, rel_actions=rel)
    with pytest.raises(ValueError, match=r"rel_actions\[4\]"):
        read_all(calvin)


def order_of(calvin, scene):
    return checks.block_order(scene, checks.block_votes(CalvinSplit(calvin.root, "training"), scene))


@pytest.mark.parametrize("scene", "ABCD")
def test_lifts_confirm_the_block_order_of_each_scene(tmp_path, scene):
    assert order_of(write_calvin(tmp_path, scene=scene), scene) == checks.SCENE_BLOCK_ORDER[scene]


def test_lifts_overrule_a_known_block_order(tmp_path):
    reordered = write_calvin(tmp_path, scene="A", block_order=("red", "blue", "pink"))
    assert order_of(reordered, "A") == ("red", "blue", "pink")


def test_an_unknown_scene_needs_lifts_to_tell_its_blocks_apart(tmp_path):
    lifted = write_calvin(tmp_path / "lifts", scene="X", block_order=("blue", "pink", "red"))
    assert order_of(lifted, "X") == ("blue", "pink", "red")
    silent = write_calvin(
        tmp_path / "silent", scene="X", block_order=("blue", "pink", "red"), tasks=("open_drawer",)
    )
    with pytest.raises(ValueError, match=r"scene X: cannot tell.*known order: none"):
        order_of(silent, "X")


def test_a_known_scene_without_lifts_keeps_its_order(tmp_path):
    assert order_of(write_calvin(tmp_path, scene="C", tasks=("open_drawer",)), "C") == ("blue", "red", "pink")


def test_one_wrongly_named_lift_does_not_change_the_order():
    votes = np.array([[9, 0, 1], [0, 8, 0], [0, 0, 9]])
    assert checks.block_order("D", votes) == ("red", "blue", "pink")
    assert checks.block_order("X", votes) == ("red", "blue", "pink")


def test_contradicting_lifts_are_an_error():
    with pytest.raises(ValueError, match="scene A: cannot tell"):
        checks.block_order("A", np.array([[5, 4, 0], [4, 5, 0], [0, 0, 2]]))


def test_reordering_moves_whole_blocks():
    scene_obs = np.arange(24.0)[None]
    reordered = checks.reorder_blocks(scene_obs, ("pink", "blue", "red"))[0]
    assert reordered.tolist() == [*range(6), *range(18, 24), *range(12, 18), *range(6, 12)]
