r"""Policies compared: LanSAR, its peers and LeRobot's own, on the same demonstrations, for the same time of training.

    python benchmarks/policies.py --data=data/policies [--hours=2] [--minutes=60] [--chains=300] [--workers=2]
        [--policies='[no_space,hulc]'] [--seed=0] [--output_dir=outputs/policies]

Chains of commands are recorded on the built-in desk D with both cameras, and converted three times: with relative
actions, with absolute actions and the commanded task as numbers, and as CLIP embeddings for LanSAR. Nobody but
`lansar` reads the scene's state (privileged). Each policy trains on one core: a first, short run tells how long its
updates take, and the number of updates follows from --minutes. Then it plays the benchmark's first chains with
sentences that no demonstration was labelled with. Whatever is in --data and --output_dir already is not repeated, and
what was interrupted goes on, so policies may be measured one after the other; use new folders for other options. Ends
with lansar-report's comparison.

The same time is not the same start: `no_space` sees through `lansar-desk`, which was trained on this desk before, while
the image encoders of all others begin at random. Learning rates follow each policy's own schedule, those that end or
warm up scaled to the number of updates.
"""

import json
import re
import shutil
import statistics
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import draccus
from ablations import command
from tqdm import tqdm

from lerobot_lansar.jobs.staging import write_atomically

TRIAL = 60
"""Updates of the run that tells how fast a policy trains; the second half counts."""
SIZE = 96
"""Width and height of the pictures of all policies but LanSAR, whose CLIP sees them at 112 pixels."""
CONFIGS = Path(__file__).parents[1] / "configs"
TOLD = ["--env.task_in_state=true", "--env.scene_state=false", "--env.control_mode=abs"]
OWN = ["--policy.device=cpu", "--policy.push_to_hub=false", "--policy.pretrained_backbone_weights=null"]


@dataclass(frozen=True)
class Policy:
    """How one policy trains and is evaluated.

    Attributes:
        data: The dataset: `relative`, `told` or `embedded`.
        train, evaluate: Options of `lerobot-train` and `lansar-eval`.
        decay: Options that get the number of updates, beside `--steps`.
        warmup: Options that get a twentieth of it.
    """

    data: str
    train: list[str]
    evaluate: list[str]
    decay: tuple[str, ...] = ()
    warmup: tuple[str, ...] = ()


POLICIES = {
    "lansar": Policy(
        "embedded",
        [f"--config_path={CONFIGS / 'lansar.yaml'}"],
        ["--env.control_mode=abs", "--env.cameras=[]"],
    ),
    "mcil": Policy("told", [f"--config_path={CONFIGS / 'peers/mcil_small.yaml'}"], TOLD),
    "hulc": Policy(
        "relative",
        [f"--config_path={CONFIGS / 'peers/hulc_small.yaml'}"],
        ["--env.scene_state=false"],
    ),
    "gr1": Policy(
        "relative",
        [f"--config_path={CONFIGS / 'peers/gr1_small.yaml'}"],
        ["--env.scene_state=false"],
        ("--policy.decay_steps",),
        ("--policy.warmup_steps",),
    ),
    "no_space": Policy(
        "embedded",
        [f"--config_path={CONFIGS / 'lansar.yaml'}", "--policy.use_images=true", "--policy.use_spatial_context=false"],
        ["--env.control_mode=abs", "--env.scene_state=false"],
    ),
    "act": Policy(
        "told",
        [
            "--policy.type=act",
            *OWN,
            "--policy.dim_model=256",
            "--policy.n_heads=4",
            "--policy.dim_feedforward=1024",
            "--policy.chunk_size=32",
            "--policy.n_action_steps=32",
            # LeRobot's 1e-5 is for a trained backbone and a hundred thousand updates; this one begins at random.
            "--policy.optimizer_lr=1e-4",
            "--policy.optimizer_lr_backbone=1e-4",
            "--batch_size=8",
        ],
        TOLD,
    ),
    "diffusion": Policy(
        "told",
        [
            "--policy.type=diffusion",
            *OWN,
            "--policy.horizon=32",
            "--policy.n_action_steps=16",
            "--policy.down_dims=[64,128,256]",
            "--policy.num_inference_steps=10",
            "--policy.noise_scheduler_type=DDIM",
            "--batch_size=8",
        ],
        TOLD,
        warmup=("--policy.scheduler_warmup_steps",),
    ),
}
CONVERSIONS = {
    "relative": ["--images=png", f"--image_size={SIZE}", "--scene_state=false"],
    "told": ["--images=png", f"--image_size={SIZE}", "--scene_state=false", "--task_in_state=true", "--action=abs"],
    "embedded": ["--images=none", "--embed=true", "--clip.model=lansar-desk", "--clip.pretrained=v1", "--action=abs"],
}
LOCKS = {name: Lock() for name in CONVERSIONS}


@dataclass
class Options:
    """What to compare."""

    # Recorded and converted demonstrations; made if they are not there.
    data: Path
    policies: list[str] = field(default_factory=lambda: list(POLICIES))
    # Of demonstrations.
    hours: float = 2
    # Of each training.
    minutes: float = 60
    chains: int = 300
    seed: int = 0
    # Policies that are trained and evaluated beside each other, one core each.
    workers: int = 2
    output_dir: Path = Path("outputs/policies")


def record(options: Options) -> None:
    """The demonstrations, as CALVIN's files."""
    options.data.mkdir(parents=True, exist_ok=True)
    chains = options.data / "chains"
    if not (chains / "validation").exists():  # which appears last
        command(
            "lansar-record",
            "--mode=chains",
            f"--hours={options.hours}",
            "--validation_hours=0.02",
            "--variety=0.3",
            "--seed=0",
            f"--workers={options.workers}",
            f"--output_dir={chains}",
            log=options.data / "record.log",
        )


def convert(options: Options, name: str) -> None:
    """One of the datasets, by one core while others train; a second caller waits, and finds it there."""
    with LOCKS[name]:
        command(  # does nothing if it is done, and goes on if it was interrupted
            "lansar-convert",
            f"--root={options.data / 'chains'}",
            "--split=training",
            f"--repo_id=lansar/{name}",
            f"--output_dir={options.data / name}",
            *CONVERSIONS[name],
            log=options.data / f"{name}.log",
        )


def train(options: Options, name: str, folder: Path, updates: int, log_freq: int) -> float:
    """One training, from its last checkpoint on if there is one; returns the seconds of an update, reading included."""
    policy = POLICIES[name]
    log = folder.with_suffix(".log")
    config = folder / "checkpoints/last/pretrained_model/train_config.json"
    if config.exists():
        command("lerobot-train", f"--config_path={config}", "--resume=true", log=log)
        return statistics.mean(seconds_per_update(log))
    shutil.rmtree(folder, ignore_errors=True)
    log.unlink(missing_ok=True)
    command(
        "lerobot-train",
        *policy.train,
        f"--dataset.repo_id=lansar/{policy.data}",
        f"--dataset.root={options.data / policy.data}",
        f"--output_dir={folder}",
        f"--seed={options.seed}",
        "--num_workers=0",
        f"--log_freq={log_freq}",
        f"--steps={updates}",
        f"--save_freq={max(1, updates // 5)}",
        *(f"{option}={updates}" for option in policy.decay),
        *(f"{option}={updates // 20}" for option in policy.warmup),
        log=log,
    )
    return statistics.mean(seconds_per_update(log))


def seconds_per_update(log: Path) -> list[float]:
    """What LeRobot says each `log_freq` updates: reading the data, and the update itself."""
    found = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", log.read_text())
    if not found:
        raise RuntimeError(f"{log} does not say how long an update takes: lerobot-train's lines have changed")
    return [sum(map(float, each)) for each in found]


def attempt(options: Options, name: str) -> str | None:
    """Measures one policy; says and returns what went wrong."""
    try:
        measure(options, name)
    except Exception as error:  # the other policies go on
        problem = f"{name}: {error}"
        tqdm.write(problem)
        return problem
    return None


def measure(options: Options, name: str) -> None:
    """One policy: its data, how fast it trains, its training, its evaluation."""
    folder = options.output_dir / name
    folder.mkdir(parents=True, exist_ok=True)
    result = folder / "train.json"
    if not result.exists():
        convert(options, POLICIES[name].data)
        plan = folder / "updates.json"
        if not plan.exists():
            shutil.rmtree(folder / "trial", ignore_errors=True)
            train(options, name, folder / "trial", TRIAL, TRIAL // 2)
            seconds = seconds_per_update(folder / "trial.log")[-1]  # of the second half
            write_atomically(plan, json.dumps(max(1, round(60 * options.minutes / seconds))))
        shutil.rmtree(folder / "trial", ignore_errors=True)
        updates = json.loads(plan.read_text())
        minutes = updates * train(options, name, folder / "train", updates, max(1, updates // 50)) / 60
        write_atomically(result, json.dumps({"updates": updates, "minutes": round(minutes, 1)}))
    command(
        "lansar-eval",
        f"--policy.path={folder / 'train/checkpoints/last/pretrained_model'}",
        "--env.type=calvin",
        *([] if POLICIES[name].data == "embedded" else [f"--env.image_size={SIZE}"]),
        *POLICIES[name].evaluate,
        f"--chains={options.chains}",
        "--workers=1",
        "--videos=0",
        "--seed=0",
        f"--output_dir={folder / 'eval'}",
        log=folder / "eval.log",
    )


def main() -> None:
    """Measures what is missing and compares."""
    options = draccus.parse(Options)
    unknown = set(options.policies) - POLICIES.keys()
    if unknown:
        sys.exit(f"--policies: unknown {sorted(unknown)}; choose among {list(POLICIES)}")
    record(options)
    with ThreadPoolExecutor(options.workers) as pool:
        runs = pool.map(lambda name: attempt(options, name), options.policies)
        problems = list(filter(None, tqdm(runs, total=len(options.policies), unit="policy")))
    done = [name for name in options.policies if (options.output_dir / name / "eval/episodes.jsonl").exists()]
    if not done:
        sys.exit("\n".join(problems))
    for name in done:
        print(name, (options.output_dir / name / "train.json").read_text())
    command(
        "lansar-report",
        f"--eval_dir=[{','.join(str(options.output_dir / name / 'eval') for name in done)}]",
        f"--labels=[{','.join(done)}]",
        "--published=thesis_5.5",
        f"--output_dir={options.output_dir}",
        log=options.output_dir / "report.log",
    )
    print((options.output_dir / "report.md").read_text())
    if problems:
        sys.exit("\n".join(problems))


if __name__ == "__main__":
    main()
