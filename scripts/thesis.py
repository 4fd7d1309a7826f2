"""The thesis' size, trained and evaluated with and without the recommended choices, on one GPU. Run by `make thesis`.

    python scripts/thesis.py [--minutes=60] [--pictures] [--chains=300] [--device=cuda] [--workers=CORES]
        [--dataset=FOLDER]
    python scripts/thesis.py --dry_run      # everything with tiny sizes, on a CPU

Record chains on the built-in desk, convert, train both, evaluate both with lansar-eval, compare with lansar-report.
State and language only, the thesis' "No Image"; with --pictures its Baseline, embedded by lansar-desk. While the cores
record, the GPU measures how fast it trains; the number of updates follows from that and from --minutes, and result.json
says it. With --dataset, nothing is recorded: that LeRobotDataset is learned from. A step whose result exists is
skipped. A step that fails or exceeds its time ends the run only if nothing can follow it. No step asks the network.
"""

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from lerobot_lansar.report.episodes import read_lines

ROOT = Path(__file__).resolve().parents[1]
PATH = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
FRAMES_PER_CORE = {"state": 200, "pictures": 60}
"""Frames that one core records in a second, start-up included (docs/benchmarks.md: 224; docs/RESULTS.md, 2 h with
pictures: 66)."""
SHARES = {"record": 0.2, "evaluate": 0.25}
"""Shares of the time for recording and for both evaluations; training takes what is left."""
START_UP = 100
"""Seconds of a training that are no updates: imports, reading the data, compiling, the checkpoint."""
RECORDERS = 0.75
"""Share of the cores that record; the others compile meanwhile, which takes far longer on busy ones."""
CLIP = ("clip.model=lansar-desk", "clip.pretrained=v1")
THESIS = ["--dataset.eval_split=0", "--eval_steps=0", *(f"--policy.{option}" for option in CLIP)]
RECOMMENDED = [
    "--policy.command_in_context=true",
    "--policy.orientation=sincos",
    "--policy.egocentric_blocks=true",
    "--policy.target=commanded",
    "--policy.window_start=mixed",
    "--policy.window_slide=32",
    "--policy.position_scale_start=1",
    "--policy.position_scale_slope=0",
    "--policy.yaw_scale=1",
    "--policy.dropout=0",
    "--policy.mlp_norm=layer",
    "--policy.optimizer=muon",  # the learning rate was not searched at this size
    "--policy.learning_rate=2e-3",
    "--policy.weight_decay=0.1",
]
ROWS = {"recommended": [*THESIS, *RECOMMENDED], "thesis": THESIS}
TINY = ["hidden=16", "context_layers=1", "context_heads=2", "decoder_layers=1", "decoder_heads=2", "feedforward=32"]
VARIANTS = ("bfloat16", "bfloat16+compile")


class StepError(Exception):
    """A step failed or took too long."""


running: set[subprocess.Popen] = set()
"""The commands of `run` in all threads."""


def end(process: subprocess.Popen) -> None:
    """Ends a command with its workers."""
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(5)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def run(title: str, log: Path, seconds: float, *command: object) -> None:
    """Runs a command from the repository's root; its output goes to `log`.

    Raises:
        StepError: It failed, or was ended after `seconds`.
    """
    words = [str(word) for word in command]
    print(f"=== {title} (output in {log})\n$ {shlex.join(words)}", flush=True)
    program = shutil.which(words[0], path=PATH)
    if program is None:
        raise StepError(f"{words[0]} is not installed: run `make install`")
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "WANDB_MODE": "disabled", "OMP_NUM_THREADS": "1"}
    started = time.time()
    with open(log, "a") as file:
        process = subprocess.Popen(
            [program, *words[1:]], cwd=ROOT, env=environment, stdout=file, stderr=file, start_new_session=True
        )
        running.add(process)
        try:
            code = process.wait(max(1, seconds))
        except BaseException as error:
            end(process)
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            raise StepError(f"{title} was ended after {seconds:.0f} s") from None
        finally:
            running.discard(process)
    if code:
        raise StepError(f"{title} ended with exit code {code}: see {log}")
    print(f"--- {title}: {time.time() - started:.0f} s", flush=True)


class Thesis:
    """One run: its options, its folder and its clock."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.out = options.output_dir
        self.dataset = options.dataset or self.out / "data/lerobot"
        self.preset = "thesis/baseline" if options.pictures else "thesis/no_images"
        self.cameras = () if options.pictures else ("[]",)
        self.started = time.time()
        self.seconds = 60.0 * options.minutes
        self.problems: list[str] = []
        self.updates: dict[str, int] = {}

    def left(self) -> float:
        """Seconds of --minutes that are left."""
        return self.started + self.seconds - time.time()

    def record(self) -> None:
        """Demonstrations, converted, unless --dataset has them; what is there already is not made again."""
        o, data = self.options, self.out / "data"
        if o.dataset and (self.dataset / "meta/info.json").exists():
            return
        workers = max(1, int(RECORDERS * o.workers))
        speed = FRAMES_PER_CORE["pictures" if o.pictures else "state"]
        hours = SHARES["record"] * self.seconds * workers * speed / (30 * 3600)
        if not (data / "chains/validation").exists():
            run(
                "record",
                self.out / "logs/record.log",
                2.5 * SHARES["record"] * self.seconds + 60,
                "lansar-record",
                "--mode=chains",
                f"--hours={0.005 if o.dry_run else o.hours or round(hours, 2)}",
                "--validation_hours=0.002",
                *(f"--cameras={none}" for none in self.cameras),
                "--variety=0.3",
                "--seed=0",
                f"--workers={workers}",
                f"--output_dir={data / 'chains'}",
            )
        run(
            "convert",
            self.out / "logs/convert.log",
            self.left(),
            "lansar-convert",
            f"--root={data / 'chains'}",
            "--split=training",
            "--repo_id=lansar/chains",
            "--images=none",
            f"--workers={o.workers}",
            f"--output_dir={self.dataset}",
            *(["--embed=true", *(f"--{option}" for option in CLIP)] if o.pictures else []),
        )

    def measure(self) -> None:
        """The speed of training on this device, in benchmark.json."""
        file, o = self.out / "benchmark.json", self.options
        if file.exists():
            return
        size = ["--preset=lansar", "--batch_size=4", "--updates=1"] if o.dry_run else [f"--preset={self.preset}"]
        variants = ["float32", "bfloat16"] if o.dry_run else [*VARIANTS, "tf32", "float32"]
        try:
            run(
                "measure",
                self.out / "logs/benchmark.log",
                600 if o.dry_run else SHARES["record"] * self.seconds + 60,
                sys.executable,
                "benchmarks/training.py",
                *size,
                f"--device={o.device}",
                f"--variants=[{','.join(variants)}]",
                f"--output={file}",
            )
        except StepError as error:
            self.problems.append(str(error))

    def fastest(self) -> tuple[str, float]:
        """The variant of bfloat16 that trained fastest, and its seconds per update."""
        file = self.out / "benchmark.json"
        rows = json.loads(file.read_text())["updates"] if file.exists() else []
        times = {row["variant"]: row["update_ms"] / 1000 for row in rows if row["variant"] in VARIANTS}
        if not times:
            return "bfloat16", 0.06
        best = min(times, key=lambda name: times[name])
        return best, times[best]

    def train(self, name: str, seconds: float) -> None:
        """One training that takes about `seconds`."""
        o, folder = self.options, self.out / "train" / name
        checkpoint = folder / "checkpoints/last/pretrained_model"
        variant, update = self.fastest()
        # 4 ms: looking up the batch, and LeRobot's own work between updates
        updates = 2 if o.dry_run else max(50, min(30_000, int((seconds - START_UP) / (update + 0.004))))
        if checkpoint.exists():
            self.updates[name] = json.loads((checkpoint / "train_config.json").read_text())["steps"]
            return
        shutil.rmtree(folder, ignore_errors=True)
        self.updates[name] = updates
        options = [f"--policy.{size}" for size in TINY] + ["--batch_size=4"] if o.dry_run else []
        run(
            f"train {name}",
            self.out / f"logs/train_{name}.log",
            1.5 * seconds + 60,
            "lerobot-train",
            f"--config_path=configs/{self.preset}.yaml",
            *ROWS[name],
            "--dataset.repo_id=lansar/chains",
            f"--dataset.root={self.dataset}",
            f"--policy.device={o.device}",
            f"--policy.dtype={'float32' if o.device == 'cpu' else 'bfloat16'}",
            f"--policy.compile_model={str('+compile' in variant).lower()}",
            f"--steps={updates}",
            f"--save_freq={updates}",
            "--log_freq=50",
            f"--num_workers={0 if o.dry_run else min(10, max(1, o.workers - 2))}",
            f"--output_dir={folder}",
            *options,
        )

    def evaluate(self, name: str, seconds: float) -> None:
        """One evaluation; the same command later plays the chains that were not reached."""
        o = self.options
        run(
            f"evaluate {name}",
            self.out / f"logs/eval_{name}.log",
            seconds,
            "lansar-eval",
            f"--policy.path={self.out / 'train' / name / 'checkpoints/last/pretrained_model'}",
            f"--policy.device={o.eval_device}",
            "--env.type=calvin",
            "--env.control_mode=abs",
            *(f"--env.cameras={none}" for none in self.cameras),
            *(["--env.steps_per_command=5"] if o.dry_run else []),
            f"--chains={2 if o.dry_run else o.chains}",
            "--eval.batch_size=20",
            "--seed=0",
            "--videos=0",
            f"--workers={o.workers}",
            f"--output_dir={self.out / 'eval' / name}",
        )

    def attempt(self, step: Any, *arguments: Any) -> None:
        """Runs a step; notes its failure."""
        try:
            step(*arguments)
        except StepError as error:
            self.problems.append(str(error))
            print(f"!!! {error}", flush=True)

    def report(self) -> None:
        """The comparison and result.json."""
        done = [name for name in ROWS if (self.out / "eval" / name / "episodes.jsonl").exists()]
        if done:
            folders, labels = (f"[{','.join(names)}]" for names in ([str(self.out / "eval" / n) for n in done], done))
            self.attempt(
                run,
                "report",
                self.out / "logs/report.log",
                120,
                "lansar-report",
                f"--eval_dir={folders}",
                f"--labels={labels}",
                "--published=thesis_5.3",
                f"--output_dir={self.out / 'report'}",
            )
        lengths = {}
        for name in done:
            counts = [episode.successes for episode in read_lines(self.out / "eval" / name)]
            lengths[name] = {"chains": len(counts), "average_length": round(sum(counts) / max(1, len(counts)), 3)}
        result = {
            "minutes": round((time.time() - self.started) / 60, 1),
            "updates": self.updates,
            "variant": self.fastest()[0],
            "evaluations": lengths,
            "problems": self.problems,
        }
        (self.out / "result.json").write_text(json.dumps(result, indent=2) + "\n")
        print(json.dumps(result, indent=2), flush=True)

    def main(self) -> int:
        """All steps."""
        with ThreadPoolExecutor(1) as gpu:  # the GPU is idle while the cores record
            measuring = gpu.submit(self.measure)
            try:
                self.attempt(self.record)
                measuring.result()
            except BaseException:  # Ctrl-C, or a batch system's signal
                for process in list(running):
                    end(process)
                raise
        if (self.dataset / "meta/info.json").exists():
            evaluating = SHARES["evaluate"] * self.seconds / len(ROWS)
            for number, name in enumerate(ROWS):
                rest = len(ROWS) - number  # each row gets an equal share of what is left
                self.attempt(self.train, name, (self.left() - 20) / rest - evaluating)
                if (self.out / "train" / name / "checkpoints/last").exists():
                    self.attempt(
                        self.evaluate, name, max(600 if self.options.dry_run else 30, (self.left() - 20) / rest)
                    )
        self.report()
        return 1 if self.problems else 0


def main() -> int:
    """Reads the options."""
    parser = argparse.ArgumentParser(description="Trains and evaluates LanSAR at the thesis' size.")
    parser.add_argument("--minutes", type=float, default=60, help="how long everything may take")
    parser.add_argument("--pictures", action="store_true", help="learn from both cameras' pictures, too")
    parser.add_argument("--hours", type=float, help="of demonstrations; by default what a fifth of the time records")
    parser.add_argument("--dataset", help="folder of a LeRobotDataset to learn from instead of recording one")
    parser.add_argument("--chains", type=int, default=300, help="of each evaluation")
    parser.add_argument("--device", default="cuda", help="for training")
    parser.add_argument("--eval_device", help="for evaluation; by default --device")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes, one per core")
    parser.add_argument(
        "--output_dir", help="by default outputs/thesis_size, with --pictures and --dry_run in its name"
    )
    parser.add_argument("--dry_run", action="store_true", help="tiny sizes, on a CPU: whether every step works")
    options = parser.parse_args()
    if options.dataset and not (Path(options.dataset) / "meta/info.json").exists():
        parser.error(f"--dataset={options.dataset} is no folder of a LeRobotDataset: it has no meta/info.json")
    if options.dry_run:
        options.device = "cpu"
        options.eval_device = "cpu"
    options.eval_device = options.eval_device or options.device
    kind = {name: getattr(options, name) for name in ("pictures", "dry_run")}
    default = "_".join(["outputs/thesis_size", *(name for name, on in kind.items() if on)])
    options.output_dir = Path(options.output_dir or default).resolve()
    begun = options.output_dir / "kind.json"
    if begun.exists() and json.loads(begun.read_text()) != kind:
        parser.error(f"--output_dir={begun.parent} holds a run with {begun.read_text()}: choose another folder")
    options.dataset = options.dataset and Path(options.dataset).resolve()
    os.chdir(ROOT)
    begun.parent.mkdir(parents=True, exist_ok=True)
    begun.write_text(json.dumps(kind))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # so that `run` ends its command, too
    return Thesis(options).main()


if __name__ == "__main__":
    sys.exit(main())
