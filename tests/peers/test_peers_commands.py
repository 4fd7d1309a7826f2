"""The peers under LeRobot's own commands: train, resume, fine-tune, evaluate."""

import json
import os
import subprocess
import sys

import pytest
from safetensors.torch import load_file

from .conftest import FORMS, SIZE, SMALL, make_dataset

# Several commands in one process: importing LeRobot takes 20 s; each builds everything anew.
RUN_IN_TURN = """
import importlib, json, sys
for module, arguments in json.loads(sys.argv[1]):
    sys.argv = [module, *arguments]
    importlib.import_module(module).main()
"""
TRAIN, EVAL = "lerobot.scripts.lerobot_train", "lerobot.scripts.lerobot_eval"

pytestmark = pytest.mark.slow


def run(commands, folder):
    environment = {**os.environ, "HF_HOME": str(folder / "hf"), "OMP_NUM_THREADS": "1", "ACCELERATE_USE_CPU": "1"}
    command = [sys.executable, "-c", RUN_IN_TURN, json.dumps(commands)]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout + done.stderr


@pytest.mark.parametrize("kind", FORMS)
def test_it_trains_resumes_fine_tunes_and_evaluates(kind, tmp_path):
    make_dataset(tmp_path / "data", FORMS[kind], 4, unlabelled=1)
    data = ["--dataset.repo_id=test/squares", f"--dataset.root={tmp_path / 'data'}"]
    quick = ["--batch_size=3", "--num_workers=0", "--log_freq=1", "--save_freq=2"]
    policy = [f"--policy.type={kind}", "--policy.device=cpu"]
    policy += [f"--policy.{name}={value}" for name, value in SMALL[kind].items()]
    checkpoint = tmp_path / "out/checkpoints/last/pretrained_model"
    evaluation = [
        "--policy.device=cpu",
        "--env.type=calvin",
        f"--env.control_mode={FORMS[kind]}",
        f"--env.image_size={SIZE}",
        "--env.steps_per_command=8",
    ]
    printed = run(
        [
            (TRAIN, [*policy, *data, *quick, "--steps=2", f"--output_dir={tmp_path / 'out'}"]),
            (TRAIN, [f"--config_path={checkpoint / 'train_config.json'}", "--resume=true", "--steps=4"]),
            (TRAIN, [f"--policy.path={checkpoint}", *data, *quick, "--steps=2", f"--output_dir={tmp_path / 'tuned'}"]),
            (
                EVAL,
                [
                    f"--policy.path={tmp_path / 'tuned/checkpoints/last/pretrained_model'}",
                    *evaluation,
                    "--env.task=open_drawer",
                    "--eval.n_episodes=2",
                    "--eval.batch_size=2",
                    "--eval.use_async_envs=false",
                    f"--output_dir={tmp_path / 'eval'}",
                ],
            ),
        ],
        tmp_path,
    )
    assert printed.count(" loss:") == 6, "a line for each of six updates"
    weights = [load_file(tmp_path / f"out/checkpoints/00000{n}/pretrained_model/model.safetensors") for n in (2, 4)]
    assert any((weights[0][name] != weights[1][name]).any() for name in weights[0])
    config = json.loads((checkpoint / "config.json").read_text())
    read = {"observation.images.static", "observation.images.gripper", "observation.state"}
    assert set(config["input_features"]) == read - ({"observation.state"} if kind == "mcil" else set())
    info = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 2


def test_gr1_learns_from_videos_alone_and_becomes_a_policy(tmp_path):
    make_dataset(tmp_path / "data", "abs", 4, camera="top")
    make_dataset(tmp_path / "desk", "rel", 4)
    quick = ["--batch_size=3", "--num_workers=0", "--log_freq=1", "--save_freq=2", "--steps=2"]
    policy = ["--policy.type=gr1", "--policy.device=cpu", "--policy.video_only=true"]
    policy += ["--policy.video_camera=observation.images.top", "--seed=1"]
    policy += [f"--policy.{name}={value}" for name, value in SMALL["gr1"].items()]
    video = [
        "--dataset.repo_id=test/video",
        f"--dataset.root={tmp_path / 'data'}",
        f"--output_dir={tmp_path / 'video'}",
    ]
    desk = ["--dataset.repo_id=test/squares", f"--dataset.root={tmp_path / 'desk'}", f"--output_dir={tmp_path / 'out'}"]
    learned = tmp_path / "video/checkpoints/last/pretrained_model"
    tuned = [f"--policy.path={learned}", "--policy.video_only=false", "--policy.push_to_hub=false"]
    run([(TRAIN, [*policy, *quick, *video]), (TRAIN, [*tuned, *quick, *desk])], tmp_path)
    before = load_file(learned / "model.safetensors")
    after = load_file(tmp_path / "out/checkpoints/last/pretrained_model/model.safetensors")
    name = "network.picture_layers.0.mlp.fc1.weight"
    assert (before[name] - after[name]).abs().max() < 0.01, "the policy begins with what the videos taught"
