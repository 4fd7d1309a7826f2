"""The hand-written v3 files against LeRobot's own recorder on the same frames."""

import importlib.util
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_calvin import without_jumps, write_calvin

from dataset_convert.convert import convert
from dataset_convert.features import dataset_features, pictures_of
from dataset_convert.layout import RGBEncoder
from dataset_convert.options import ConvertConfig
from dataset_convert.stats import EpisodeStats
from lerobot_lansar.calvin import SCENE_NAMES, TASKS
from lerobot_lansar.cameras import gripper_camera_pose

CAMERA_OF = {"observation.images.static": "rgb_static", "observation.images.gripper": "rgb_gripper"}


def shade(source):
    """Makes every picture another one when it is flipped, transposed, of other colours or of the next frame."""
    for frame, content in source.frames.items():
        for camera in CAMERA_OF.values():
            slope = np.linspace(0, 110, len(content[camera]))
            brightness = slope[:, None, None] + 0.4 * slope[:, None] + 10 * (frame % 10)
            content[camera] = (brightness + [0, 5, 10]).astype(np.uint8)
        source.rewrite(frame)


@pytest.fixture(scope="module", params=["none", "png", "video"])
def both(request, tmp_path_factory):
    """(ours, LeRobot's, source): the same four windows written in the two ways."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.constants import DEFAULT_FEATURES

    folder = tmp_path_factory.mktemp("both")
    images = request.param
    source = write_calvin(folder / "calvin", rgb=images != "none", overlap=2, length=10)
    if images != "none":
        shade(source)
    ours = convert(ConvertConfig(source.root, "me/desk", folder / "ours", images=images))
    pictures = pictures_of(images, depth=False, tactile=False, encoder=RGBEncoder())
    features = {k: v for k, v in dataset_features("rel", pictures).items() if k not in DEFAULT_FEATURES}
    theirs = LeRobotDataset.create(
        "me/desk",
        30,
        features,
        folder / "theirs",
        "panda",
        use_videos=images == "video",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=18, preset="veryfast", pix_fmt="yuv444p"),
    )
    for number, (start, end, task, sentence) in enumerate(source.windows):
        for frame in range(start, end):
            content = source.frames[frame]
            vectors = {
                "observation.state": without_jumps(content["robot_obs"]),
                "observation.environment_state": content["scene_obs"],
                "action": content["rel_actions"],
                "calvin.actions": without_jumps(content["actions"]),
            }
            item = {key: value.astype(np.float32) for key, value in vectors.items()}
            numbers = {
                "frame": frame,
                "window": number,
                "task": list(TASKS).index(task),
                "scene": SCENE_NAMES.index("D"),
            }
            item |= {f"calvin.{name}": np.array([value]) for name, value in numbers.items()}
            if images != "none":
                item |= {key: content[camera] for key, camera in CAMERA_OF.items()}
                pose = gripper_camera_pose(content["robot_obs"])
                item["calvin.gripper_camera_pose"] = pose.reshape(16).astype(np.float32)
            theirs.add_frame({**item, "task": sentence})
        theirs.save_episode(parallel_encoding=False)
    theirs.finalize()
    return LeRobotDataset("me/desk", root=ours), LeRobotDataset("me/desk", root=folder / "theirs"), source


def test_every_item_is_equal(both):
    ours, theirs, source = both
    assert len(ours) == len(theirs) == 40
    for a, b in zip(ours, theirs, strict=True):
        assert a.keys() == b.keys()
        for key, value in a.items():
            if key in CAMERA_OF:
                picture = source.frames[a["calvin.frame"].item()][CAMERA_OF[key]]
                wanted = picture.transpose(2, 0, 1) / 255
                np.testing.assert_allclose(value, wanted, atol=0.06)
                assert np.abs(value - wanted).mean() < 0.01, "a frame of another time is 0.04 off"
            elif isinstance(value, str):
                assert value == b[key]
            else:
                assert value.dtype == b[key].dtype
                np.testing.assert_array_equal(value, b[key])


def test_pictures_are_described_as_they_lie():
    """Literally: a description that is made twice in the same wrong way would equal itself."""
    pictures = pictures_of("png", depth=True, tactile=True, encoder=RGBEncoder())
    described = {key: feature for key, feature in dataset_features("rel", pictures).items() if "images" in key}
    assert {key.removeprefix("observation.images."): of["shape"] for key, of in described.items()} == {
        "static": (200, 200, 3),
        "gripper": (84, 84, 3),
        "static_depth": (200, 200, 1),
        "gripper_depth": (84, 84, 1),
        **{f"tactile_{finger}": (160, 120, 3) for finger in range(2)},
        **{f"tactile_{finger}_depth": (160, 120, 1) for finger in range(2)},
    }
    assert all(feature["names"] == ["height", "width", "channels"] for feature in described.values())


def test_the_description_is_equal(both):
    ours, theirs, _ = both
    a, b = ours.meta.info.to_dict(), theirs.meta.info.to_dict()
    assert a == b
    assert ours.meta.tasks.equals(theirs.meta.tasks)


def test_the_parquet_files_have_the_same_columns(both):
    ours, theirs, _ = both
    for name in ("data", "meta/episodes"):
        path = f"{name}/chunk-000/file-000.parquet"
        a, b = pq.read_schema(ours.root / path), pq.read_schema(theirs.root / path)
        assert dict(zip(a.names, a.types, strict=True)) == dict(zip(b.names, b.types, strict=True))
    files = (ours.root / "data").rglob("*.parquet")
    assert sum(pq.ParquetFile(file).num_row_groups for file in files) == 4


def test_statistics_are_lerobots(both):
    ours, theirs, _ = both
    assert ours.meta.stats.keys() == theirs.meta.stats.keys()
    for key, expected in theirs.meta.stats.items():
        stats = ours.meta.stats[key]
        assert stats.keys() == expected.keys()
        # LeRobot reads quantiles from 5000 bins and computes in float32.
        spread = np.max(expected["max"] - expected["min"])
        for name, value in expected.items():
            assert stats[name].shape == value.shape, (key, name)
            np.testing.assert_allclose(
                stats[name], value, rtol=1e-5, atol=2e-3 * spread + 1e-6, err_msg=f"{key} {name}"
            )


@pytest.mark.parametrize("length", [1, 2, 33, 64])
def test_episode_statistics_match_lerobots_for_every_length(length):
    from lerobot.datasets.compute_stats import compute_episode_stats

    rng = np.random.default_rng(length)
    columns = {
        "action": rng.normal(size=(length, 7)).astype(np.float32),
        "constant": np.full((length, 2), 3.0, np.float32),
        "calvin.frame": np.arange(length) + 70,
    }
    features = {key: {"dtype": str(column.dtype)} for key, column in columns.items()}
    expected, ours = compute_episode_stats(columns, features), EpisodeStats()
    for start in range(0, length, 20):
        ours.add({key: column[start : start + 20] for key, column in columns.items()})
    stats = ours.result()
    for key, of_key in expected.items():
        for name, value in of_key.items():
            assert stats[key][name].shape == value.shape
            atol = 2e-3 * np.ptp(columns[key]) + 1e-6
            np.testing.assert_allclose(stats[key][name], value, rtol=1e-5, atol=atol, err_msg=f"{key} {name}")


def test_lerobots_tools_work_on_the_result(both, tmp_path):
    from lerobot.datasets.aggregate import aggregate_datasets
    from lerobot.datasets.dataset_tools import delete_episodes
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    ours, _, source = both
    fewer = delete_episodes(ours, [0, 2], output_dir=tmp_path / "fewer", repo_id="me/fewer")
    frames = [frame for start, end, *_ in (source.windows[1], source.windows[3]) for frame in range(start, end)]
    assert [item["calvin.frame"].item() for item in fewer] == frames
    kept = np.stack([without_jumps(source.frames[frame]["robot_obs"]) for frame in frames])
    np.testing.assert_allclose(fewer.meta.stats["observation.state"]["mean"], kept.mean(axis=0), atol=1e-5)

    aggregate_datasets(["me/a", "me/b"], "me/ab", roots=[ours.root, ours.root], aggr_root=tmp_path / "ab")
    merged = LeRobotDataset("me/ab", root=tmp_path / "ab")
    assert (merged.num_episodes, merged.num_frames) == (8, 80)
    assert merged[45]["calvin.frame"] == ours[5]["calvin.frame"]
    for key in set(merged[45]) & set(CAMERA_OF):
        np.testing.assert_allclose(merged[45][key], ours[5][key], atol=0.01)


def test_action_chunks_of_other_policies_stop_at_the_window_end(both):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    ours, _, _ = both
    dataset = LeRobotDataset("me/desk", root=ours.root, delta_timestamps={"action": [i / 30 for i in range(4)]})
    assert dataset[8]["action_is_pad"].tolist() == [False, False, True, True]
    np.testing.assert_array_equal(dataset[8]["action"][1], ours[9]["action"])


def needs(module, package):
    return pytest.mark.skipif(
        importlib.util.find_spec(module) is None, reason=f"not installed: pip install '{package}'"
    )


@needs("lerobot_doctor", "lerobot-doctor")
def test_lerobot_doctor_finds_no_fault(both):
    command = "import sys; from lerobot_doctor.cli import main; sys.exit(main())"
    arguments = [str(both[0].root), "--ci"]
    done = subprocess.run([sys.executable, "-c", command, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 fail" in done.stderr


@needs("rerun", "lerobot[viz]")
def test_lerobot_dataset_viz_draws_an_episode(both, tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "lerobot.scripts.lerobot_dataset_viz",
            "--repo-id=me/desk",
            f"--root={both[0].root}",
            "--episode-index=1",
            "--num-workers=0",
            "--save=1",
            f"--output-dir={tmp_path}",
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    drawn = (tmp_path / "me_desk_episode_1.rrd").read_bytes()
    for key in ("action", "state", *set(both[0].meta.camera_keys)):
        assert key.encode() in drawn, key
