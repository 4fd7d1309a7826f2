"""``lansar-verify`` passes what the converter makes and finds whatever is changed in it afterwards."""

import json
import shutil
import sys

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_calvin import write_calvin

from dataset_convert import verify
from dataset_convert.convert import ConvertConfig, convert
from dataset_convert.shards import sha256
from dataset_convert.verify import Mismatch, VerifyConfig


@pytest.mark.parametrize(
    ("options", "episodes", "frames", "videos", "exact"),
    [
        ({"images": "none"}, 4, 48, 0, 0),
        ({"images": "none", "action": "abs", "dedup": "frames", "workers": 2}, 2, 24, 0, 0),
        ({"images": "png", "tactile": True}, 4, 48, 0, 6),
        ({"images": "video", "depth": True, "tactile": True}, 4, 48, 6, 2),
        ({"images": "video", "mode": "play"}, 1, 39, 2, 0),
    ],
    ids=["numbers", "two workers", "png and touch", "video, depth and touch", "play"],
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


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    source = write_calvin(folder / "calvin", rgb=True)
    return source, convert(ConvertConfig(source.root, "me/desk", folder / "out"))


@pytest.fixture
def copied(made, tmp_path):
    """(source, dataset) that a test may damage."""
    source, out = made
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
    "frames in another order": (data("calvin.frame", lambda rows: rows[::-1]), "column calvin.frame"),
    "a frame too early": (video(lambda p: p[1:] + p[-1:]), "the video is a frame"),
    "a frame too late": (video(lambda p: p[:1] + p[:-1]), "the video is a frame"),
    "a picture dropped": (video(lambda p: p[:-1]), "the video ends too early"),
    "a picture too many": (video(lambda p: [*p, p[-1]]), "holds more pictures than"),
    "red and blue swapped": (
        video(lambda p: [np.ascontiguousarray(x[..., ::-1]) for x in p]),
        "red and blue are exchanged",
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
    "a file too few": (lambda _, out: (out / VIDEO).unlink(), "missing or surplus files: videos"),
    "a file too many": (
        lambda _, out: shutil.copy(out / DATA, out / "data/chunk-000/file-009.parquet"),
        "missing or surplus files: data",
    ),
    "the source's frames": (
        lambda source, _: source.rewrite(112, robot_obs=source.frames[112]["robot_obs"] + 1e-3),
        "episode 1, .* column observation.state|expected",
    ),
    "the source's pictures": (
        lambda source, _: source.rewrite(112, rgb_static=source.frames[112]["rgb_static"] + 1),
        "frames of episode 1 changed since",
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_found(copied, damage):
    source, out = copied
    inflict, message = DAMAGES[damage]
    inflict(source, out)
    if "too" not in damage or "frame" in damage or "picture" in damage:
        bless(out)
    with pytest.raises(Mismatch, match=message):
        verify.verify(VerifyConfig("me/desk", source.root, out))


def test_a_changed_file_is_found_by_its_hash(copied):
    source, out = copied
    with open(out / VIDEO, "r+b") as file:
        file.seek(-1, 2)
        file.write(b"!")
    with pytest.raises(Mismatch, match=r"file-001.mp4 was changed since it was converted"):
        verify.verify(VerifyConfig("me/desk", source.root, out))


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
