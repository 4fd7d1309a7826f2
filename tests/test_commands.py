"""All commands as a user types them: record, convert, train, evaluate, report; few steps each."""

import json
import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import preprocess_observation
from safetensors.torch import load_file

from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.clip.model import Clip
from lerobot_lansar.envs.pictures import Pictures
from lerobot_lansar.policy.frames import load_pictures

BIN = Path(sys.executable).parent
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("line")


@pytest.fixture(scope="module")
def run(work):
    def run(command, *options, fails=False):
        environment = {**os.environ, "HF_HOME": str(work / "hf"), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [BIN / command, *options], cwd=work, env=environment, capture_output=True, text=True, timeout=600
        )
        assert (done.returncode != 0) == fails, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout + done.stderr

    return run


@pytest.fixture(scope="module")
def dataset(run, work):
    """Demonstrations on all four desks with pictures, converted with videos and CLIP embeddings."""
    tasks = "--tasks=[turn_on_led,lift_red_block_table]"
    run("lansar-record", "--output_dir=desk", tasks, "--scene=[A,B,C,D]", "--episodes=8", "--validation_episodes=4")
    run(
        "lansar-convert",
        "--root=desk",
        "--split=training",
        "--repo_id=me/desk",
        "--output_dir=data",
        "--embed=true",
        "--clip.model=lansar-desk",
        "--clip.pretrained=",
    )
    return ["--dataset.repo_id=me/desk", f"--dataset.root={work / 'data'}"]


SMALL_LANSAR = [
    "--policy.hidden=32",
    "--policy.context_layers=1",
    "--policy.context_heads=2",
    "--policy.decoder_layers=1",
    "--policy.decoder_heads=2",
    "--policy.feedforward=64",
    "--policy.clip.model=lansar-desk",
    "--policy.clip.pretrained=",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
]
SMALL_ACT = [
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.pretrained_backbone_weights=null",
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=64",
    "--policy.n_encoder_layers=1",
    "--policy.n_vae_encoder_layers=1",
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
]
TRAINING = ["--batch_size=4", "--num_workers=0", "--log_freq=1"]
EVALUATION = ["--env.type=calvin", "--env.steps_per_command=5", "--policy.device=cpu"]


@pytest.fixture(scope="module")
def lansar(run, dataset):
    """A LanSAR with pictures after two updates, trained by the short form of the command."""
    options = [option.removeprefix("--") for option in (*dataset, *SMALL_LANSAR[:-2], *TRAINING)]
    run(
        "lerobot",
        "train",
        "policy=lansar",
        *options,
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "steps=2",
        "save_freq=2",
        "output_dir=out/lansar",
    )
    return "out/lansar/checkpoints/last/pretrained_model"


def test_lansar_trains_its_image_encoder_resumes_and_evaluates(run, work, dataset):
    options = [*SMALL_LANSAR, *TRAINING, "--policy.finetune_clip=true", "--policy.window=4", "--policy.optimizer=muon"]
    tuned = "out/encoder/checkpoints/last/pretrained_model"
    run(
        "lerobot-train",
        "--policy.type=lansar",
        *dataset,
        *options,
        "--steps=2",
        "--save_freq=1",
        "--output_dir=out/encoder",
    )
    decoded = list((work / "data/.cache/huggingface").glob("lansar_frames_pictures/*/static.npy"))
    run("lerobot-train", f"--config_path={tuned}/train_config.json", "--resume=true", "--steps=3")
    state = load_file(work / "out/encoder/checkpoints/last/training_state/optimizer_state.safetensors")
    assert {int(value) for key, value in state.items() if key.endswith("/step")} == {3}, "resumed, not begun again"

    (file,) = decoded
    pictures, clip = np.load(file, mmap_mode="r"), Clip(ClipConfig("lansar-desk", ""))
    shown = LeRobotDataset("me/desk", root=work / "data")[7]["observation.images.static"]
    seen = clip.images.resize(shown[None])[0].permute(1, 2, 0).numpy()
    assert np.abs(pictures[7] / 255 - seen).max() < 0.003

    whole = np.array(pictures)
    partial = file.parent.with_suffix(".partial")
    file.parent.rename(partial)
    (partial / "progress.json").write_text("100")  # as an interrupted pass leaves it
    for camera in ("static", "gripper"):
        array = np.load(partial / f"{camera}.npy", mmap_mode="r+")
        array[5], array[100:] = 7, 0
    again = load_pictures(work / "data", clip.images.size[0], clip.images.resize)["static"]
    assert (again[5] == 7).all(), "what was decoded stays"
    assert np.array_equal(again[100:], whole[100:])

    before, after = (
        load_file(work / f"out/encoder/checkpoints/00000{n}/pretrained_model/model.safetensors") for n in (1, 2)
    )
    moved = {name: (after[name] - before[name]).abs().max() for name in after if name.startswith("image_encoder")}
    moved = {name: most for name, most in moved.items() if most > 0}
    trunk = "image_encoder.visual.trunk"
    assert {f"{trunk}.convolutions.0.weight", f"{trunk}.mix.2.weight"} <= set(moved)
    assert max(moved.values()) < 2e-5, "the encoder has its own, smaller learning rate"

    run(
        "lerobot-eval",
        f"--policy.path={tuned}",
        *EVALUATION,
        "--env.task=open_drawer",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--output_dir=eval_encoder",
    )
    assert len(successes(work, "eval_encoder")[0]) == 2


def successes(work, folder):
    info = json.loads((work / folder / "eval_info.json").read_text())
    return [task["metrics"]["sum_rewards"] for task in info["per_task"]]


def test_without_the_scenes_state_lansar_knows_the_blocks_from_pictures(run, work, dataset):
    blind = [option.replace("me/desk", "me/blind").replace("/data", "/blind") for option in dataset]
    clip = [option.replace("policy.", "") for option in SMALL_LANSAR if "clip" in option]
    source = ["--root=desk", "--split=training", "--repo_id=me/blind", "--output_dir=blind"]
    run("lansar-convert", *source, "--images=none", "--embed=true", *clip, "--scene_state=false")
    train = [
        "lerobot-train",
        "--policy.type=lansar",
        *blind,
        *SMALL_LANSAR,
        *TRAINING,
        "--steps=1",
        "--output_dir=out/b",
    ]
    run(*train, "--policy.use_spatial_context=false")
    evaluate = ["lerobot-eval", "--policy.path=out/b/checkpoints/last/pretrained_model", *EVALUATION]
    evaluate += ["--env.task=turn_on_led", "--eval.n_episodes=2", "--eval.batch_size=2"]
    ends = []
    for name, state in (("without", "false"), ("with", "true")):  # given the state, it looks away
        folder = f"eval_scene_{name}"
        run(*evaluate, f"--env.scene_state={state}", f"--env.results_dir={folder}", f"--output_dir={folder}")
        lines = [json.loads(line) for line in (work / folder / "episodes.jsonl").read_text().splitlines()]
        ends.append({line["seed"]: line["end"] for line in lines})
    assert ends[0] == ends[1]
    assert sorted(ends[0]) == [1000, 1001]
    assert ends[0][1000] != ends[0][1001]


def test_the_converted_recording_equals_what_was_recorded(run, dataset):
    printed = run("lansar-verify", "--root=desk", "--repo_id=me/desk", "--dataset_dir=data", "--workers=2")
    assert "8 episodes" in printed
    assert printed.count("PSNR") == 2


def test_lansar_evaluates_the_same_with_any_batch_size(run, work, lansar):
    # batch 1 runs in this process, batch 3 in workers, and its last batch is not full
    for size in (1, 3):
        run(
            "lerobot-eval",
            f"--policy.path={lansar}",
            *EVALUATION,
            "--env.task=turn_on_led",
            "--eval.n_episodes=4",
            "--env.control_mode=abs",
            "--env.steps_per_command=25",
            f"--eval.batch_size={size}",
            "--seed=0",
            f"--env.results_dir=results{size}",
            f"--output_dir=eval{size}",
        )
    assert successes(work, "eval1") == successes(work, "eval3")
    assert len(successes(work, "eval1")[0]) == 4
    episodes = [
        {json.loads(line)["seed"]: json.loads(line)["commands"] for line in (work / d / "episodes.jsonl").open()}
        for d in ("results1", "results3")
    ]
    assert all(episodes[0][seed] == episodes[1][seed] for seed in range(4))
    # The motion itself, seen in the videos. Batch sizes round differently, contact amplifies the difference, and the
    # video encoder looks ahead: the films are equal to the eye, not to the bit. Different episodes differ by over 10.
    films = [[film(work / f"eval{size}", k) for k in range(4)] for size in (1, 3)]
    for one, three in zip(*films, strict=True):
        assert one.shape == three.shape
        assert np.abs(one - three).mean() < 2
    assert np.abs(films[0][0] - films[0][1]).mean() > 10, "the episodes do not differ"


def film(folder, episode):
    """All frames of an episode's video, (n, 200, 200, 3)."""
    (file,) = folder.rglob(f"eval_episode_{episode}.mp4")
    with av.open(str(file)) as container:
        return np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]).astype(int)


def test_a_chain_is_evaluated_and_reported(run, work, lansar):
    run(
        "lerobot-eval",
        f"--policy.path={lansar}",
        *EVALUATION,
        "--env.control_mode=abs",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--seed=0",
        "--output_dir=eval_chain",
        "--env.results_dir=eval_chain",
    )
    printed = run("lansar-report", "--eval_dir=eval_chain", f"--policy_path={lansar}")
    assert "rotate_blue_block_right" in printed  # chain 0's first task
    assert "built-in" in printed
    report = json.loads((work / "eval_chain" / "report.json").read_text())
    assert report["tables"][0]["evaluations"][0]["average_length"] == 0
    assert list((work / "eval_chain").rglob("*.mp4"))


def test_diffusion_trains_on_one_camera_of_the_dataset_and_runs_on_the_desk(run, work, dataset):
    """It wants all its pictures of one size; docs/dataset.md says how to name its inputs."""
    inputs = {
        "observation.state": {"type": "STATE", "shape": [15]},
        "observation.images.static": {"type": "VISUAL", "shape": [3, 200, 200]},
    }
    run(
        "lerobot-train",
        "--policy.type=diffusion",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        *dataset,
        *TRAINING,
        f"--policy.input_features={json.dumps(inputs)}",
        "--policy.down_dims=[32,64]",
        "--policy.horizon=8",
        "--policy.n_action_steps=4",
        "--policy.num_inference_steps=2",
        "--policy.pretrained_backbone_weights=null",
        "--steps=2",
        "--output_dir=out/diffusion",
    )
    run(
        "lerobot-eval",
        "--policy.path=out/diffusion/checkpoints/last/pretrained_model",
        *EVALUATION,
        "--env.task=turn_on_led",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--output_dir=eval_diffusion",
    )
    assert len(successes(work, "eval_diffusion")[0]) == 1


def test_depth_and_cameras_of_one_size_from_the_recording_to_the_evaluation(run, work):
    one_task = ["--tasks=[turn_on_led]", "--episodes=2", "--validation_episodes=1"]
    run("lansar-record", "--output_dir=deep", *one_task, "--depth=true")
    dataset = ["--repo_id=me/deep", "--output_dir=deep_data"]
    run("lansar-convert", "--root=deep", "--split=training", *dataset, "--depth=true", "--image_size=128")
    run(
        "lerobot-train",
        "--policy.type=act_depth",
        "--dataset.repo_id=me/deep",
        f"--dataset.root={work / 'deep_data'}",
        *TRAINING,
        *SMALL_ACT,
        "--steps=2",
        "--output_dir=out/act_depth",
    )
    pictures = ["--env.depth=true", "--env.image_size=128", "--env.render_size=256", "--env.camera_poses=true"]
    policy = "out/act_depth/checkpoints/last/pretrained_model"
    run(
        "lerobot-eval",
        f"--policy.path={policy}",
        *EVALUATION,
        *pictures,
        "--env.task=turn_on_led",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--env.results_dir=eval_depth",
        "--output_dir=eval_depth",
    )
    assert len(successes(work, "eval_depth")[0]) == 2
    assert film(work / "eval_depth", 0).shape[1:] == (256, 256, 3)
    assert "another look" not in run("lansar-report", "--eval_dir=eval_depth", f"--policy_path={policy}")

    # what the policy saw in training and what it sees of the same frame in an evaluation
    learned = LeRobotDataset("me/deep", root=work / "deep_data")[0]
    frame = dict(np.load(min((work / "deep" / "training").glob("episode_*.npz"))))
    observation = Pictures(("static", "gripper"), image_size=128, depth=True, depth_unit="mm").observe(frame)
    batch = {key: value[None] for key, value in observation.items() if key != "pixels"}
    batch["pixels"] = {camera: picture[None] for camera, picture in observation["pixels"].items()}
    seen = preprocess_observation(batch)
    for camera in ("static", "gripper"):
        for key, error in ((f"observation.images.{camera}", 0.02), (f"observation.images.{camera}_depth", 2.0)):
            assert learned[key].dtype == seen[key].dtype
            assert learned[key].shape == seen[key][0].shape
            assert (learned[key] - seen[key][0]).abs().mean() < error
