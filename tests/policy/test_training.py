"""LanSAR under LeRobot's own commands: train, resume, fine-tune, held-out loss, with the installed plugin."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from .conftest import COMMANDS, SMALL, make_dataset

CONFIGS = Path(__file__).parents[2] / "configs"

# Several runs of lerobot-train in one process: importing LeRobot takes 20 s; each builds everything anew.
RUN_IN_TURN = """
import json, sys
from lerobot.scripts import lerobot_train
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["lerobot-train", *arguments]
    lerobot_train.main()
"""


def run(arguments, tmp_path):
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path / "hf"),
        "OMP_NUM_THREADS": "1",
        "ACCELERATE_USE_CPU": "1",
    }
    command = [sys.executable, "-c", RUN_IN_TURN, json.dumps(arguments)]
    return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=600)


def test_lerobot_train_trains_resumes_fine_tunes_and_measures_a_held_out_loss(tmp_path):
    # two episodes per command, so that eval_split can hold one of each out
    make_dataset(tmp_path / "data", lengths=(12, 70) * len(COMMANDS))
    data = ["--dataset.repo_id=test/desk", f"--dataset.root={tmp_path / 'data'}"]
    quick = ["--batch_size=3", "--num_workers=0", "--log_freq=1"]
    options = {**SMALL, "clip.model": "lansar-tiny", "clip.pretrained": "", "window_start": "mixed"}
    policy = [f"--policy.{name}={str(value).lower()}" for name, value in options.items()]
    checkpoint = tmp_path / "out" / "checkpoints" / "last" / "pretrained_model"
    fresh = ["--policy.type=lansar", *policy, *data, *quick, "--steps=2", "--save_freq=2"]
    fresh += [
        "--dataset.eval_split=0.5",
        "--eval_steps=2",
        "--max_eval_samples=8",
        f"--output_dir={tmp_path / 'out'}",
    ]
    resume = [
        f"--config_path={checkpoint / 'train_config.json'}",
        "--resume=true",
        "--steps=4",
        "--save_freq=2",
    ]
    tune = [f"--policy.path={checkpoint}", "--policy.push_to_hub=false", "--policy.window_start=episode"]
    tune += [*data, *quick, "--dataset.episodes=[1,2]", "--steps=1", f"--output_dir={tmp_path / 'tuned'}"]
    result = run([fresh, resume, tune], tmp_path)
    assert result.returncode == 0, result.stderr[-4000:]
    assert "eval_loss=" in result.stderr
    assert "position_loss" in result.stderr
    assert checkpoint.resolve().parent.name == "000004"

    from safetensors.torch import load_file

    first = load_file(tmp_path / "out" / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors")
    last = load_file(checkpoint / "model.safetensors")
    assert first["scaler.delta_std"].max() < 0.1  # m, rad: fitted to the data
    assert torch.equal(first["scaler.delta_std"], last["scaler.delta_std"])
    weight = "network.motion_head.0.weight"
    assert not torch.equal(first[weight], last[weight])
    tuned = json.loads((tmp_path / "tuned/checkpoints/last/pretrained_model/config.json").read_text())
    assert tuned["window_start"] == "episode"
    steps = [
        s["registry_name"] for s in json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]
    ]
    assert {"rename_observations_processor", "device_processor", "normalizer_processor"} < set(steps)
    assert str(tmp_path) not in (checkpoint / "policy_preprocessor.json").read_text()


@pytest.mark.parametrize("name", sorted(file.stem for file in CONFIGS.glob("*.yaml")))
def test_shipped_configurations_hold_real_options_only(name):
    import draccus
    from lerobot.configs.train import TrainPipelineConfig

    from lerobot_lansar.policy.configuration_lansar import LanSARConfig

    text = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    assert text["policy"].pop("type") == "lansar"
    config = draccus.decode(LanSARConfig, text.pop("policy"))
    assert set(text) <= set(TrainPipelineConfig.__dataclass_fields__)
    assert config.network.hidden == (512 if name == "lansar_thesis" else 96)
    if name == "lansar_thesis":
        assert (config.target, config.orientation, config.window_start) == ("achieved", "euler", "episode")
        assert (config.position_scale_start, config.position_scale_slope, config.yaw_scale) == (3, 1, 1.5)
        assert round(config.warmup_fraction * text["steps"]) == 1200
