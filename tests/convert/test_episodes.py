"""What becomes an episode, what is left out, and what a frame says of itself."""

import json
import shutil
import tracemalloc
from itertools import groupby

import numpy as np
import pytest
from fake_calvin import COMMANDS, without_jumps, write_calvin

from dataset_convert import blocks, convert, episodes, plan
from dataset_convert.calvin import CalvinSplit
from dataset_convert.episodes import window_spans
from dataset_convert.language import Window
from dataset_convert.layout import Picture
from dataset_convert.options import ConvertConfig
from dataset_convert.shards import cut_into_shards
from dataset_convert.stats import EpisodeStats
from lerobot_lansar.calvin import SCENE_NAMES, TASKS
from lerobot_lansar.datasets import NO_COMMAND


def options(calvin, output_dir, **changes):
    return ConvertConfig(calvin.root, "me/desk", output_dir, **{"images": "none", **changes})


def load(folder):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("me/desk", root=folder)


def manifest_of(folder):
    return json.loads((folder / "meta" / "calvin_source.json").read_text())


def column(dataset, name):
    return dataset.hf_dataset.with_format("numpy")[:][name]


def annotate(calvin, windows):
    """Writes (start, end, task) as the language file."""
    annotations = {
        "language": {
            "ann": [COMMANDS.get(task, task) for *_, task in windows],
            "task": [task for *_, task in windows],
        },
        "info": {"indx": [(start, end) for start, end, _ in windows]},
    }
    np.save(calvin.root / "training/lang_annotations/auto_lang_ann.npy", annotations, allow_pickle=True)


def record_as(calvin, *recordings):
    np.save(calvin.root / "training/ep_start_end_ids.npy", np.array(recordings))


def test_play_has_every_frame_once_and_windows_as_annotations(calvin, tmp_path):
    annotate(calvin, [(103, 110, "open_drawer"), (106, 120, "close_drawer"), (130, 135, "open_drawer")])
    record_as(calvin, (100, 124), (125, 147))
    out = convert.convert(options(calvin, tmp_path / "out", mode="play"))
    dataset = load(out)
    assert (dataset.num_episodes, dataset.num_frames) == (2, 48)
    np.testing.assert_array_equal(column(dataset, "calvin.frame"), np.arange(100, 148))
    windows = column(dataset, "calvin.window")
    # of two windows the one that ends first
    expected = [-1] * 3 + [0] * 7 + [1] * 10 + [-1] * 10 + [2] * 5 + [-1] * 13
    assert windows.tolist() == expected
    sentences = [COMMANDS["open_drawer"], "close_drawer", COMMANDS["open_drawer"], NO_COMMAND]
    assert [dataset[i]["task"] for i in range(48)] == [sentences[w] for w in expected]
    numbers = {
        0: list(TASKS).index("open_drawer"),
        1: list(TASKS).index("close_drawer"),
        2: list(TASKS).index("open_drawer"),
    }
    assert column(dataset, "calvin.task").tolist() == [numbers.get(w, -1) for w in expected]
    assert set(column(dataset, "calvin.scene").tolist()) == {SCENE_NAMES.index("D")}
    assert [e["windows"] for e in manifest_of(out)["episodes"]] == [[0, 1], [2]]
    assert dataset.meta.episodes[0]["tasks"] == [NO_COMMAND, sentences[0], sentences[1]]
    card = (out / "README.md").read_text()
    assert "--policy.type=lansar" not in card
    assert "`--mode=windows`" in card


def test_a_long_recording_is_cut_where_no_window_is(calvin, tmp_path, monkeypatch):
    monkeypatch.setattr(episodes, "MAX_FRAMES", 20)
    split = CalvinSplit(calvin.root, "training")
    spans = episodes.play_spans(split, [])
    assert [(s.start, s.end) for s in spans] == [(100, 112), (112, 124), (124, 136), (136, 148)]
    annotate(calvin, [(100, 148, "open_drawer")])
    spans = episodes.play_spans(CalvinSplit(calvin.root, "training"), [])
    assert [(s.start, s.end, s.windows) for s in spans] == [(100, 120, ()), (120, 140, ()), (140, 148, ())]


def test_dedup_keeps_as_many_windows_as_it_can():
    spans = [(0, 10, "a"), (5, 12, "a"), (8, 14, "b"), (11, 20, "a"), (14, 22, "b"), (0, 30, "c")]
    windows = [Window(start, end, task, task, "D") for start, end, task in spans]
    kept = {how: [s.windows[0] for s in window_spans(windows, how, [])] for how in ("none", "task", "frames")}
    assert kept["none"] == [0, 1, 2, 3, 4, 5]
    assert kept["task"] == [0, 2, 3, 4, 5]
    assert kept["frames"] == [0, 3]


@pytest.mark.parametrize("seed", range(20))
def test_dedup_is_the_best_choice_of_all(seed):
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, 30, 9)
    windows = [Window(int(s), int(s + n), "t", "t", "D") for s, n in zip(starts, rng.integers(1, 12, 9), strict=True)]

    def most(numbers, free_from):
        later = [n for n in numbers if windows[n].start >= free_from]
        return max((1 + most(numbers, windows[n].end) for n in later), default=0)

    kept = window_spans(windows, "frames", [])
    assert len(kept) == most(range(9), 0)
    for a, b in zip(sorted(kept, key=lambda s: s.start), sorted(kept, key=lambda s: s.start)[1:], strict=False):
        assert a.end <= b.start


def test_frames_of_both_splits_are_reported_and_left_out_on_request(calvin, tmp_path, capsys):
    (calvin.root / "validation").mkdir()
    for frame in (105, 113):
        shutil.copy(calvin.file(frame), calvin.root / "validation")
    kept = convert.convert(options(calvin, tmp_path / "kept"))
    said = "frames 105, 113 are in training and in validation: 2 of them inside training's recordings, kept"
    assert said in capsys.readouterr().err
    assert load(kept).num_episodes == 4
    assert manifest_of(kept)["shared_frames"] == [105, 113]
    assert "105, 113" in (kept / "README.md").read_text()
    out = convert.convert(options(calvin, tmp_path / "out", exclude_shared=True))
    assert not {105, 113} & set(column(load(out), "calvin.frame").tolist())
    assert load(out).num_episodes == 2
    play = convert.convert(options(calvin, tmp_path / "play", exclude_shared=True, mode="play"))
    assert column(load(play), "calvin.frame").tolist() == [f for f in range(100, 148) if f not in (105, 113)]
    assert load(play).num_episodes == 3, "cut where a frame was taken out, so that times stay 1/30 s"


def test_frames_of_both_splits_that_no_recording_holds_are_reported_as_such(calvin, tmp_path, capsys):
    """So it is in the public ABCD data."""
    (calvin.root / "validation").mkdir()
    for folder in ("training", "validation"):
        shutil.copy(calvin.file(105), calvin.root / folder / "episode_0000090.npz")
    assert load(convert.convert(options(calvin, tmp_path / "out"))).num_episodes == 4
    assert "frames 90 are in training and in validation: in no recording" in capsys.readouterr().err


def test_all_missing_frames_are_listed(calvin, tmp_path):
    for frame in (105, 106, 107, 140):
        calvin.file(frame).unlink()
    with pytest.raises(FileNotFoundError, match=r"4 frames in all: 105-107, 140; .*--skip_bad=true"):
        convert.convert(options(calvin, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_long_list_of_missing_frames_says_how_many_ranges_more():
    assert episodes.as_ranges(list(range(0, 40, 2))).endswith("36, 38")
    assert episodes.as_ranges(list(range(0, 50, 2))).endswith("36, 38 and 5 more ranges")


DEFECTS = {
    "a missing frame": lambda calvin, n: calvin.file(n).unlink(),
    "a truncated frame": lambda calvin, n: calvin.file(n).write_bytes(calvin.file(n).read_bytes()[:-50]),
    "a number that is not finite": lambda calvin, n: calvin.rewrite(n, robot_obs=np.full(15, np.nan)),
    "a number too large for float32": lambda calvin, n: calvin.rewrite(n, scene_obs=np.full(24, 1e39)),
    "a wrong relative action": lambda calvin, n: calvin.rewrite(n, rel_actions=np.full(7, 0.2)),
    "a wrong shape": lambda calvin, n: calvin.rewrite(n, scene_obs=np.zeros(23)),
    "a picture of a wrong size": lambda calvin, n: calvin.rewrite(n, rgb_static=np.zeros((200, 199, 3), np.uint8)),
    "no picture": lambda calvin, n: calvin.rewrite(n, rgb_gripper=None),
}


WHERE = {
    ("windows", 100): ("a missing frame", "no picture", "a picture of a wrong size"),
    ("windows", 112): tuple(defect for defect in DEFECTS if "picture" not in defect),
    ("windows", 113): tuple(DEFECTS),
    ("windows", 123): ("a truncated frame", "a wrong relative action"),
    ("play", 100): ("a missing frame",),
    ("play", 112): ("a missing frame",),
    ("play", 113): tuple(DEFECTS),
}
"""Mode of the conversion and frame to the defects that are tried: all inside an episode, some at frames that are read
beforehand, as the first and the last of a lift."""


@pytest.mark.parametrize(
    ("mode", "frame", "defect"), [(*at, defect) for at, defects in WHERE.items() for defect in defects]
)
def test_a_defective_episode_stops_the_conversion_or_is_left_out(tmp_path, monkeypatch, capsys, defect, mode, frame):
    monkeypatch.setattr("dataset_convert.shards.BATCH_FRAMES", 5)  # it is found after a part was written
    if mode == "windows":  # good and bad ones in one file; in play a file each
        monkeypatch.setattr(plan, "cut_into_shards", lambda lengths, max_frames: [(0, len(lengths))])
    calvin = write_calvin(tmp_path / "calvin", rgb=True, length=12)
    record_as(calvin, (100, 111), (112, 123), (124, 147))
    DEFECTS[defect](calvin, frame)
    images = "video" if "picture" in defect or frame == 113 else "none"  # encoding takes most of the time
    start, end = (100, 112) if frame == 100 else (112, 124)
    with pytest.raises((ValueError, FileNotFoundError), match=f"episode_0000{frame}"):
        convert.convert(options(calvin, tmp_path / "strict", images=images, mode=mode))
    out = convert.convert(options(calvin, tmp_path / "out", images=images, mode=mode, skip_bad=True))
    dataset = load(out)
    kept = [number for number in range(100, 148) if not start <= number < end]
    assert column(dataset, "calvin.frame").tolist() == kept
    assert column(dataset, "index").tolist() == list(range(36))
    assert column(dataset, "episode_index").tolist() == [0] * 12 + (
        [1] * 12 + [2] * 12 if mode == "windows" else [1] * 24
    )
    for key in ("index", "episode_index"):  # statistics are of the new numbers
        numbers, stats = column(dataset, key), dataset.meta.stats[key]
        assert (stats["min"], stats["max"]) == (numbers.min(), numbers.max())
        assert stats["mean"] == pytest.approx(float(np.mean(numbers)))
    for index in range(0, 36, 7) if images == "video" else ():  # the videos go with it
        wanted = calvin.frames[kept[index]]["rgb_static"].transpose(2, 0, 1) / 255
        np.testing.assert_allclose(dataset[index]["observation.images.static"], wanted, atol=0.02)
    (bad,) = manifest_of(out)["left_out"]
    assert (bad["start"], bad["end"]) == (start, end)
    assert f"left out: frames {start}-{end - 1}" in capsys.readouterr().err
    assert "1 defective episodes" in (out / "README.md").read_text()


def test_nothing_left_is_an_error(calvin, tmp_path, monkeypatch):
    for frame in range(100, 148):
        calvin.rewrite(frame, actions=np.full(7, np.nan))
    with pytest.raises(ValueError, match=r"no episode is left to convert; the first: .*episode_0000100"):
        convert.convert(options(calvin, tmp_path / "out", skip_bad=True))
    monkeypatch.setattr(convert, "run_shards", lambda *_, **__: pytest.fail("seen too late"))
    with pytest.raises(ValueError, match=r"no episode is left .*'rgb_static' is missing; recorded without"):
        convert.convert(options(calvin, tmp_path / "out", images="video", skip_bad=True))


@pytest.mark.parametrize(
    ("scene", "votes"),
    [
        ("D", [[5, 4, 0], [4, 5, 0], [0, 0, 2]]),
        ("D", [[5, 5, 0], [5, 5, 0], [0, 0, 0]]),
        ("B", [[1, 1, 1], [1, 1, 1], [1, 1, 1]]),
    ],
    ids=["the known order is ahead", "it ties with another", "everything rises"],
)
def test_contradicting_lifts_are_an_error_even_where_the_known_order_is_not_beaten(scene, votes):
    with pytest.raises(ValueError, match=f"scene {scene}: its lifts contradict each other"):
        blocks.block_order(scene, blocks.Evidence(np.array(votes), []))
    with pytest.raises(ValueError, match="scene X: cannot tell"):
        blocks.block_order("X", blocks.Evidence(np.array(votes), []))


def test_lifts_of_one_colour_or_none_leave_the_known_order():
    for votes in ([[0, 0, 0], [0, 0, 0], [0, 0, 3]], np.zeros((3, 3), int)):
        assert blocks.block_order("D", blocks.Evidence(np.array(votes), [])) == ("red", "blue", "pink")


def test_depth_and_touch_on_request(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", rgb=True, depth=True, tactile=True, tasks=("open_drawer",), length=8)
    for images, tolerance in (("video", 2e-3), ("png", 0)):
        out = convert.convert(options(calvin, tmp_path / images, images=images, depth=True, tactile=True))
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset("me/desk", root=out, depth_output_unit="m")
        for index, frame in enumerate(range(100, 108)):
            item, source = dataset[index], calvin.frames[frame]
            for name, array in (("static_depth", "depth_static"), ("gripper_depth", "depth_gripper")):
                stored = item[f"observation.images.{name}"]
                assert stored.shape == (1, *source[array].shape)
                np.testing.assert_allclose(stored[0], source[array], atol=tolerance)
            for finger in range(2):
                colors = source["rgb_tactile"][..., 3 * finger : 3 * finger + 3].transpose(2, 0, 1) / 255
                np.testing.assert_allclose(item[f"observation.images.tactile_{finger}"], colors, atol=0.02)
                np.testing.assert_array_equal(
                    item[f"observation.images.tactile_{finger}_depth"][0],
                    source["depth_tactile"][..., finger],
                )
        assert set(dataset.meta.depth_keys) == {
            f"observation.images.{name}_depth" for name in ("static", "gripper", "tactile_0", "tactile_1")
        }
        assert 3 < dataset.meta.stats["observation.images.static_depth"]["mean"].item() < 4
    plain = write_calvin(tmp_path / "plain", rgb=True, tasks=("open_drawer",), length=8)
    with pytest.raises(ValueError, match="'depth_static' is missing; not recorded"):
        convert.convert(options(plain, tmp_path / "none", images="png", depth=True))


def test_a_distance_that_a_depth_video_cannot_hold_makes_an_episode_defective(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", rgb=True, depth=True, tasks=("open_drawer",) * 2, length=3)
    calvin.rewrite(101, depth_static=np.full((200, 200), 11, np.float32))
    with pytest.raises(ValueError, match=r"episode_0000101.*depth_static.* of 11 to 11 m do not fit .*--images=png"):
        convert.convert(options(calvin, tmp_path / "out", images="video", depth=True))
    exact = convert.convert(options(calvin, tmp_path / "exact", images="png", depth=True))
    assert load(exact)[1]["observation.images.static_depth"].max() == 11_000, "LeRobot gives millimetres"
    out = convert.convert(options(calvin, tmp_path / "out", images="video", depth=True, skip_bad=True))
    assert column(load(out), "calvin.frame").tolist() == [103, 104, 105]
    (bad,) = manifest_of(out)["left_out"]
    assert "episode_0000101" in bad["reason"]


def test_statistics_of_a_long_recording_look_at_as_much_depth_as_lerobots(tmp_path, monkeypatch):
    from lerobot.datasets.compute_stats import get_feature_stats, sample_indices

    monkeypatch.setattr("dataset_convert.shards.BATCH_FRAMES", 50)
    calvin = write_calvin(tmp_path / "calvin", rgb=True, depth=True, tasks=("open_drawer",) * 4, length=33)
    out = convert.convert(options(calvin, tmp_path / "out", images="png", depth=True, mode="play"))
    stats = json.loads((out / "meta" / "stats.json").read_text())["observation.images.static_depth"]
    frames = [list(calvin.frames)[index] for index in sample_indices(132)]
    assert len(frames) == 100
    pictures = np.stack([calvin.frames[frame]["depth_static"] for frame in frames])
    wanted = get_feature_stats(pictures[:, None], axis=(0, 2, 3), keepdims=True)
    assert stats["count"] == wanted["count"].tolist() == [100]
    for name in wanted.keys() - {"count"}:
        np.testing.assert_allclose(stats[name], wanted[name][0], atol=1e-3 * np.ptp(pictures), err_msg=name)


def test_depth_statistics_keep_no_pictures():
    picture = Picture("observation.images.static_depth", "depth_static", 0, (100, 100, 1))
    stats = EpisodeStats()
    rng = np.random.default_rng(0)
    stats.add_pictures(picture, np.linspace(3, 5, 10_000, dtype=np.float32).reshape(1, 100, 100))
    tracemalloc.start()
    try:
        for _ in range(50):
            stats.add_pictures(picture, rng.uniform(3, 5, (4, 100, 100)).astype(np.float32))
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 1e6, "of 8 MB that it was shown"
    assert stats.result()[picture.key]["q50"].item() == pytest.approx(4, abs=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_shards_are_whole_episodes_and_alike(seed):
    lengths = np.random.default_rng(seed).integers(1, 65, 400).tolist()
    shards = cut_into_shards(lengths, max_frames=500)
    assert [first for first, _ in shards[1:]] == [end for _, end in shards[:-1]]
    assert (shards[0][0], shards[-1][1]) == (0, 400)
    frames = [sum(lengths[first:end]) for first, end in shards]
    assert all(500 <= n < 565 for n in frames[:-1])
    assert len(cut_into_shards(lengths[:20], max_frames=500)) >= 10


def paint(calvin, rng):
    """Gives all pictures four corners of different brightness, in each channel other ones: a picture that is flipped,
    turned, transposed or of another time is plainly another one.
    """
    for number, content in enumerate(calvin.frames.values()):
        for name in ("rgb_static", "rgb_gripper"):
            corners = np.stack([rng.permutation([0, 25, 50, 75]) for _ in range(3)]).reshape(3, 2, 2)
            slope = np.linspace([1, 0], [0, 1], len(content[name]))
            picture = np.moveaxis(slope @ corners @ slope.T, 0, -1) + 9 * (number % 20)
            content[name] = picture.round().astype(np.uint8)
    for frame in calvin.frames:
        calvin.rewrite(frame)


def frames_of_episodes(calvin, mode, dedup, overlap):
    """Frame numbers of each episode to be; windows are of one length, and only neighbours overlap."""
    if mode == "play":
        return [list(calvin.frames)]
    windows = calvin.windows
    if overlap and dedup == "frames":
        windows = windows[::2]
    elif overlap and dedup == "task":
        windows = [w for _, run in groupby(windows, key=lambda w: w[2]) for w in list(run)[::2]]
    return [list(range(start, end)) for start, end, *_ in windows]


@pytest.mark.parametrize("seed", range(4))
def test_random_folders_convert_exactly(tmp_path, seed):
    """A property: whatever the folder and the options, every frame that is due is there and in its place."""
    from dataset_convert.verify import VerifyConfig, verify

    rng = np.random.default_rng(seed)
    tasks = tuple(rng.choice(list(COMMANDS), rng.integers(2, 6)))
    length = int(rng.integers(4, 12))
    scene, overlap = str(rng.choice(list(SCENE_NAMES))), int(rng.integers(0, length // 2))
    calvin = write_calvin(
        tmp_path / "calvin", rgb=True, scene=scene, tasks=tasks, length=length, overlap=overlap, seed=seed
    )
    paint(calvin, rng)
    changes = {
        "mode": str(rng.choice(["windows", "play"])),
        "images": str(rng.choice(["video", "png"])),
        "action": str(rng.choice(["rel", "abs"])),
        "scene_state": bool(rng.integers(2)),
        "task_in_state": bool(rng.integers(2)),
    }
    if changes["mode"] == "windows":
        changes["dedup"] = str(rng.choice(["none", "task", "frames"]))
    wanted = frames_of_episodes(calvin, changes["mode"], changes.get("dedup"), overlap)
    out = convert.convert(options(calvin, tmp_path / "out", **changes))
    report = verify(VerifyConfig("me/desk", calvin.root, out, min_psnr=35))
    assert f"{manifest_of(out)['request']['split']}" in report
    dataset = load(out)
    assert dataset.num_episodes == len(wanted)
    assert column(dataset, "calvin.frame").tolist() == [frame for frames in wanted for frame in frames]
    assert column(dataset, "episode_index").tolist() == [n for n, frames in enumerate(wanted) for _ in frames]
    for item in dataset:
        source = calvin.frames[item["calvin.frame"].item()]
        np.testing.assert_array_equal(item["observation.state"], without_jumps(source["robot_obs"]))
        for camera in ("static", "gripper"):
            picture = source[f"rgb_{camera}"].transpose(2, 0, 1) / 255
            np.testing.assert_allclose(item[f"observation.images.{camera}"], picture, atol=0.03)
