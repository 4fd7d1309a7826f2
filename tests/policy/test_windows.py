"""Frames, targets and windows against plain references."""

import json
import math
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from lerobot_lansar.calvin import wrap_angle
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import Clip
from lerobot_lansar.clip.store import dataset_fingerprint
from lerobot_lansar.policy import frames as frames_module
from lerobot_lansar.policy import make_lansar_pre_post_processors
from lerobot_lansar.policy.frames import CACHE, load_frames
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
from lerobot_lansar.policy.scaling import INPUT_FLOOR, Scaler
from lerobot_lansar.policy.windows import Windows, action_form

from .conftest import LENGTHS, add_embeddings, dataset_meta, make_dataset, small_config

STARTS = np.cumsum((0, *LENGTHS))[:-1]


def make_windows(root, **options):
    meta = dataset_meta(root)
    return Windows(meta.root, meta.features, meta.total_frames, small_config(**options))


def episode_of(index):
    """(episode, frame within it) of an absolute frame number."""
    episode = int(np.searchsorted(STARTS, index, side="right") - 1)
    return episode, index - STARTS[episode]


def reference_target(episode, form, target, t):
    """One frame's target with plain Python."""
    state, action = episode["state"].astype(float), episode[form].astype(float)
    if target == "achieved":
        delta = [float(b - a) for a, b in zip(state[t, :6], state[t + 1, :6], strict=True)]
    elif form == "rel":
        delta = [*(action[t, :3] * 0.02), *(action[t, 3:6] * 0.05)]
    else:
        delta = list(action[t, :6] - state[t, :6])
    for i in (3, 4, 5):
        while delta[i] > math.pi:
            delta[i] -= 2 * math.pi
        while delta[i] <= -math.pi:
            delta[i] += 2 * math.pi
    return [*delta, 1.0 if action[t, 6] > 0 else 0.0]


@pytest.mark.parametrize(("form", "target"), [("rel", "commanded"), ("abs", "commanded"), ("rel", "achieved")])
def test_a_batch_of_windows_is_what_a_plain_loop_gives(form, target, relative, absolute):
    root, episodes = relative if form == "rel" else absolute
    windows = make_windows(root, target=target, window_start="anywhere")
    index = np.array([0, 19, 25, 109, 110, 182, 119])
    batch = windows.batch(index)
    for row, i in enumerate(index):
        number, t = episode_of(i)
        episode = episodes[number]
        usable = LENGTHS[number] - (target == "achieved")
        t = min(t, usable - 1)
        length = min(64, usable - t)
        width = batch["state"].shape[1]
        mine = batch["valid_steps"][batch["valid_steps"] // width == row]
        assert mine.tolist() == list(range(row * width, row * width + length))
        steps = slice(t, t + length)
        np.testing.assert_array_equal(batch["state"][row, :length], episode["state"][steps])
        np.testing.assert_array_equal(batch["environment_state"][row, :length], episode["environment"][steps])
        expected = [reference_target(episode, form, target, s) for s in range(t, t + length)]
        np.testing.assert_allclose(batch["target"][row, :length], expected, atol=2e-6)
    assert batch["state"].shape[1] == 64
    short = [182]  # its window ends with the demonstration
    compiled = make_windows(root, target=target, window_start="anywhere", compile_model=True)
    widths = [each.batch(np.array(short))["state"].shape[1] for each in (windows, compiled)]
    assert widths[0] < widths[1] == 64  # compiled code wants one shape


def test_arrays_that_lie_on_a_gpu_give_the_same_windows(tmp_path, monkeypatch):
    """Without a GPU: the same lookups in tensors on the CPU."""
    make_dataset(tmp_path / "data")
    add_embeddings(tmp_path / "data", Clip(ClipConfig("lansar-desk", ""), "cpu"))
    windows = make_windows(tmp_path / "data", use_images=True)
    index = np.array([3, 60, 150])
    expected = windows.batch(index)
    size = sum(array.nbytes for array in (*windows.arrays.values(), *windows.embeddings.values()))
    tensor = torch.tensor
    monkeypatch.setattr(torch, "tensor", lambda array, device=None: tensor(array))
    windows.device = torch.device("cuda")
    for free in (2 * size - 1, 2 * size):  # they may take half of it
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=free: (free, free))
        windows.on_gpu = windows._move_to_gpu(windows.arrays, windows.embeddings)
        assert windows.on_gpu == (free == 2 * size)
        assert all(isinstance(array, torch.Tensor) == windows.on_gpu for array in windows.arrays.values())
    monkeypatch.undo()
    windows.device = torch.device("cpu")
    found = windows.batch(index)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert value.dtype == found[name].dtype
        assert torch.equal(found[name], value)


def test_pictures_of_a_batch_are_those_of_its_steps_without_padding(relative):
    windows = make_windows(relative[0])
    numbers = np.arange(len(windows.targets), dtype=np.uint8)  # a picture's only pixel is its frame's number
    windows.pictures = {"static": np.broadcast_to(numbers[:, None, None, None], (len(numbers), 1, 1, 3))}
    batch = windows.batch(np.array([150, 3, 60]))
    shown = batch["static"][:, 0, 0, 0].numpy()
    assert batch["static"].dtype == torch.uint8
    assert len(shown) == len(batch["valid_steps"]) < batch["state"].shape[0] * batch["state"].shape[1]
    expected = windows.frames["state"][shown]
    np.testing.assert_array_equal(batch["state"].flatten(0, 1)[batch["valid_steps"]].numpy(), expected)


def test_relative_and_absolute_actions_teach_the_same(relative, absolute):
    np.testing.assert_allclose(make_windows(relative[0]).targets, make_windows(absolute[0]).targets, atol=2e-6)
    assert np.abs(make_windows(absolute[0]).targets[:, 3:6]).max() < 0.05  # the roll crosses pi, its change does not


@pytest.mark.parametrize("target", ["commanded", "achieved"])
def test_windows_of_a_demonstration_start_where_the_rule_says(relative, target):
    lacking = int(target == "achieved")  # the last frame belongs to no window then
    index = np.arange(sum(LENGTHS))
    starts = {}
    for rule in ("episode", "anywhere", "mixed"):
        start, end = make_windows(relative[0], window_start=rule, target=target).bounds(index)
        assert (end - start).max() == 64
        assert (end - start).min() > 0
        starts[rule] = start
        for number, first in enumerate(STARTS):  # never across a demonstration's bounds
            rows = slice(first, first + LENGTHS[number])
            assert start[rows].min() == first
            assert end[rows].max() == first + LENGTHS[number] - lacking
        if rule == "episode":
            assert set(end - start) == {min(length - lacking, 64) for length in LENGTHS}
    short, long = slice(STARTS[0], STARTS[1]), slice(STARTS[1], STARTS[2])
    assert (starts["episode"][short] == STARTS[0]).all()
    offsets, counts = np.unique(starts["episode"][long] - STARTS[1], return_counts=True)
    assert offsets.tolist() == list(range(90 - lacking - 64 + 1))  # first and last 64 steps included
    assert counts.max() - counts.min() <= 1 + lacking, "every start equally often"
    lasts = np.array(STARTS) + LENGTHS - 1
    assert (starts["anywhere"] == index - lacking * np.isin(index, lasts)).all()
    even = index % 2 == 0
    assert (starts["mixed"][even] == starts["episode"][even]).all()
    assert (starts["mixed"][~even] == starts["anywhere"][~even]).all()


def test_frame_arrays_are_kept_and_made_again_when_the_data_changes(tmp_path, monkeypatch):
    make_dataset(tmp_path / "a", lengths=(5, 7))
    make_dataset(tmp_path / "b", lengths=(5, 7), seed=9)
    first = load_frames(tmp_path / "a")
    assert isinstance(first["state"], np.memmap)
    assert (tmp_path / "a" / CACHE).is_dir()
    with monkeypatch.context() as patch:
        patch.setattr(frames_module, "read_frames", lambda root: pytest.fail("read the parquet files again"))
        np.testing.assert_array_equal(load_frames(tmp_path / "a")["state"], first["state"])
    assert dataset_fingerprint(tmp_path / "a") != dataset_fingerprint(tmp_path / "b")
    shutil.copytree(tmp_path / "a", tmp_path / "moved")
    assert dataset_fingerprint(tmp_path / "a") == dataset_fingerprint(tmp_path / "moved")
    shutil.rmtree(tmp_path / "a" / "data")
    shutil.copytree(tmp_path / "b" / "data", tmp_path / "a" / "data")
    np.testing.assert_array_equal(load_frames(tmp_path / "a")["state"], load_frames(tmp_path / "b")["state"])
    assert {p.name for p in (tmp_path / "a").iterdir()} == {
        "data",
        "meta",
        ".cache",
    }  # nothing half-written left


@pytest.mark.parametrize("width", [None, 34])
def test_without_the_scenes_state_windows_have_none(tmp_path, width):
    make_dataset(tmp_path / "data", lengths=(9, 12))
    for file in (tmp_path / "data/data").rglob("*.parquet"):
        table = pq.read_table(file)
        place = table.column_names.index("observation.environment_state")
        table = table.drop_columns("observation.environment_state")
        if width:
            told = pa.array([[1.0] * width] * len(table), pa.list_(pa.float32(), width))
            table = table.add_column(place, "observation.environment_state", told)
        pq.write_table(table, file)
    info = tmp_path / "data/meta/info.json"
    told = json.loads(info.read_text())
    del told["features"]["observation.environment_state"]
    info.write_text(json.dumps(told))
    for _ in range(2):  # from the files, from the cache
        assert "environment_state" not in load_frames(tmp_path / "data")
    with pytest.raises(ValueError, match=r"lacks the scene's state.* 24 numbers.*--policy\.use_spatial_context=false"):
        make_windows(tmp_path / "data")
    config = small_config(use_images=True, use_spatial_context=False)
    add_embeddings(tmp_path / "data", Clip(config.clip))
    policy = LanSARPolicy(config, dataset_meta=dataset_meta(tmp_path / "data"))
    batch = make_lansar_pre_post_processors(config)[0](
        {
            "index": torch.tensor([0, 4]),
            "task": ["open the drawer"] * 2,
            "observation.environment_state": torch.zeros(2, 24),
        }
    )
    assert "observation.environment_state" not in batch, "a single frame's"
    policy.forward(batch)[0].backward()
    one = {"observation.state": torch.zeros(1, 15), "task": ["go"]}
    one |= {
        f"observation.clip.{name}": torch.zeros(1, config.network.clip_dim) for name in ("command", "static", "gripper")
    }
    assert policy.select_action(one).isfinite().all()
    seeing = LanSARPolicy(small_config())
    with pytest.raises(ValueError, match=r"set --env\.scene_state=true"):
        seeing.select_action(one)


def test_a_folder_that_cannot_be_written_to_is_read_into_memory(tmp_path, monkeypatch, relative):
    shutil.copytree(relative[0], tmp_path / "d", ignore=shutil.ignore_patterns(".cache"))

    def refuse(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.mkdir", refuse)
    frames = load_frames(tmp_path / "d")
    assert len(frames["state"]) == sum(LENGTHS)
    assert not (tmp_path / "d" / ".cache").exists()


def test_nan_in_a_dataset_is_named(tmp_path, monkeypatch):
    episodes = make_dataset(tmp_path / "d", lengths=(6,))
    assert len(episodes) == 1
    path = frames_module.data_files(tmp_path / "d")[0]
    table = pq.read_table(path)
    values = table["action"].to_pylist()
    values[3][2] = float("nan")
    column = table.schema.get_field_index("action")
    pq.write_table(table.set_column(column, "action", pa.array(values, table["action"].type)), path)
    with pytest.raises(ValueError, match=r"action is NaN or infinite in episode 0 \(index 3\)"):
        load_frames(tmp_path / "d")


def test_uninterrupted_play_is_refused(tmp_path):
    make_dataset(tmp_path / "data", lengths=(6, 9))
    (path,) = frames_module.data_files(tmp_path / "data")
    table = pq.read_table(path)
    task = np.append(table["task_index"].to_numpy()[:-1], 0)  # the last frame is of the first episode's command
    column = table.schema.get_field_index("task_index")
    pq.write_table(table.set_column(column, "task_index", pa.array(task)), path)
    with pytest.raises(ValueError, match=r"within episode 1 \(index 14\).*--mode=windows"):
        load_frames(tmp_path / "data")


def test_actions_without_calvins_names_are_refused(relative):
    features = dataset_meta(relative[0]).features
    assert action_form(features) == "rel"
    with pytest.raises(ValueError, match="relative"):
        action_form({**features, "action": {"names": ["motor_0"]}})
    with pytest.raises(ValueError, match="relative"):
        action_form({})


def test_pictures_need_embeddings_of_this_dataset(tmp_path, relative):
    root = tmp_path / "d"
    shutil.copytree(relative[0], root)
    with pytest.raises(FileNotFoundError, match=r"lansar-convert --embed=true"):
        make_windows(root, use_images=True)
    clip = Clip(ClipConfig("lansar-desk", ""))
    static = add_embeddings(root, clip)
    batch = make_windows(root, use_images=True, window_start="anywhere").batch(np.array([21, 30]))
    np.testing.assert_array_equal(batch["static"][0], static[21:85].astype(np.float32))
    with pytest.raises(ValueError, match=r"--policy.clip.model"):
        make_windows(root, use_images=True, clip=ClipConfig("ViT-B-32", "openai"))
    info = json.loads((root / "clip" / "clip.json").read_text())
    (root / "clip" / "clip.json").write_text(json.dumps({**info, "fingerprint": "0" * 64}))
    with pytest.raises(ValueError, match="other frames"):
        make_windows(root, use_images=True)


def test_an_unknown_frame_number_is_an_error(relative):
    with pytest.raises(IndexError):
        make_windows(relative[0]).batch(np.array([sum(LENGTHS)]))


def test_scaled_inputs_have_mean_0_and_sigma_1_and_binary_values_stay(relative):
    windows = make_windows(relative[0])
    state = torch.tensor(windows.frames["state"])
    environment = torch.tensor(windows.frames["environment_state"])
    environment[:, 2] = 1e-5 * torch.randn(len(environment))  # a button nobody pressed
    for orientation in ("euler", "sincos"):
        scaler = Scaler(orientation, egocentric_blocks=False)
        scaler.fit(state, environment, torch.tensor(windows.targets[:, :6]))
        x, blocks, scene = scaler.encode(state, environment)
        torch.testing.assert_close(x[:, :3].mean(0), torch.zeros(3), atol=1e-3, rtol=0)
        torch.testing.assert_close(x[:, :3].std(0), torch.ones(3), atol=1e-2, rtol=0)
        assert blocks.shape[1:] == (3, 9 if orientation == "sincos" else 6)
        torch.testing.assert_close(x[:, -1], state[:, 14], rtol=0, atol=0)
        torch.testing.assert_close(scene[:, 4:], environment[:, 4:6], rtol=0, atol=0)
        assert scene[:, 2].abs().max() < 1e-4 / INPUT_FLOOR
        delta = torch.tensor(windows.targets[:, :6])
        torch.testing.assert_close(scaler.unscale_delta(scaler.scale_delta(delta)), delta, atol=1e-6, rtol=1e-5)


def test_sine_and_cosine_do_not_jump_where_euler_angles_do():
    near_pi = torch.zeros(2, 15)
    near_pi[:, 3] = torch.tensor([math.pi - 1e-3, -math.pi + 1e-3])
    environment = torch.zeros(2, 24)
    jump = {}
    for orientation in ("euler", "sincos"):
        x = Scaler(orientation, egocentric_blocks=False).encode(near_pi, environment)[0]
        jump[orientation] = float((x[0] - x[1]).abs().max())
    assert jump["euler"] > 6
    assert jump["sincos"] < 0.01


def test_wrapping_goes_to_minus_pi_exclusive_pi_inclusive():
    angles = torch.tensor([0.0, 3.5, -3.5, 7.0], dtype=torch.float64)
    expected = torch.tensor([0.0, 3.5 - 2 * math.pi, 2 * math.pi - 3.5, 7 - 2 * math.pi], dtype=torch.float64)
    torch.testing.assert_close(wrap_angle(angles), expected)
    assert wrap_angle(torch.tensor(math.pi, dtype=torch.float64)) == -math.pi


def test_a_paraphrase_means_the_same_tasks(tmp_path):
    plain, root = tmp_path / "plain", tmp_path / "data"
    make_dataset(plain)
    with pytest.raises(ValueError, match=r"has no column calvin\.task"):
        make_windows(plain, paraphrases=True)
    opening = ["open the drawer", "pull the drawer", "lift it"]
    lifting = ["lift the red block", "lift it"]
    shown = [(14, said) for said in opening] + [(16, said) for said in lifting] + [(-1, "play")]
    make_dataset(root, lengths=(5,) * len(shown), shown=tuple(shown))
    windows = make_windows(root, paraphrases=True)
    assert windows.command_tasks(["lift it"]) is None
    torch.manual_seed(0)
    said = windows.paraphrase(["open the drawer"] * 50 + ["lift the red block"] * 50 + ["lift it"] * 5)
    assert set(said[:50]) == set(opening)
    assert set(said[50:100]) == set(lifting)
    assert set(said[100:]) == {"lift it"}  # means two tasks: only sentences that mean both
    assert make_windows(root).paraphrase(["anything"]) == ["anything"]
    windows = make_windows(root, contrastive_weight=0.1)
    together = windows.command_tasks(["pull the drawer", "lift it", "lift the red block", "play"])
    shares_a_task = together @ together.T > 0
    assert shares_a_task.tolist() == [[1, 1, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
