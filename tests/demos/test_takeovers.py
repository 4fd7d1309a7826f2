"""Takeovers: a policy acts, the demonstrator takes over; recorded, converted, merged with other recordings, learned."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_lansar.calvin import relative_action
from lerobot_lansar.command import CommandError
from lerobot_lansar.demos.record import divide_options, record
from lerobot_lansar.demos.record_config import RecordConfig, TakeoverEnv, TakeoverPolicy
from lerobot_lansar.demos.stuck import LOOSE_FRAMES, STILL_FRAMES, Watch, usual_frames
from lerobot_lansar.desk import Desk, DeskError

MINUTE = 1 / 60  # hours
SIZES = {"observation.state": 15, "observation.environment_state": 24, "action": 7}


def save(policy, folder):
    """Saves a policy and its processors as LeRobot does in a checkpoint."""
    from lerobot.policies.factory import make_pre_post_processors

    policy.save_pretrained(folder)
    stats = {key: {"mean": torch.zeros(size), "std": torch.ones(size)} for key, size in SIZES.items()}
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def lansar(tmp_path_factory):
    """The folder of a random LanSAR, whose absolute actions keep the hand about where it is."""
    from lerobot.configs.types import FeatureType, PolicyFeature

    from lerobot_lansar.clip.config import ClipConfig
    from lerobot_lansar.policy.configuration_lansar import LanSARConfig
    from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

    torch.manual_seed(0)
    kinds = FeatureType.STATE, FeatureType.ENV, FeatureType.ACTION
    features = {key: PolicyFeature(kind, (SIZES[key],)) for key, kind in zip(SIZES, kinds, strict=True)}
    config = LanSARConfig(
        device="cpu",
        push_to_hub=False,
        hidden=96,
        context_layers=1,
        decoder_layers=1,
        feedforward=96,
        use_images=False,
        control_mode="abs",
        clip=ClipConfig("lansar-desk", ""),
        input_features={key: features[key] for key in list(SIZES)[:2]},
        output_features={"action": features["action"]},
    )
    policy = LanSARPolicy(config).eval()
    policy.scaler.delta_std.fill_(0.003)
    return save(policy, tmp_path_factory.mktemp("lansar") / "pretrained_model")


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    """The folder of a random ACT, whose relative actions move the arm."""
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config

    torch.manual_seed(0)
    config = make_policy_config(
        "act",
        device="cpu",
        push_to_hub=False,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (15,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (24 + 34,)),
            "observation.images.static": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping=dict.fromkeys(("STATE", "ENV", "VISUAL", "ACTION"), NormalizationMode.IDENTITY),
        dim_model=16,
        n_heads=2,
        dim_feedforward=16,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        chunk_size=8,
        n_action_steps=6,
        pretrained_backbone_weights=None,
    )
    return save(get_policy_class("act")(config).eval(), tmp_path_factory.mktemp("act") / "pretrained_model")


def options(output_dir, checkpoint, **changes):
    defaults = {
        "output_dir": output_dir,
        "mode": "takeovers",
        "policy": TakeoverPolicy(str(checkpoint)),
        "env": TakeoverEnv(control_mode="abs"),
        "hours": 0.75 * MINUTE,
        "validation_hours": 0.15 * MINUTE,
        "session_minutes": 0.25,
        "patience": 0.3,
        "batch_size": 2,
        "cameras": [],
        "seed": 3,
    }
    return RecordConfig(**(defaults | changes))


def frames(folder):
    return [dict(np.load(file)) for file in sorted(folder.glob("episode_*.npz"))]


def content(folder):
    """Every array of a recording's frames, and every other file, as bytes; npz files have a time in them."""
    files = {file.relative_to(folder): file for file in sorted(folder.rglob("*")) if file.is_file()}
    return {
        name: [(key, value.tobytes()) for key, value in np.load(file).items()]
        if file.suffix == ".npz"
        else file.read_bytes()
        for name, file in files.items()
    }


@pytest.fixture(scope="module")
def recording(tmp_path_factory, lansar):
    return record(options(tmp_path_factory.mktemp("takeovers") / "desk", lansar))


def language(split):
    return np.load(split / "lang_annotations" / "auto_lang_ann.npy", allow_pickle=True).item()


def test_the_policy_acts_first_and_the_demonstrator_finishes(recording):
    every = frames(recording / "training")
    assert {key: value.shape for key, value in every[0].items()} == {
        "robot_obs": (15,),
        "scene_obs": (24,),
        "actions": (7,),
        "rel_actions": (7,),
        "is_intervention": (1,),
    }
    for frame in every:
        np.testing.assert_allclose(frame["rel_actions"], relative_action(frame["actions"], frame["robot_obs"]))
    acted = np.array([frame["is_intervention"][0] for frame in every])
    assert acted.dtype == bool
    described = language(recording / "training")
    windows = list(zip(described["info"]["indx"], described["language"]["task"], strict=True))
    assert windows
    for (start, end), task in windows:
        policys = end - start - acted[start:end].sum()
        assert 0 < policys <= np.ceil(0.3 * usual_frames(task))
        assert acted[start + policys : end].all()  # once the demonstrator has taken over, it finishes


def test_workers_batches_and_kills_change_nothing(recording, lansar, tmp_path):
    target = tmp_path / "killed"
    arguments = [f"--output_dir={target}", "--mode=takeovers", f"--policy.path={lansar}", "--env.control_mode=abs"]
    arguments += [f"--hours={0.75 * MINUTE}", f"--validation_hours={0.15 * MINUTE}", "--session_minutes=0.25"]
    arguments += ["--patience=0.3", "--batch_size=1", "--workers=2", "--cameras=[]", "--seed=3"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lerobot_lansar.demos.record", *arguments],
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.time() + 120
    while not list((target / ".recording").glob("0*.json")) and time.time() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert 1 <= len(list((target / ".recording").glob("0*.json"))) < 4
    with pytest.raises(ValueError, match="begun with other options"):
        record(options(target, lansar, policy=TakeoverPolicy(str(lansar), ["position_scale_start=1.5"])))
    assert content(record(options(target, lansar))) == content(recording)


def test_another_checkpoint_is_another_request_and_the_same_elsewhere_is_not(lansar, tmp_path):
    from safetensors.torch import load_file, save_file

    from lerobot_lansar.demos.takeovers import prepare

    copy, other = tmp_path / "copy", tmp_path / "other"
    for folder in (copy, other):
        folder.mkdir()
        for file in lansar.iterdir():
            (folder / file.name).write_bytes(file.read_bytes())
    weights = load_file(other / "model.safetensors")
    next(iter(weights.values())).add_(1)
    save_file(weights, other / "model.safetensors")
    request = [prepare(options(tmp_path, folder)).request() for folder in (lansar, copy, other)]
    assert request[0] == request[1] != request[2]


def test_other_policies_act_too_with_pictures_and_tasks_in_the_state(act, tmp_path):
    env = TakeoverEnv(control_mode="rel", task_in_state=True)
    shown = {"cameras": ["static"], "image_size": 64, "env": env, "hours": 0.4 * MINUTE, "session_minutes": 0.2}
    shown |= {"validation_hours": 0.1 * MINUTE}
    shown |= {"policy": TakeoverPolicy(str(act), ["n_action_steps=3"])}
    one = record(options(tmp_path / "one", act, **shown))
    two = record(options(tmp_path / "two", act, **shown, workers=2, batch_size=1))
    every = frames(one / "training")
    assert every[0]["rgb_static"].shape == (64, 64, 3)
    policys = [frame for frame in every if not frame["is_intervention"][0]]
    assert len(policys) > 50
    assert content(one) == content(two)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy": TakeoverPolicy()}, "--policy.path=FOLDER"),
        ({"mode": "chains"}, "--policy goes with --mode=takeovers, not --mode=chains"),
        ({"patience": 0.0}, "--patience lies between"),
        ({"batch_size": 0}, "--batch_size must be"),
        ({"env": TakeoverEnv(control_mode="velocity")}, "--env.control_mode is rel or abs"),
    ],
)
def test_impossible_options_are_refused(lansar, tmp_path, changes, message):
    with pytest.raises(DeskError, match=message):
        record(options(tmp_path / "desk", lansar, **changes))


def test_a_policy_that_needs_something_else_is_refused_with_the_option_to_set(act, tmp_path):
    env = TakeoverEnv(task_in_state=True)
    for changes, message in (
        ({"env": env}, r"--cameras='\[static\]'"),
        ({"env": env, "cameras": ["static"]}, "set --image_size=64"),
        ({"cameras": ["static"], "image_size": 64}, "set --env.task_in_state=true"),
        ({"env": replace(env, scene_state=False)}, "set --env.scene_state=true"),
    ):
        with pytest.raises(CommandError, match=message):
            record(options(tmp_path / "desk", act, **changes))
    with pytest.raises(CommandError, match=r"holds no config\.json"):
        record(options(tmp_path / "desk", tmp_path))


def test_options_of_the_policy_are_told_from_the_commands():
    given = ["--policy.path=a", "--policy.device", "cpu", "--seed=1", "--policy.n_action_steps=5"]
    assert divide_options(given) == (["--policy.path=a", "--seed=1"], ["device=cpu", "n_action_steps=5"])


def test_a_policy_is_stuck_when_it_is_late_still_loses_a_block_or_does_something_else():
    with Desk("D", cameras=()) as desk:
        obs = desk.reset()
        start = desk.snapshot()

    def first(task, snapshots, patience=10.0, moving=True, begun=start):
        watch, seen = Watch(task, begun, patience), {**obs, "robot_obs": obs["robot_obs"].copy()}
        for number, now in enumerate(snapshots, 1):
            seen["robot_obs"] = seen["robot_obs"] + (0.01 if moving else 0.0)
            if watch.is_stuck(seen, now):
                return number
        return None

    def red(**changes):
        return replace(start, blocks={**start.blocks, "red": replace(start.blocks["red"], **changes)})

    held = red(contacts=frozenset({("robot", 9)}))
    assert first("turn_on_led", [start] * 300, patience=1.5) == np.ceil(1.5 * usual_frames("turn_on_led"))
    assert first("turn_on_led", [start] * 300, moving=False) == STILL_FRAMES + 1
    assert first("stack_block", [held] * 20 + [start] * 100) == 20 + LOOSE_FRAMES
    assert first("stack_block", [held] * 100) is None
    for task in ("stack_block", "lift_red_block_table"):
        assert first(task, [held] * 20 + [start] * 100, begun=held) == 20 + LOOSE_FRAMES
    assert first("turn_on_led", [held] * 20 + [start] * 100, begun=held) is None, "it has to put the block down"
    opened = replace(start, drawer=start.drawer + 0.2)
    assert first("turn_on_led", [start] * 7 + [opened]) == 8
    assert first("open_drawer", [opened] * 50) is None


@pytest.mark.slow
def test_a_policy_is_fine_tuned_on_its_takeovers_and_other_chains(recording, lansar, tmp_path):
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_LEROBOT_HOME": str(tmp_path), "OMP_NUM_THREADS": "1"}

    def run(name, *arguments):
        command = [Path(sys.executable).parent / name, *arguments]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr[-3000:]

    plain = {"patience": RecordConfig.patience, "batch_size": RecordConfig.batch_size}
    record(options(tmp_path / "chains", None, mode="chains", policy=TakeoverPolicy(), env=TakeoverEnv(), **plain))
    for name, root in (("takeovers", recording), ("chains", tmp_path / "chains")):
        told = ["--is_intervention=true"] if name == "chains" else []
        run("lansar-convert", f"--root={root}", "--split=training", f"--repo_id=me/{name}", "--images=none", *told)
    repositories = "--operation.repo_ids=['me/chains','me/takeovers']"
    run("lerobot-edit-dataset", "--operation.type=merge", "--new_repo_id=me/both", repositories)
    run(
        "lerobot-train",
        f"--policy.path={lansar}",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=me/both",
        "--batch_size=4",
        "--steps=2",
        "--num_workers=0",
        "--log_freq=1",
        "--output_dir=tuned",
    )

    from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata

    from lerobot_lansar.policy.modeling_lansar import LanSARPolicy
    from lerobot_lansar.policy.windows import get_current

    meta = LeRobotDatasetMetadata("me/both", root=tmp_path / "me/both")
    tuned = LanSARPolicy.from_pretrained(tmp_path / "tuned/checkpoints/last/pretrained_model")
    LanSARPolicy(tuned.config, dataset_meta=meta)
    acted = [frame["is_intervention"][0] for frame in frames(recording / "training")]
    policys = get_current().counts == 0
    assert 0 < policys.sum() <= len(acted) - sum(acted)
    before = LanSARPolicy.from_pretrained(lansar)
    for name, value in before.scaler.state_dict().items():
        assert torch.equal(tuned.scaler.state_dict()[name], value), "a fine-tuned policy keeps its scaling"
    changed = [
        n for n, value in before.network.state_dict().items() if not torch.equal(value, tuned.network.state_dict()[n])
    ]
    assert "motion_head.0.weight" in changed
