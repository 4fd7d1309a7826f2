"""From demonstrations to success rates: record, convert, train, evaluate, report. Run by `make quickstart`.

Every step is an installed command, printed before it runs, so each can be repeated by hand. A step whose result exists
is skipped. The last result is outputs/quickstart/summary.json.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
DATA = Path("data/quickstart")
OUT = Path("outputs/quickstart")
CONFIG = "configs/lansar.yaml"
UPDATES = 1500
TASKS = [
    "open_drawer",
    "close_drawer",
    "move_slider_left",
    "move_slider_right",
    "turn_on_lightbulb",
    "turn_off_lightbulb",
    "turn_on_led",
    "turn_off_led",
    "lift_red_block_table",
]
HARD = ["open_drawer", "lift_red_block_table"]  # recorded twice as often as the others
EPISODES_PER_TASK = 10
EVALUATION_SEED = 100_000  # far from the seed of the demonstrations: none of these starts was recorded


def run(title: str, *command: object, log: Path | None = None) -> None:
    """Runs an installed command from the repository's root; its output goes to `log` if given.

    Raises:
        QuickstartError: The command failed.
    """
    words = [str(word) for word in command]
    print(f"\n=== {title}{f' (output in {log})' if log else ''}\n$ {shlex.join(words)}", flush=True)
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "WANDB_MODE": "disabled",
        "OMP_NUM_THREADS": "1",  # matrices this small gain nothing from a second thread
    }
    started = time.time()
    with open(log or os.devnull, "a") as file:
        output = file if log else None
        done = subprocess.run(
            [str(BIN / words[0]), *words[1:]], cwd=ROOT, env=environment, stdout=output, stderr=output
        )
    if done.returncode:
        raise QuickstartError(
            f"quickstart stopped: `{words[0]}` ended with exit code {done.returncode}; see "
            f"{log if log else 'its message above'}"
        )
    print(f"--- {title}: {time.time() - started:.0f} s", flush=True)


class QuickstartError(Exception):
    """A step failed."""


def record_and_convert() -> None:
    """Records demonstrations without pictures (this policy reads state and language), then converts them."""
    if not (DATA / "validation").exists():
        run(
            "record demonstrations",
            "lansar-record",
            "--scene=D",
            f"--tasks=[{','.join(TASKS + HARD)}]",
            "--episodes=1320",
            "--validation_episodes=55",
            "--cameras=[]",
            "--variety=0.3",
            "--seed=0",
            "--workers=2",
            f"--output_dir={DATA}",
        )
    if not (DATA / "lerobot").exists():
        run(
            "convert to a LeRobotDataset",
            "lansar-convert",
            f"--root={DATA}",
            "--split=training",
            "--repo_id=lansar/quickstart",
            "--images=none",
            "--workers=2",
            f"--output_dir={DATA / 'lerobot'}",
        )


def train(name: str, *options: str, log: Path | None = None) -> Path:
    """Trains with the recommended configuration; returns the checkpoint."""
    checkpoint = OUT / name / "checkpoints" / "last" / "pretrained_model"
    if not checkpoint.exists():
        shutil.rmtree(OUT / name, ignore_errors=True)  # LeRobot refuses the folder of an interrupted run
        shutil.rmtree(OUT / f"eval_{name}", ignore_errors=True)  # evaluated an earlier checkpoint
        run(
            f"train ({name})",
            "lerobot-train",
            f"--config_path={CONFIG}",
            "--dataset.repo_id=lansar/quickstart",
            f"--dataset.root={DATA / 'lerobot'}",
            f"--output_dir={OUT / name}",
            *options,
            log=log,
        )
    return checkpoint


def evaluate(name: str, checkpoint: Path, *options: str, log: Path | None = None) -> Path:
    """Evaluates every task from unseen starts and writes the report; returns the evaluation's folder."""
    folder = OUT / f"eval_{name}"
    if not (folder / "eval_info.json").exists():
        run(
            f"evaluate ({name})",
            "lansar-eval",
            f"--policy.path={checkpoint}",
            "--env.type=calvin",
            f"--env.task={','.join(TASKS)}",
            "--env.control_mode=abs",
            "--env.cameras=[]",
            "--env.render_fps=6",
            f"--eval.n_episodes={EPISODES_PER_TASK}",
            f"--seed={EVALUATION_SEED}",
            f"--output_dir={folder}",
            *options,
            log=log,
        )
    run(f"report ({name})", "lansar-report", f"--eval_dir={folder}", log=log)
    return folder


def untrained() -> Path:
    """Evaluates the same network with random weights: one update with learning rate 0 makes the checkpoint."""
    log = OUT / "untrained.log"
    checkpoint = train("untrained", "--steps=1", "--policy.learning_rate=0", log=log)
    return evaluate("untrained", checkpoint, "--workers=1", log=log)  # training uses the other core


def success(folder: Path) -> dict[str, dict[str, float]]:
    """Number of episodes and success rate of every task, from LeRobot's eval_info.json."""
    info = json.loads((folder / "eval_info.json").read_text())
    rates = {}
    for entry in info["per_task"]:
        successes = entry["metrics"]["successes"]
        rates[entry["task_group"]] = {
            "episodes": len(successes),
            "success_rate": sum(successes) / len(successes),
        }
    return rates


def total(tasks: dict[str, dict[str, float]]) -> dict[str, float]:
    """Number of episodes and success rate over all tasks."""
    episodes = sum(task["episodes"] for task in tasks.values())
    solved = sum(task["episodes"] * task["success_rate"] for task in tasks.values())
    return {"episodes": int(episodes), "success_rate": round(solved / episodes, 4)}


def main() -> None:
    """Runs all steps and writes the summary."""
    os.chdir(ROOT)
    started = time.time()
    record_and_convert()
    OUT.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(1) as other_core:  # training uses one core; the comparison runs beside it
        comparison = other_core.submit(untrained)
        trained = evaluate("trained", train("trained", f"--steps={UPDATES}", f"--save_freq={UPDATES}"))
        compared = comparison.result()
    tasks = success(trained)
    summary = {
        "trained": total(tasks),
        "untrained": total(success(compared)),
        "tasks": tasks,
        "minutes": round((time.time() - started) / 60, 1),
    }
    file = OUT / "summary.json"
    if file.exists():  # a repeated run skips finished steps: keep the time of the run that did the work
        summary["minutes"] = max(summary["minutes"], json.loads(file.read_text())["minutes"])
    file.write_text(json.dumps(summary, indent=2) + "\n")
    print(f"\n{json.dumps(summary, indent=2)}\n\nsummary: {file}")
    print(f"report with plots and videos, to open in a browser: {trained}/report.html")
    print("Built-in desk, state and language policy: these are not CALVIN benchmark numbers.")


if __name__ == "__main__":
    try:
        main()
    except QuickstartError as error:
        sys.exit(str(error))
