"""Pictures in a dataset: their size, their look, their colours, and where the cameras are."""

import json

import numpy as np
import pytest
import yaml
from fake_calvin import write_calvin

from dataset_convert.convert import convert
from dataset_convert.layout import RGBEncoder
from dataset_convert.look import Look, read_look
from dataset_convert.options import ConvertConfig
from dataset_convert.verify import Mismatch, VerifyConfig, verify
from dataset_convert.verify_cameras import camera_intrinsics, gripper_poses, static_pose
from lerobot_lansar.cameras import gripper_camera_pose, intrinsics, static_camera_pose
from lerobot_lansar.pictures import resize

CAMERAS = {"static": 200, "gripper": 84}


def options(calvin, output_dir, **changes):
    return ConvertConfig(calvin.root, "me/desk", output_dir, **{"images": "png", **changes})


def load(folder):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("me/desk", root=folder, depth_output_unit="m")


def manifest_of(folder):
    return json.loads((folder / "meta/calvin_source.json").read_text())


def paint(calvin, size=None):
    """Gives every picture other noise; `size`: of both cameras."""
    rng = np.random.default_rng(0)
    for frame, content in calvin.frames.items():
        for camera, own in CAMERAS.items():
            n = size or own
            content[f"rgb_{camera}"] = rng.integers(0, 255, (n, n, 3), np.uint8)
            content[f"depth_{camera}"] = rng.uniform(1, 4, (n, n)).astype(np.float32)
        calvin.rewrite(frame)


def say(folder, **config):
    (folder / ".hydra").mkdir()
    (folder / ".hydra/merged_config.yaml").write_text(yaml.safe_dump(config))


@pytest.fixture
def painted(tmp_path):
    calvin = write_calvin(tmp_path / "calvin", rgb=True, depth=True, tasks=("open_drawer",), length=4)
    paint(calvin)
    return calvin


# ---- size


def test_pictures_and_depth_of_another_size_are_those_of_the_environment(painted, tmp_path):
    out = convert(options(painted, tmp_path / "out", image_size=96, depth=True))
    dataset = load(out)
    for index, content in enumerate(painted.frames.values()):
        item = dataset[index]
        for camera in CAMERAS:
            wanted = resize(content[f"rgb_{camera}"], 96).transpose(2, 0, 1) / np.float32(255)
            np.testing.assert_array_equal(item[f"observation.images.{camera}"], wanted)
            depth = item[f"observation.images.{camera}_depth"]
            np.testing.assert_array_equal(depth[0], resize(content[f"depth_{camera}"], 96))
    manifest = manifest_of(out)
    assert (manifest["request"]["image_size"], manifest["look"]["image_size"]) == (96, 96)
    assert manifest["cameras"]["static"]["size"] == 96
    assert "both cameras brought to 96 pixels" in (out / "README.md").read_text()
    assert "pixel by pixel" in verify(VerifyConfig("me/desk", painted.root, out))
    manifest["look"]["image_size"] = 0
    (out / "meta/calvin_source.json").write_text(json.dumps(manifest))
    with pytest.raises(Mismatch, match="look are not what"):
        verify(VerifyConfig("me/desk", painted.root, out))


def test_a_recording_of_another_size_keeps_it_and_is_not_resized_again(painted, tmp_path):
    paint(painted, 64)
    with pytest.raises(ValueError, match=r"'rgb_static' is uint8 \(64, 64, 3\), expected uint8 \(200, 200, 3\)"):
        convert(options(painted, tmp_path / "out"))
    say(painted.folder, renderer="tiny", assets_used="built-in", image_size=64)
    out = convert(options(painted, tmp_path / "out", depth=True, images="video", task_in_state=True))
    assert manifest_of(out)["look"] == {"renderer": "tiny", "assets": "built-in", "image_size": 64}
    assert load(out).meta.features["observation.images.gripper"]["shape"] == (64, 64, 3)
    assert "--env.image_size=64" in (out / "README.md").read_text()
    with pytest.raises(ValueError, match=r"--image_size=96: .* was recorded with --image_size=64"):
        convert(options(painted, tmp_path / "again", image_size=96))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_size": 300}, "--image_size must be between 1 and 256"),
        ({"image_size": 8}, "--image_size=8: videos need 16 pixels or more"),
        (
            {"image_size": 85, "rgb_encoder": RGBEncoder(pix_fmt="yuv420p")},
            "--image_size=85: videos as yuv420p need",
        ),
        ({"rgb_encoder": RGBEncoder(pix_fmt="rgb3")}, "--rgb_encoder.pix_fmt=rgb3"),
    ],
)
def test_a_size_or_format_that_cannot_be_encoded_is_refused_at_once(painted, tmp_path, monkeypatch, changes, message):
    monkeypatch.setattr("dataset_convert.convert.run_shards", lambda *_, **__: pytest.fail("seen too late"))
    with pytest.raises(ValueError, match=message):
        convert(options(painted, tmp_path / "out", images="video", **changes))


def test_embeddings_are_those_of_pictures_of_the_datasets_size(painted, tmp_path):
    clip_module = pytest.importorskip("lerobot_lansar.clip.model")
    import torch

    from lerobot_lansar.clip.config import ClipConfig

    asked = {"embed": True, "clip": ClipConfig("lansar-desk", ""), "image_size": 32}
    out = convert(options(painted, tmp_path / "out", **asked))
    clip = clip_module.Clip(clip_module.ClipConfig("lansar-desk", ""))
    seen = torch.from_numpy(resize(painted.frames[101]["rgb_static"], 32))[None]
    stored = np.load(out / "clip/observation.images.static.npy")[1]
    np.testing.assert_allclose(stored, clip.encode_images(seen)[0].numpy(), atol=2e-3)


# ---- look


@pytest.mark.parametrize(
    ("config", "look"),
    [
        ({"renderer": "gl", "assets_used": "original", "image_size": 0}, Look("gl", "original", 0)),
        ({"renderer": "tiny", "assets_used": "built-in"}, Look("tiny", "built-in", 0)),
        (
            {"env": {"_target_": "calvin_env.envs.play_table_env.PlayTableSimEnv"}},
            Look("gl", "original", 0),
        ),
        ({"something": "else"}, Look(None, None, 0)),
        (None, Look(None, None, 0)),
    ],
    ids=["ours", "built-in", "calvin_env's", "somebody else's", "none"],
)
def test_the_look_is_read_from_the_recordings_configuration(tmp_path, config, look):
    if config is not None:
        say(tmp_path, **config)
    assert read_look(tmp_path) == look


def test_a_damaged_configuration_says_nothing(tmp_path):
    say(tmp_path)
    (tmp_path / ".hydra/merged_config.yaml").write_bytes(b"\xff{: [")
    assert read_look(tmp_path) == Look()


def test_the_card_states_the_look(painted, tmp_path):
    say(painted.folder, env={"_target_": "calvin_env"})
    card = (convert(options(painted, tmp_path / "out")) / "README.md").read_text()
    assert "renderer `gl`, original assets, as in CALVIN's public data." in card


# ---- cameras


def test_the_verifiers_camera_matrices_are_those_of_the_ground_floor():
    robot_obs = np.random.default_rng(0).normal(size=(50, 15))
    np.testing.assert_allclose(gripper_poses(robot_obs), gripper_camera_pose(robot_obs), atol=1e-12)
    np.testing.assert_allclose(static_pose(), static_camera_pose(), atol=1e-12)
    np.testing.assert_allclose(camera_intrinsics("gripper", 96), intrinsics("gripper", 96), atol=1e-12)


def test_a_dataset_says_where_its_cameras_are(painted, tmp_path):
    out = convert(options(painted, tmp_path / "out", image_size=96))
    cameras = manifest_of(out)["cameras"]
    assert "OpenCV" in cameras["convention"]
    np.testing.assert_allclose(cameras["static"]["intrinsics"], intrinsics("static", 96))
    np.testing.assert_allclose(cameras["static"]["pose"], static_camera_pose())
    assert cameras["gripper"]["pose"] == "calvin.gripper_camera_pose"
    dataset = load(out)
    assert not any("camera_pose." in key for key in dataset.meta.features)
    for item, content in zip(dataset, painted.frames.values(), strict=True):
        wanted = gripper_camera_pose(content["robot_obs"]).astype(np.float32)
        np.testing.assert_array_equal(item["calvin.gripper_camera_pose"].reshape(4, 4), wanted)
    manifest = manifest_of(out)
    manifest["cameras"]["static"]["pose"][0][3] += 0.01
    (out / "meta/calvin_source.json").write_text(json.dumps(manifest))
    with pytest.raises(Mismatch, match="cameras: static is"):
        verify(VerifyConfig("me/desk", painted.root, out))


def test_camera_poses_as_observations_have_the_environments_names(painted, tmp_path):
    from lerobot_lansar.envs.pictures import Pictures

    out = convert(options(painted, tmp_path / "out", image_size=96, camera_poses=True))
    seen = Pictures(tuple(CAMERAS), image_size=96, camera_poses=True).observe(painted.frames[102])
    item = load(out)[2]
    for key in (name for name in seen if name.startswith("camera_")):
        np.testing.assert_array_equal(item[f"observation.{key}"], seen[key])
    assert "pixel by pixel" in verify(VerifyConfig("me/desk", painted.root, out))


def test_one_camera_is_enough(painted, tmp_path):
    for frame, content in painted.frames.items():
        del content["rgb_gripper"], content["depth_gripper"]
        painted.rewrite(frame)
    out = convert(options(painted, tmp_path / "out", depth=True, camera_poses=True))
    features = load(out).meta.features
    pictures = {"observation.images.static", "observation.images.static_depth"}
    assert {key for key in features if key.startswith("observation.images.")} == pictures
    assert [key for key in features if key.startswith("observation.camera_pose.")] == ["observation.camera_pose.static"]
    assert set(manifest_of(out)["cameras"]) == {"convention", "static"}
    assert "pixel by pixel" in verify(VerifyConfig("me/desk", painted.root, out))
    with pytest.raises(ValueError, match="'rgb_gripper' is missing"):
        convert(options(painted, tmp_path / "embedded", embed=True))


def test_without_pictures_there_are_no_cameras(calvin, tmp_path):
    out = convert(options(calvin, tmp_path / "out", images="none"))
    assert manifest_of(out)["cameras"] == {}
    assert "calvin.gripper_camera_pose" not in load(out).meta.features


# ---- colours


@pytest.mark.parametrize(("vcodec", "pix_fmt"), [("h264", "yuv444p"), ("libsvtav1", "yuv420p")])
def test_videos_keep_each_pixels_colour_where_the_codec_can(painted, tmp_path, vcodec, pix_fmt):
    stripes = np.zeros((200, 200, 3), np.uint8)
    stripes[::2], stripes[1::2] = (200, 40, 40), (40, 40, 200)  # a red and a blue line in turn
    for frame in painted.frames:
        painted.rewrite(frame, rgb_static=stripes)
    encoder = RGBEncoder(vcodec=vcodec, preset="" if vcodec == "libsvtav1" else "veryfast")
    dataset = load(convert(options(painted, tmp_path / "out", images="video", rgb_encoder=encoder)))
    assert dataset.meta.features["observation.images.static"]["info"]["video.pix_fmt"] == pix_fmt
    error = np.abs(dataset[1]["observation.images.static"].numpy().transpose(1, 2, 0) * 255 - stripes).mean()
    assert (error < 4) == (pix_fmt == "yuv444p")
