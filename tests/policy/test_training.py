"""LanSAR under LeRobot's own commands: train, resume, fine-tune, held-out loss, with the installed plugin."""

import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path

import draccus
import pytest
import torch
import yaml
from lerobot.configs.policies import PreTrainedConfig

import lerobot_policy_lansar  # noqa: F401  (registers the policies)
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.envs.configuration_calvin import CalvinEnvConfig
from lerobot_lansar.policy.modeling_lansar import LanSARPolicy

from .conftest import COMMANDS, CONFIGS, SMALL, dataset_meta, make_dataset, small_config

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
    options = {**SMALL, "clip.model": "lansar-desk", "clip.pretrained": "", "window_start": "mixed"}
    policy = [f"--policy.{name}={str(value).lower()}" for name, value in options.items()]
    checkpoint = tmp_path / "out" / "checkpoints" / "last" / "pretrained_model"
    fresh = ["--policy.type=lansar", *policy, *data, *quick, "--steps=2", "--save_freq=2"]
    fresh += [
        "--dataset.eval_split=0.5",
        "--eval_steps=2",
        "--max_eval_samples=8",
        f"--output_dir={tmp_path / 'out'}",
    ]
    # the policy returns absolute actions, the environment takes relative ones: both by default
    fresh += ["--env.type=calvin", "--env.task=open_drawer", "--env.cameras=[]", "--env.steps_per_command=3"]
    fresh += ["--env_eval_freq=2", "--eval.n_episodes=1"]
    resume = [
        f"--config_path={checkpoint / 'train_config.json'}",
        "--resume=true",
        "--steps=4",
        "--save_freq=2",
    ]
    tune = [f"--policy.path={checkpoint}", "--policy.push_to_hub=false", "--policy.window_start=episode"]
    make_dataset(tmp_path / "more", lengths=(12, 9, 30), seed=1, video=True)
    tune += ["--dataset.repo_id=test/more", f"--dataset.root={tmp_path / 'more'}", *quick]
    tune += ["--dataset.episodes=[1,2]", "--steps=1", f"--output_dir={tmp_path / 'tuned'}"]
    tune += ["--sample_weighting.type=uniform"]
    result = run([fresh, resume, tune], tmp_path)
    assert result.returncode == 0, result.stderr[-4000:]
    assert "eval_loss=" in result.stderr
    assert result.stderr.count("position_loss") == 5  # one log line per update
    assert "pc_success" in result.stderr
    assert checkpoint.resolve().parent.name == "000004"

    from safetensors.torch import load_file

    first = load_file(tmp_path / "out" / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors")
    last = load_file(checkpoint / "model.safetensors")
    assert first["scaler.delta_std"].max() < 0.1  # m, rad: fitted to the data
    weight = "network.motion_head.0.weight"
    assert not torch.equal(first[weight], last[weight])
    tuned = tmp_path / "tuned/checkpoints/last/pretrained_model"
    assert json.loads((tuned / "config.json").read_text())["window_start"] == "episode"
    anew = LanSARPolicy(PreTrainedConfig.from_pretrained(tuned), dataset_meta=dataset_meta(tmp_path / "more"))
    for name, value in anew.scaler.state_dict().items():
        kept = load_file(tuned / "model.safetensors")[f"scaler.{name}"]
        assert torch.equal(kept, first[f"scaler.{name}"])  # the checkpoint's, not those of the new dataset
        assert "std" in name or not torch.equal(kept, value)
    steps = [s["registry_name"] for s in json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]]
    assert {"rename_observations_processor", "device_processor", "normalizer_processor"} < set(steps)
    assert str(tmp_path) not in (checkpoint / "policy_preprocessor.json").read_text()
    # each checkpoint holds its run's losses: those of a resumed run go on, those of a fine-tuned one begin anew
    printed = [float(loss) for loss in re.findall(r" loss:([\d.]+)", result.stderr)]
    held_out = [float(loss) for loss in re.findall(r"eval_loss=([\d.]+)", result.stderr)]
    expected = [(2, "training", sum(printed[:2]) / 2), (2, "held_out", held_out[0])]
    expected += [(4, "training", sum(printed[2:4]) / 2), (4, "held_out", held_out[1])]
    for folder, entries in ((checkpoint, expected), (tuned, [(1, "training", printed[4])])):
        losses = json.loads((folder / "losses.json").read_text())
        assert [(entry["update"], *(set(entry) - {"update"})) for entry in losses] == [e[:2] for e in entries]
        for entry, (_, kind, value) in zip(losses, entries, strict=True):
            assert entry[kind] == pytest.approx(value, abs=6e-4)  # as exact as LeRobot prints it


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("target", "achieved"),
        ("mlp_norm", "layer"),
        ("context_heads", 1),
        ("decoder_layers", 3),
        ("clip", ClipConfig("ViT-L-14", "openai")),
    ],
)
def test_what_a_checkpoints_weights_are_made_for_cannot_be_changed_under_them(name, value, tmp_path, relative):
    root, _ = relative
    LanSARPolicy(small_config()).save_pretrained(tmp_path)
    config = small_config(**{name: value})
    config.pretrained_path = tmp_path
    with pytest.raises(ValueError, match=rf"--policy.{name}={re.escape(str(value))}: .* was trained with {name}="):
        LanSARPolicy(config, dataset_meta=dataset_meta(root))


def test_two_processes_train_one_policy_save_and_resume(tmp_path):
    """`accelerate launch` on two processes, without a GPU on the CPU (gloo), each with a batch of its own."""
    make_dataset(tmp_path / "data", "rel")
    policy = [f"--policy.{key}={json.dumps(value)}" for key, value in SMALL.items()]
    first = [
        "--policy.type=lansar",
        *policy,
        "--policy.clip.model=lansar-desk",
        "--policy.clip.pretrained=",
        "--policy.dtype=bfloat16",
        "--policy.optimizer=muon",
        "--dataset.repo_id=test/desk",
        f"--dataset.root={tmp_path / 'data'}",
        f"--output_dir={tmp_path / 'out'}",
        "--batch_size=4",
        "--steps=4",
        "--save_freq=2",
        "--num_workers=0",
        "--log_freq=1",
    ]
    config = tmp_path / "out/checkpoints/last/pretrained_model/train_config.json"
    launcher = [sys.executable, "-m", "accelerate.commands.launch", "--multi_gpu", "--num_processes=2"]
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path / "hf"),
        "OMP_NUM_THREADS": "1",
    }
    for arguments in (first, [f"--config_path={config}", "--resume=true", "--steps=6"]):
        done = subprocess.run(
            [*launcher, "-m", "lerobot.scripts.lerobot_train", *arguments],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=600,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        assert "effective batch size: 8" in done.stderr + done.stdout

    from safetensors.torch import load_file

    checkpoints = [tmp_path / f"out/checkpoints/00000{n}" for n in (4, 6)]
    before, after = (load_file(folder / "pretrained_model/model.safetensors") for folder in checkpoints)
    weight = "network.motion_head.0.weight"
    assert not torch.equal(after[weight], before[weight])
    optimizer = load_file(checkpoints[1] / "training_state/optimizer_state.safetensors")
    assert {int(value) for key, value in optimizer.items() if key.endswith("/step")} == {6}  # resumed, not begun again
    groups = json.loads((checkpoints[1] / "training_state/optimizer_param_groups.json").read_text())
    assert [group["name"] for group in groups] == ["matrices", "rest"]
    assert f"state/{groups[0]['params'][0]}/momentum_buffer" in optimizer


def test_the_units_that_fsdp_shards_are_the_networks_layers():
    policy = LanSARPolicy(small_config())
    layers = [*policy.network.context_layers, *policy.network.decoder_layers]
    for names in (LanSARPolicy._no_split_modules, LanSARPolicy._fsdp_wrap_modules):
        assert {module for module in policy.modules() if type(module).__name__ in names} == set(layers)


def training_config(name):
    """A configuration file's policy and the rest of it."""
    text = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    policy = text.pop("policy")
    kind = PreTrainedConfig.get_choice_class(policy.pop("type"))
    return draccus.decode(kind, policy), text


TRAINING = [
    str(file.relative_to(CONFIGS).with_suffix(""))
    for file in sorted(CONFIGS.rglob("*.yaml"))
    if not file.name.startswith(("eval", "sentences", "tables"))
]


@pytest.mark.parametrize("name", TRAINING)
def test_shipped_configurations_hold_real_options_only(name):
    from lerobot.configs.train import TrainPipelineConfig

    config, rest = training_config(name)
    rest.setdefault("dataset", {"repo_id": "given/later"})
    decoded = draccus.decode(TrainPipelineConfig, rest)  # refuses what it does not know, at any depth
    assert decoded.steps == rest["steps"]
    assert config.type == (Path(name).name.partition("_")[0] if name.startswith("peers/") else "lansar")


def test_the_thesis_preset_is_the_thesis():
    written = yaml.safe_load((CONFIGS / "thesis/baseline.yaml").read_text())["policy"]
    assert written == {
        "type": "lansar",
        "push_to_hub": False,
        # Table 4.2, but for 8 decoder heads
        "hidden": 512,
        "context_layers": 6,
        "context_heads": 16,
        "decoder_layers": 6,
        "decoder_heads": 8,
        "feedforward": 2048,
        "dropout": 0.1,
        "window": 64,
        "learning_rate": 4e-4,
        "optimizer": "adamw",
        "weight_decay": 0.01,
        "warmup_fraction": 5 / 125,
        # sections 3 and 4.2
        "mlp_norm": "batch",
        "use_images": True,
        "use_spatial_context": True,
        "command_prepended": False,
        "orientation": "euler",
        "target": "achieved",
        "window_start": "episode",
        "smooth_l1_beta": 0.1,
        # section 4.3.1
        "control_mode": "abs",
        "history_clear_steps": 120,
        "window_slide": 1,
        "position_scale_start": 3.0,
        "position_scale_slope": 1.0,
        "yaw_scale": 1.5,
        "finetune_clip": False,
        "clip_learning_rate": 1e-5,
        "clip": {"model": "ViT-B-32", "pretrained": "openai"},
        # what the thesis does not have
        "command_in_context": False,
        "egocentric_blocks": False,
        "since_command": False,
        "paraphrases": False,
        "state_noise": 0.0,
        "contrastive_weight": 0.0,
        "dtype": "float32",
        "compile_model": False,
    }
    config, rest = training_config("thesis/baseline")
    options = {option.name for option in fields(config)} - {option.name for option in fields(PreTrainedConfig)}
    assert options - {"normalization_mapping"} <= written.keys()  # a new option must be decided here too
    assert round(config.warmup_fraction * rest["steps"]) == 1200
    assert rest["batch_size"] * rest["steps"] == 125 * 240 * 96
    assert rest["eval_steps"] == 25


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("abc", {}),
        ("prepended", {"command_prepended": True}),
        ("no_space", {"use_spatial_context": False}),
        ("no_images", {"use_images": False}),
    ],
)
def test_the_thesis_experiments_differ_from_its_baseline_in_what_they_say(name, changes):
    baseline, expected = training_config("thesis/baseline")
    config, rest = training_config(f"thesis/{name}")
    assert asdict(config) == asdict(baseline) | changes
    expected["output_dir"] = f"outputs/thesis/{name}"
    if name == "abc":
        expected["dataset"] |= {"repo_id": "lansar/calvin_abc", "root": "data/calvin_abc"}
    assert rest == expected


@pytest.mark.parametrize(
    ("name", "perturbation"),
    [
        ("eval", (0, 0)),
        ("eval_perturbed_5_50", (50, 5)),
        ("eval_perturbed_2.5_25", (25, 2.5)),
        ("eval_perturbed_0.5_5", (5, 0.5)),
    ],
)
def test_the_thesis_evaluations_are_its_protocol(name, perturbation):
    from lerobot.configs.eval import EvalPipelineConfig

    text = yaml.safe_load((CONFIGS / "thesis" / f"{name}.yaml").read_text())
    config = draccus.decode(EvalPipelineConfig, text)
    assert isinstance(config.env, CalvinEnvConfig)
    assert (config.env.task, config.env.control_mode, config.env.steps_per_command) == ("lh_mtlc", "abs", 360)
    assert (config.eval.n_episodes, config.seed) == (1000, 0)
    assert (config.env.perturbation_every, config.env.perturbation_scale) == perturbation
