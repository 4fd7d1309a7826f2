"""What public downloads of CALVIN are like: scene files that are missing or wrong, frames in both splits, languages."""

import json
import shutil

import numpy as np
import pytest
from fake_calvin import write_calvin

from dataset_convert import blocks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.convert import convert
from dataset_convert.options import ConvertConfig
from dataset_convert.safe_pickle import load_object_array
from dataset_convert.shared import ValidationStates, find_shared
from dataset_convert.verify import Mismatch, VerifyConfig, verify
from lerobot_lansar.calvin import SLIDE_TRAVEL
from lerobot_lansar.clip.store import dataset_fingerprint


def options(calvin, output_dir, **changes):
    return ConvertConfig(calvin.root, "me/desk", output_dir, **{"images": "none", "split": calvin.split, **changes})


def manifest_of(folder):
    return json.loads((folder / "meta/calvin_source.json").read_text())


def frames_of(folder):
    return sorted({frame for e in manifest_of(folder)["episodes"] for frame in range(e["start"], e["end"])})


def two_splits(root, training_scene="D", first=(1000, 100), **options):
    """Training and validation, the latter without scene_info.npy."""
    training = write_calvin(root, scene=training_scene, first=first[0], **options)
    validation = write_calvin(root, scene="D", split="validation", first=first[1], seed=1, **options)
    (validation.folder / "scene_info.npy").unlink()
    return training, validation


def tell_scenes(folder, **ranges):
    named = {f"calvin_scene_{letter}": list(range_) for letter, range_ in ranges.items()}
    np.save(folder / "scene_info.npy", named, allow_pickle=True)


# ---- scenes


def test_validation_without_scene_info_is_scene_d_and_says_so(tmp_path, capsys):
    _, validation = two_splits(tmp_path / "calvin", "B", first=(0, 5))  # numbered anew, as on ABC->D
    out = convert(options(validation, tmp_path / "out"))
    assert "scene D (validation is scene D in CALVIN's public data)" in capsys.readouterr().err
    manifest = manifest_of(out)
    assert manifest["scenes"]["D"]["frames"] == [5, 52]
    assert "validation is scene D" in manifest["scenes_from"]
    assert "validation is scene D" in (out / "README.md").read_text()
    assert "4 episodes" in verify(VerifyConfig("me/desk", validation.root, out))


@pytest.mark.parametrize("copied", [False, True], ids=["training has it", "copied from training"])
def test_trainings_scenes_are_believed_only_where_their_numbers_are_validations(tmp_path, copied):
    training, validation = two_splits(tmp_path / "calvin", "B", first=(0, 5))
    tell_scenes(training.folder, B=(0, 9999))  # validation's numbers lie in it, but are other frames
    if copied:
        shutil.copy(training.folder / "scene_info.npy", validation.folder)
    assert CalvinSplit(validation.root, "validation").scenes == {"D": (5, 52)}
    for frame in (5, 20, 52):  # as on ABCD->D: the same numbers are the same frames
        shutil.copy(validation.file(frame), training.file(frame))
    for frame in set(range(48)) - {5, 20}:
        training.file(frame).unlink()
    tell_scenes(training.folder, C=(0, 400), A=(401, 900))
    if copied:
        shutil.copy(training.folder / "scene_info.npy", validation.folder)
    assert CalvinSplit(validation.root, "validation").scenes == {"C": (5, 52)}
    for file in training.folder.glob("episode_*.npz"):  # not downloaded: nothing speaks for training's scenes
        file.unlink()
    assert CalvinSplit(validation.root, "validation").scenes == {"D": (5, 52)}
    np.save(training.folder / "ep_start_end_ids.npy", [[100, 147]])  # validation's frames were moved out of it
    assert CalvinSplit(validation.root, "validation").scenes == {"C": (5, 52)}


def test_a_scene_is_asked_for_where_nothing_can_tell_it(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", scene="C")
    with pytest.raises(ValueError, match=r"--scene=A: .*scene_info.npy says C: frames 100-147"):
        CalvinSplit(calvin.root, "training", scene="A")
    (calvin.folder / "scene_info.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"scene_info.npy is missing.*--scene="):
        CalvinSplit(calvin.root, "training")
    out = convert(options(calvin, tmp_path / "out", scene="C"))
    assert manifest_of(out)["scenes"] == {"C": {"frames": [100, 147], "block_order": ["blue", "red", "pink"]}}
    assert "4 episodes" in verify(VerifyConfig("me/desk", calvin.root, out))


# ---- frames in both splits


def test_shared_frames_are_left_out_only_if_validation_is_there(tmp_path):
    calvin = write_calvin(tmp_path / "calvin")
    with pytest.raises(FileNotFoundError, match="--exclude_shared=true needs the frames of"):
        convert(options(calvin, tmp_path / "out", exclude_shared=True))


def test_equal_numbers_are_not_equal_frames(tmp_path, capsys):
    training, _ = two_splits(tmp_path / "calvin", "B", first=(0, 5))
    out = convert(options(training, tmp_path / "out", exclude_shared=True))
    assert manifest_of(out)["shared_frames"] == []
    assert frames_of(out) == list(training.frames)
    assert "in training and in validation" not in capsys.readouterr().err


@pytest.mark.parametrize("mode", ["windows", "play"])
def test_equal_frames_are_shared_whatever_their_numbers(tmp_path, capsys, mode):
    training, validation = two_splits(tmp_path / "calvin", rgb=True)
    shutil.copy(training.file(1015), validation.file(7))
    kept = convert(options(training, tmp_path / "kept", mode=mode, images="png"))
    assert "frames 1015 are in validation too, as converting showed" in capsys.readouterr().err
    assert manifest_of(kept)["shared_frames"] == [1015]
    assert "1015; in episodes here: 1" in (kept / "README.md").read_text()
    assert "frames equal" in verify(VerifyConfig("me/desk", training.root, kept))
    out = convert(options(training, tmp_path / "out", mode=mode, exclude_shared=True))
    assert "frames 1015 are in training and in validation: 1 of them" in capsys.readouterr().err
    lost = range(1012, 1024) if mode == "windows" else [1015]
    assert frames_of(out) == [frame for frame in training.frames if frame not in lost]
    assert "frames equal" in verify(VerifyConfig("me/desk", training.root, out))


def test_frames_of_one_state_with_other_pictures_are_not_shared(tmp_path):
    training, validation = two_splits(tmp_path / "calvin", rgb=True)
    content = training.frames[1015]
    np.savez(validation.file(7), **{**content, "rgb_static": content["rgb_static"] + 1})
    out = convert(options(training, tmp_path / "out", exclude_shared=True))
    assert manifest_of(out)["shared_frames"] == []
    assert "4 episodes" in verify(VerifyConfig("me/desk", training.root, out))


def test_several_processes_find_the_same_shared_frames(tmp_path, monkeypatch):
    monkeypatch.setattr("dataset_convert.shared._CHUNK", 20)
    training, validation = two_splits(tmp_path / "calvin")
    for number, frame in enumerate((1001, 1030, 1047)):
        shutil.copy(training.file(frame), validation.file(number))
    split, found = CalvinSplit(training.root, "training"), []
    for workers in (1, 2):
        states = ValidationStates.read(validation.folder, workers)
        found.append(find_shared(split, states, np.array(list(training.frames)), workers))
    assert found == [[1001, 1030, 1047]] * 2
    assert find_shared(split, states, None, 1) == [1047], "of the likely ones, a recording's end"


# ---- wrong colours and wrong scenes


def test_wrong_colors_are_an_error_that_names_both_corrections_unless_the_user_insists(tmp_path, capsys):
    calvin = write_calvin(tmp_path / "calvin", scene="A", block_order=("red", "blue", "pink"))
    with pytest.raises(ValueError, match=r"(?s)scene A: .*2022-09-16.*2023-02-24.*frame 0 in scene B.*--block_order="):
        convert(options(calvin, tmp_path / "out"))
    for how, order in (("known", ["pink", "blue", "red"]), ("lifts", ["red", "blue", "pink"])):
        out = convert(options(calvin, tmp_path / how, block_order=how))
        assert "warning: scene A: its lifts show the order red, blue, pink" in capsys.readouterr().err
        assert manifest_of(out)["scenes"]["A"]["block_order"] == order
        card = (out / "README.md").read_text()
        assert "**Colours or scenes are wrong:** scene A: its lifts show the order red, blue, pink" in card
        assert "It is the one that" not in card
        assert "4 episodes" in verify(VerifyConfig("me/desk", calvin.root, out))


def test_colors_that_nothing_confirms_are_called_unknown(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", tasks=("open_drawer",))
    card = (convert(options(calvin, tmp_path / "out")) / "README.md").read_text()
    assert "**Wrong colours:** unknown" in card
    assert "It is the one that" not in card


@pytest.mark.parametrize(
    ("scene", "slides", "against"),
    [
        ("D", [0.28, 0.28, 0.2], None),
        ("B", [0.2, 0.25, 0.28], None),
        ("D", [0.304], "opens to 0.304 m; .* stops at 0.280 m, that of scene B there"),
        ("B", [0.28, 0.2795, 0.2799, 0.1], r"stops at 0.280 m \(3 times\); .* that of scene A and D there"),
        ("X", [0.5], None),
    ],
)
def test_a_door_that_another_scene_has_is_a_contradiction(scene, slides, against):
    found = blocks.contradictions(scene, blocks.Evidence(np.zeros((3, 3), int), slides))
    if against is None:
        assert not found
    else:
        with pytest.raises(AssertionError, match=against):
            raise AssertionError(*found)


def test_the_doors_are_those_of_the_desk():
    from lerobot_lansar.desk.scenes import SCENES

    assert {name: scene.slide_travel for name, scene in SCENES.items()} == SLIDE_TRAVEL


def test_the_door_is_looked_at_in_windows_that_move_it(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", tasks=("open_drawer",))
    index = load_object_array(calvin.folder / "lang_annotations/auto_lang_ann.npy")
    index["language"]["task"] = ["move_slider_left"]
    np.save(calvin.folder / "lang_annotations/auto_lang_ann.npy", index, allow_pickle=True)
    for frame, slide in ((100, 0.1), (111, 0.304)):
        calvin.rewrite(frame, scene_obs=np.array([slide, *calvin.frames[frame]["scene_obs"][1:]]))
    with pytest.raises(ValueError, match=r"scene D: its door opens to 0\.304 m"):
        convert(options(calvin, tmp_path / "out"))


# ---- other annotations


def annotate(folder, lang_folder, sentences, emb):
    """Writes the index of `folder` again, in another folder and with other sentences and embeddings."""
    stored = load_object_array(folder / "lang_annotations/auto_lang_ann.npy")
    stored["language"] |= {"ann": sentences, "emb": emb}
    (folder / lang_folder).mkdir(exist_ok=True)
    np.save(folder / lang_folder / "auto_lang_ann.npy", stored, allow_pickle=True)


def test_sentences_and_embeddings_of_another_language_folder(calvin, tmp_path):
    emb = np.random.default_rng(0).normal(size=(4, 1, 5))
    annotate(calvin.folder, "lang_all-MiniLM-L6-v2", ["eins\r\n", " zwei", "drei", "vier"], emb)
    with pytest.raises(FileNotFoundError, match=r"--lang_folder=lang_x \(folders found: lang_all-MiniLM-L6-v2, lang"):
        convert(options(calvin, tmp_path / "out", lang_folder="lang_x"))
    asked = {"lang_folder": "lang_all-MiniLM-L6-v2", "lang_embeddings": True}
    out = convert(options(calvin, tmp_path / "out", **asked))
    assert [window["sentence"] for window in manifest_of(out)["windows"]] == ["eins", "zwei", "drei", "vier"]
    stored = np.load(out / "lang/all-MiniLM-L6-v2.npy")
    np.testing.assert_array_equal(stored, emb[:, 0].astype(np.float32))
    told = json.loads((out / "lang/all-MiniLM-L6-v2.json").read_text())
    assert (told["encoder"], told["windows"], told["row"]) == ("all-MiniLM-L6-v2", 4, "calvin.window")
    assert told["fingerprint"] == dataset_fingerprint(out)
    assert "lang/all-MiniLM-L6-v2.npy" in (out / "README.md").read_text()
    config = VerifyConfig("me/desk", calvin.root, out)
    assert "4 episodes" in verify(config)
    np.save(out / "lang/all-MiniLM-L6-v2.npy", stored + 1)
    with pytest.raises(Mismatch, match=r"all-MiniLM-L6-v2.npy was changed"):
        verify(config)


def test_the_language_index_may_lie_in_the_splits_own_folder(calvin, tmp_path):
    (calvin.folder / "lang_annotations/auto_lang_ann.npy").rename(calvin.folder / "auto_lang_ann.npy")
    out = convert(options(calvin, tmp_path / "out"))
    assert "4 episodes" in verify(VerifyConfig("me/desk", calvin.root, out))


def test_missing_embeddings_are_reported_before_the_long_part(calvin, tmp_path, monkeypatch):
    monkeypatch.setattr("dataset_convert.convert.run_shards", lambda *_, **__: pytest.fail("seen too late"))
    annotate(calvin.folder, "lang_annotations", ["a", "b", "c", "d"], np.zeros((4, 0), np.float32))
    with pytest.raises(ValueError, match=r"language.emb is \(4, 0\).*leave out --lang_embeddings"):
        convert(options(calvin, tmp_path / "out", lang_embeddings=True))


@pytest.mark.parametrize("mode", ["windows", "play"])
def test_windows_that_cannot_become_an_episode_are_left_out_and_listed(tmp_path, capsys, mode):
    calvin = write_calvin(tmp_path / "calvin", tasks=("open_drawer",) * 5)
    index = calvin.folder / "lang_annotations/auto_lang_ann.npy"
    stored = load_object_array(index)
    stored["language"]["ann"][1] = " \r\n"
    stored["info"]["indx"][2] = (130, 130)
    stored["info"]["indx"][3] = (152, 170)  # beyond the recording and every scene
    np.save(index, stored, allow_pickle=True)
    np.save(calvin.folder / "ep_start_end_ids.npy", np.array([(100, 150), (151, 159)]))  # window 4 spans both
    for why, fixed in (("an empty sentence", 1), ("is empty", 2), ("lies in no scene", 3), ("not inside one", 4)):
        with pytest.raises(ValueError, match=rf"auto_lang_ann.npy: window .*{why}.*--skip_bad=true"):
            convert(options(calvin, tmp_path / "strict", mode=mode))
        stored["language"]["ann"][fixed], stored["info"]["indx"][fixed] = "pull it", (100, 101)
        np.save(calvin.root / "strict.npy", stored, allow_pickle=True)
        shutil.copy(index, calvin.root / f"{fixed}.npy")
        shutil.copy(calvin.root / "strict.npy", index)
    shutil.copy(calvin.root / "1.npy", index)
    out = convert(options(calvin, tmp_path / "out", mode=mode, skip_bad=True))
    manifest = manifest_of(out)
    assert [bad["windows"] for bad in manifest["left_out"]] == [[1], [2], [3], [4]]
    assert [window for e in manifest["episodes"] for window in e["windows"]] == [0]
    assert "4 defective episodes were left out" in capsys.readouterr().err
    assert "4 defective episodes are listed as left out" in verify(VerifyConfig("me/desk", calvin.root, out))


def test_recordings_outside_all_scenes_can_be_left_out_of_play(calvin, tmp_path):
    np.save(calvin.folder / "ep_start_end_ids.npy", np.array([(100, 123), (124, 147)]))
    tell_scenes(calvin.folder, D=(100, 123))
    out = convert(options(calvin, tmp_path / "out", mode="play", skip_bad=True))
    assert frames_of(out) == list(range(100, 124))
    assert [bad["start"] for bad in manifest_of(out)["left_out"]] == [124, 136, 124]
    assert "1 episodes, 24 frames" in verify(VerifyConfig("me/desk", calvin.root, out))


def test_pictures_are_checked_where_only_embeddings_need_them(tmp_path):
    pytest.importorskip("lerobot_lansar.clip.model")
    from lerobot_lansar.clip.config import ClipConfig

    calvin = write_calvin(tmp_path / "calvin", rgb=True, tasks=("open_drawer",) * 2, length=4)
    calvin.rewrite(102, rgb_static=np.zeros((200, 199, 3), np.uint8))
    asked = {"embed": True, "clip": ClipConfig("lansar-desk", "")}
    with pytest.raises(ValueError, match=r"episode_0000102\.npz: array 'rgb_static' is uint8"):
        convert(options(calvin, tmp_path / "out", **asked))
    out = convert(options(calvin, tmp_path / "out", skip_bad=True, **asked))
    assert frames_of(out) == [104, 105, 106, 107]
    assert len(np.load(out / "clip/observation.images.static.npy")) == 4
    assert "1 episodes, 4 frames" in verify(VerifyConfig("me/desk", calvin.root, out))
