"""`lansar-verify` passes what the converter makes and finds whatever is changed in it afterwards."""

import json
import shutil
import sys

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_calvin import write_calvin

from dataset_convert import blocks, plan, verify
from dataset_convert.convert import convert
from dataset_convert.episodes import Span
from dataset_convert.options import ConvertConfig
from dataset_convert.verify import Mismatch, VerifyConfig
from lerobot_lansar.clip.store import sha256


@pytest.mark.parametrize(
    ("options", "episodes", "frames", "videos", "exact"),
    [
        ({"images": "none"}, 4, 48, 0, 0),
        (
            {"images": "none", "action": "abs", "dedup": "frames", "task_in_state": True, "workers": 2},
            2,
            24,
            0,
            0,
        ),
        ({"images": "png", "tactile": True}, 4, 48, 0, 6),
        ({"images": "video", "depth": True, "tactile": True}, 4, 48, 6, 2),
        ({"images": "video", "mode": "play", "task_in_state": True}, 1, 39, 2, 0),
        ({"images": "none", "scene_state": False, "task_in_state": True}, 4, 48, 0, 0),
    ],
    ids=["numbers", "two workers", "png and touch", "video, depth and touch", "play", "only the task"],
)
def test_a_fresh_dataset_equals_its_source(tmp_path, options, episodes, frames, videos, exact):
    arrays = {key: options.get(key, False) for key in ("depth", "tactile")}
    rgb = options["images"] != "none"
    source = write_calvin(tmp_path / "calvin", rgb=rgb, scene="B", overlap=3, **arrays)
    out = convert(ConvertConfig(source.root, "me/desk", tmp_path / "out", **options))
    told = verify.verify(VerifyConfig("me/desk", source.root, out, workers=options.get("workers", 1)))
    assert f"{episodes} episodes, {frames} frames equal" in told
    assert told.count("PSNR") == videos
    assert told.count("pixel by pixel") == exact


def test_without_a_process_nothing_is_read(tmp_path):
    with pytest.raises(ValueError, match=r"--workers=0: expected 1 or more"):
        verify.verify(VerifyConfig("me/desk", tmp_path, tmp_path, workers=0))


def test_a_source_in_single_precision_is_equal_too(calvin, tmp_path):
    angles = np.random.default_rng(0).uniform(-3, 3, (len(calvin.frames), 3))
    for turned, (frame, content) in zip(angles, calvin.frames.items(), strict=True):
        pose = np.r_[content["robot_obs"][:3], turned, content["robot_obs"][6:]].astype(np.float32)
        action = np.r_[content["actions"][:3], pose[3:6] + content["rel_actions"][3:6] * 0.05, content["actions"][6]]
        calvin.rewrite(frame, robot_obs=pose, actions=action)
    out = convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none"))
    assert "48 frames equal" in verify.verify(VerifyConfig("me/desk", calvin.root, out))


def shade(source):
    """Makes every picture another one when it is flipped, transposed, of other colours or of the next frame."""
    for frame, content in source.frames.items():
        for camera in ("rgb_static", "rgb_gripper"):
            slope = np.linspace(0, 110, len(content[camera]))
            brightness = slope[:, None, None] + 0.4 * slope[:, None] + 10 * (frame % 10)
            content[camera] = (brightness + [0, 5, 10]).astype(np.uint8)
        source.rewrite(frame)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The source and two datasets of it: every episode in files of its own, and all in one."""
    folder = tmp_path_factory.mktemp("made")
    source = write_calvin(folder / "calvin", rgb=True)
    shade(source)
    out = convert(ConvertConfig(source.root, "me/desk", folder / "out"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "cut_into_shards", lambda lengths, max_frames: [(0, len(lengths))])
        one = convert(ConvertConfig(source.root, "me/desk", folder / "one"))
    return source, out, one


@pytest.fixture
def copied(made, tmp_path):
    """(source, dataset) that a test may damage."""
    source, out, _ = made
    shutil.copytree(source.root, tmp_path / "calvin")
    shutil.copytree(out, tmp_path / "out")
    return type(source)(tmp_path / "calvin", source.windows, source.frames), tmp_path / "out"


def bless(out):
    """Makes the manifest's hashes those of the changed files: what remains is wrong all the same."""
    path = out / "meta/calvin_source.json"
    manifest = json.loads(path.read_text())
    manifest["files"] = {name: sha256(out / name) for name in manifest["files"]}
    path.write_text(json.dumps(manifest))


def change_column(path, name, change):
    """Rewrites one column, keeping types and row groups."""
    groups = pq.ParquetFile(path)
    tables = [groups.read_row_group(i) for i in range(groups.num_row_groups)]
    with pq.ParquetWriter(path, tables[0].schema) as writer:
        for table in tables:
            values = change(table[name].to_pylist())
            column = pa.array(values, table.schema.field(name).type)
            writer.write_table(table.set_column(table.column_names.index(name), name, column))


def change_video(path, change):
    with av.open(str(path)) as container:
        pictures = change([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30, options={"crf": "10"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def change_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


DATA = "data/chunk-000/file-002.parquet"
VIDEO = "videos/observation.images.static/chunk-000/file-001.mp4"


def data(column, change):
    return lambda source, out: change_column(out / DATA, column, change)


def video(change):
    return lambda source, out: change_video(out / VIDEO, change)


def first(value, change):
    return [change(value[0]), *value[1:]]


def noise(pictures):
    rng = np.random.default_rng(0)
    return [np.clip(p + rng.normal(0, 60, p.shape), 0, 255).astype(np.uint8) for p in pictures]


DAMAGES = {
    "one number of an action": (
        data("action", lambda rows: [first(rows[0], lambda x: np.nextafter(np.float32(x), np.float32(9)))] + rows[1:]),
        "column action is not what the source says",
    ),
    "gripper width in metres": (
        data("observation.state", lambda rows: [[*row[:6], row[6] / 2, *row[7:]] for row in rows]),
        "column observation.state",
    ),
    "blocks in another order": (
        data("observation.environment_state", lambda rows: [r[:6] + r[12:18] + r[6:12] + r[18:] for r in rows]),
        "column observation.environment_state",
    ),
    "the other form of the action": (
        data("action", lambda rows: [[2 * x for x in row] for row in rows]),
        "column action",
    ),
    "another command": (data("task_index", lambda rows: [0] * len(rows)), "column task_index"),
    "times of 24 frames per second": (
        data("timestamp", lambda rows: [i / 24 for i in range(len(rows))]),
        "column timestamp",
    ),
    "an episode that is not listed": (data("episode_index", lambda rows: [9] * len(rows)), "other episodes than 0-3"),
    "an episode in two files": (data("episode_index", lambda rows: [1] * len(rows)), "is in another file too"),
    "frames in another order": (data("calvin.frame", lambda rows: rows[::-1]), "column calvin.frame"),
    "a frame too early": (video(lambda p: p[1:] + p[-1:]), "the video is a frame"),
    "a frame too late": (video(lambda p: p[:1] + p[:-1]), "the video is a frame"),
    "a picture dropped": (video(lambda p: p[:-1]), "the video ends too early"),
    "a picture too many": (video(lambda p: [*p, p[-1]]), "holds more pictures than"),
    "red and blue swapped": (
        video(lambda p: [np.ascontiguousarray(x[..., ::-1]) for x in p]),
        "red and blue are exchanged",
    ),
    "pictures upside down": (video(lambda p: [x[::-1].copy() for x in p]), "PSNR"),
    "pictures mirrored": (video(lambda p: [x[:, ::-1].copy() for x in p]), "PSNR"),
    "pictures transposed": (video(lambda p: [x.transpose(1, 0, 2).copy() for x in p]), "PSNR"),
    "pictures of another size": (video(lambda p: [x[:100].copy() for x in p]), r"\(100, 200, 3\), the source's"),
    "height and width exchanged": (
        lambda _, out: change_json(
            out / "meta/info.json",
            lambda i: i["features"]["observation.images.static"].update(names=["width", "height", "channels"]),
        ),
        r"info.json: .*static is .*'width', 'height'.*, expected \[200, 200, 3\] \['height', 'width', 'channels'\]",
    ),
    "bad pictures": (video(noise), "PSNR .* dB, --min_psnr=22"),
    "wrong statistics": (
        lambda _, out: change_json(
            out / "meta/stats.json", lambda s: s["action"].update(mean=[x + 0.01 for x in s["action"]["mean"]])
        ),
        "stats.json: mean of action",
    ),
    "an episode's length": (
        lambda _, out: change_column(
            out / "meta/episodes/chunk-000/file-000.parquet", "length", lambda rows: [x - 1 for x in rows]
        ),
        "meta/episodes: episode 0",
    ),
    "the number of frames": (
        lambda _, out: change_json(out / "meta/info.json", lambda i: i.update(total_frames=47)),
        "info.json says",
    ),
    "another sentence in the manifest": (
        lambda _, out: change_json(
            out / "meta/calvin_source.json", lambda m: m["windows"][0].update(sentence="do something")
        ),
        "windows are not what",
    ),
    "other task numbers": (
        lambda _, out: change_json(
            out / "meta/calvin_source.json", lambda m: m.update(task_names=sorted(m["task_names"]))
        ),
        "task_names are not what",
    ),
    "a file too few": (lambda _, out: (out / VIDEO).unlink(), "missing or surplus files: videos"),
    "a file too many": (
        lambda _, out: shutil.copy(out / DATA, out / "data/chunk-000/file-009.parquet"),
        "missing or surplus files: data",
    ),
    "the source's frames": (
        lambda source, _: source.rewrite(112, robot_obs=source.frames[112]["robot_obs"] + 1e-3),
        "episode 1, .* column observation.state",
    ),
    "the source's pictures": (
        lambda source, _: source.rewrite(112, rgb_static=source.frames[112]["rgb_static"] + 1),
        "frames of episode 1 changed since",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_found(copied, damage):
    source, out = copied
    inflict, message = DAMAGES[damage]
    inflict(source, out)
    if "too" not in damage or "frame" in damage or "picture" in damage:
        bless(out)
    with pytest.raises(Mismatch, match=message):
        verify.verify(VerifyConfig("me/desk", source.root, out))


FILES = [
    VIDEO,
    DATA,
    "meta/info.json",
    "meta/stats.json",
    "meta/tasks.parquet",
    "meta/episodes/chunk-000/file-001.parquet",
]


@pytest.mark.parametrize("name", FILES)
def test_a_changed_file_is_found_by_its_hash(copied, name):
    source, out = copied
    with open(out / name, "ab") as file:
        file.write(b" ")
    with pytest.raises(Mismatch, match=f"{name} was changed since it was converted"):
        verify.verify(VerifyConfig("me/desk", source.root, out))


def test_a_file_that_nobody_listed_is_found(copied):
    source, out = copied
    shutil.copy(out / "meta/info.json", out / "meta/info_old.json")
    with pytest.raises(Mismatch, match="missing or surplus files: meta/info_old"):
        verify.verify(VerifyConfig("me/desk", source.root, out))


STATIC = "videos/observation.images.static"
PLACES = {
    f"{STATIC}/from_timestamp": lambda rows: [0.0] * len(rows),
    f"{STATIC}/to_timestamp": lambda rows: [x + 1 / 30 for x in rows],
    f"{STATIC}/chunk_index": lambda rows: [1] * len(rows),
    f"{STATIC}/file_index": lambda rows: [*rows[:-1], rows[-1] + 1],
    "data/chunk_index": lambda rows: [1] * len(rows),
    "data/file_index": lambda rows: [*rows[:-1], rows[-1] + 1],
    "dataset_from_index": lambda rows: [*rows[:1], *(x + 1 for x in rows[1:])],
    "dataset_to_index": lambda rows: [x - 1 for x in rows],
    "meta/episodes/file_index": lambda rows: [x + 1 for x in rows],
}


@pytest.mark.parametrize("name", PLACES)
def test_a_wrong_place_of_an_episode_is_found(made, tmp_path, name):
    source, _, one = made
    out = shutil.copytree(one, tmp_path / "out")
    change_column(out / "meta/episodes/chunk-000/file-000.parquet", name, PLACES[name])
    bless(out)
    with pytest.raises(Mismatch, match=f"meta/episodes.*{name}.*"):
        verify.verify(VerifyConfig("me/desk", source.root, out))


def test_all_episodes_in_one_file_are_right_too(made):
    source, _, one = made
    assert "4 episodes, 48 frames equal" in verify.verify(VerifyConfig("me/desk", source.root, one))


@pytest.fixture
def defective(calvin, tmp_path, monkeypatch):
    """Converts with a converter that has a defect: a function of it that is replaced."""

    def make(module, name, replacement, **options):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, replacement)
            return convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none", **options))

    return make


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda spans: spans[:2] + spans[3:], r"1 episodes are missing and not .*124-135, windows \[2\]"),
        (lambda spans: spans[::-1], "in another order"),
        (lambda spans: [*spans, spans[0]], "occur twice"),
        (
            lambda spans: [*spans, Span(100, 105, "D", (0,))],
            "not asked for; the first: frames 100-104",
        ),
    ],
    ids=["dropped", "another order", "twice", "too many"],
)
def test_episodes_that_the_converter_drops_or_invents_are_found(calvin, defective, change, message):
    right = plan.window_spans
    out = defective(plan, "window_spans", lambda *a: change(right(*a)))
    with pytest.raises(Mismatch, match=message):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))


def test_a_recording_that_the_converter_drops_is_found(calvin, defective):
    np.save(calvin.root / "training/ep_start_end_ids.npy", np.array([(100, 123), (124, 147)]))
    right = plan.play_spans
    out = defective(plan, "play_spans", lambda *a: right(*a)[1:], mode="play")
    with pytest.raises(Mismatch, match="1 episodes are missing and not listed"):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))


def test_blocks_that_the_converter_takes_for_others_are_found(calvin, defective):
    out = defective(blocks, "block_order", lambda *_: ("blue", "red", "pink"))
    with pytest.raises(Mismatch, match=r"scenes are not what .*'blue', 'red', 'pink'.*'red', 'blue', 'pink'"):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))
    path = out / "meta/calvin_source.json"
    change_json(path, lambda m: m["scenes"]["D"].update(block_order=["red", "blue", "pink"]))
    with pytest.raises(Mismatch, match="environment_state is not what the source"):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))


def test_what_was_left_out_is_counted_and_no_path_of_this_machine_is_told(calvin, tmp_path):
    calvin.rewrite(113, actions=np.full(7, np.nan))
    calvin.file(130).unlink()
    out = convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none", skip_bad=True))
    told = verify.verify(VerifyConfig("me/desk", calvin.root, out))
    assert "2 episodes, 24 frames equal" in told
    assert "2 defective episodes are listed as left out" in told
    manifest = (out / "meta/calvin_source.json").read_text()
    assert '"training/episode_0000113.npz: ' in manifest
    assert str(tmp_path) not in manifest + (out / "README.md").read_text()
    change_json(out / "meta/calvin_source.json", lambda m: m["request"].update(skip_bad=False))
    with pytest.raises(Mismatch, match="left out without --skip_bad=true"):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))


def test_frames_of_both_splits_are_those_of_the_source(calvin, tmp_path):
    (calvin.root / "validation").mkdir()
    shutil.copy(calvin.file(105), calvin.root / "validation")
    out = convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none", exclude_shared=True))
    config = VerifyConfig("me/desk", calvin.root, out)
    assert "3 episodes, 36 frames equal" in verify.verify(config)
    shutil.copy(calvin.file(113), calvin.root / "validation/episode_0000007.npz")
    with pytest.raises(Mismatch, match="training and validation share frames 113, which are here and should be left"):
        verify.verify(config)
    (calvin.root / "validation/episode_0000105.npz").unlink()
    with pytest.raises(Mismatch, match="frames 105 are not in validation, as it says"):
        verify.verify(config)


def test_a_dataset_of_an_earlier_version_is_refused(calvin, tmp_path):
    out = convert(ConvertConfig(calvin.root, "me/desk", tmp_path / "out", images="none"))
    change_json(out / "meta/calvin_source.json", lambda m: m["request"].pop("format"))
    with pytest.raises(ValueError, match=r"format 1, here 2; .*convert again"):
        verify.verify(VerifyConfig("me/desk", calvin.root, out))
    with pytest.raises(ValueError, match="another conversion"):
        convert(ConvertConfig(calvin.root, "me/desk", out, images="none"))


def test_another_source_is_refused(copied, tmp_path):
    other = write_calvin(tmp_path / "other", rgb=True, seed=1, length=13)
    with pytest.raises(Mismatch, match="not those that"):
        verify.verify(VerifyConfig("me/desk", other.root, copied[1]))


@pytest.mark.parametrize(
    ("inflict", "code", "message"),
    [
        (lambda out: None, 0, "4 episodes, 48 frames equal"),
        (lambda out: (out / VIDEO).unlink(), 1, "mismatch: "),
        (lambda out: (out / "meta/calvin_source.json").unlink(), 2, "must hold a result of lansar-convert"),
    ],
    ids=["equal", "different", "no dataset"],
)
def test_the_command_says_it_with_its_exit_code(copied, monkeypatch, capsys, inflict, code, message):
    source, out = copied
    inflict(out)
    arguments = ["--repo_id=me/desk", f"--root={source.root}", f"--dataset_dir={out}"]
    monkeypatch.setattr(sys, "argv", ["lansar-verify", *arguments])
    assert verify.main() == code
    printed = capsys.readouterr()
    assert message in printed.out + printed.err
