"""`lansar-report`: the tables and plots of one evaluation."""

import json
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import draccus

from ..benchmark import EPISODES_FILE, load_chains
from ..command import run_command
from .policy import Policy, differences
from .results import DEFAULT_SEED, collect, read_eval_info, read_lines, summarise


@dataclass
class ReportConfig:
    """Success rates of one evaluation on the CALVIN desk, printed and saved with two plots."""

    # Folder of eval_info.json: --output_dir of the lerobot-eval run.
    eval_dir: Path
    # Where to write report.json, report.md and the plots; eval_dir by default.
    output_dir: Path | None = None
    # Folder of episodes.jsonl: --env.results_dir of that run; eval_dir by default.
    results_dir: Path | None = None
    # Seed of that run; by default the smallest seed in episodes.jsonl, or LeRobot's default, 1000.
    seed: int | None = None
    # Policy of that run (--policy.path), a folder or a name on the hub. With it, the report states whether the policy
    # reads the simulator's own state, and whether it was evaluated in the look of its dataset.
    policy_path: str | None = None


def report(config: ReportConfig) -> dict[str, Any]:
    """Writes `report.json`, `report.md`, `tasks.png` and, for chains, `in_a_row.png`.

    Args:
        config: The command's options.

    Returns:
        The content of `report.json`: what `summarise` returns, notes and the package's version.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is malformed, or the files are of different evaluations.
        CommandError: There is no policy at `policy_path`.
    """
    results_dir = config.results_dir or config.eval_dir
    if not results_dir.is_dir():
        raise FileNotFoundError(f"--results_dir={results_dir} is not a folder")
    entries, lines = read_eval_info(config.eval_dir), read_lines(results_dir)
    if config.results_dir and not lines:
        raise FileNotFoundError(f"--results_dir={results_dir} holds no {EPISODES_FILE}")
    summary = summarise(collect(entries, lines, config.seed))
    policy = None if config.policy_path is None else Policy(config.policy_path)
    summary["policy_reads_scene_state"] = None if policy is None else policy.reads_scene_state
    summary["trained_look"] = None if policy is None else policy.trained_look()
    summary["notes"] = _notes(summary, chains_known=config.seed is not None or bool(lines))
    summary["lerobot_policy_lansar"] = version("lerobot_policy_lansar")

    output_dir = config.output_dir or config.eval_dir
    output_dir.mkdir(parents=True, exist_ok=True)
    (output_dir / "report.json").write_text(json.dumps(summary, indent=2) + "\n")
    (output_dir / "report.md").write_text(as_markdown(summary))
    from .plots import plot_in_a_row, plot_tasks  # matplotlib takes a second to import

    plot_tasks(summary, output_dir / "tasks.png")
    if "in_a_row" in summary:
        plot_in_a_row(summary, output_dir / "in_a_row.png")
    return summary


def _notes(summary: dict[str, Any], chains_known: bool) -> list[str]:
    """What a reader must know; without `chains_known`, the chains follow from LeRobot's default seed."""
    notes = []
    assets = summary["settings"]["assets"]
    if assets != "original":
        desk = "the built-in desk" if assets == "built-in" else "a desk that the files do not name"
        notes.append(f"Measured on {desk}: not comparable with published CALVIN numbers.")
    if summary["policy_reads_scene_state"]:
        notes.append("The policy reads the simulator's own scene state (privileged), which a real robot does not have.")
    elif summary["policy_reads_scene_state"] is None:
        notes.append("Whether the policy reads privileged scene state is unknown: give --policy_path.")
    other_look = differences(summary["trained_look"] or {}, summary["settings"])
    if other_look is not None:
        notes.append(f"The policy was trained on pictures of another look than it was evaluated on: {other_look}.")
    if summary["ended_early"]:
        notes.append(
            f"{summary['ended_early']} episodes failed because the desk refused an action or the simulation diverged: "
            f"see `reason` in {EPISODES_FILE}."
        )
    if "in_a_row" in summary and not chains_known:
        notes.append(
            "The files do not say which chains these are: success per task is right only if --seed was "
            f"{DEFAULT_SEED}, LeRobot's default. Give lansar-report the --seed of the evaluation."
        )
    if "in_a_row" in summary and summary["episodes"] < len(load_chains()):
        notes.append(f"{summary['episodes']} of the benchmark's {len(load_chains())} chains.")
    return notes


def as_markdown(summary: dict[str, Any]) -> str:
    """The report as text.

    Args:
        summary: What `report` returns.
    """
    known = {key: value for key, value in summary["settings"].items() if value is not None}
    first, last = summary["seeds"]
    facts = [f"{summary['episodes']} episodes", f"seeds {first} to {last}"]
    facts += [f"{key.replace('_', ' ')} {value}" for key, value in known.items()]
    lines = ["# Evaluation on the CALVIN desk", "", "; ".join(facts) + ".", ""]
    lines += [f"* {note}" for note in summary["notes"]]
    if "in_a_row" in summary:
        shares = " | ".join(f"{100 * share:.1f} %" for share in summary["in_a_row"])
        lines += ["", "| in a row | 1 | 2 | 3 | 4 | 5 | average length |", "| --- " * 7 + "|"]
        lines += [f"| chains | {shares} | {summary['average_length']:.3f} |"]
    width = max(len(task) for task in summary["tasks"])
    lines += [
        "",
        f"| {'task':{width}} | successes | attempts | rate    |",
        f"| {'-' * width} | --------- | -------- | ------- |",
    ]
    for task, c in summary["tasks"].items():
        lines.append(f"| {task:{width}} | {c['successes']:9} | {c['attempts']:8} | {100 * c['rate']:5.1f} % |")
    lines += [
        "",
        f"Local success rate (all attempted commands): {100 * summary['local_success_rate']:.2f} %",
        "",
    ]
    return "\n".join(lines)


@draccus.wrap()
def run(config: ReportConfig) -> None:
    """Writes the report, prints it and says where it is."""
    print(as_markdown(report(config)))
    print(f"report.json, report.md and the plots are in {config.output_dir or config.eval_dir}")


def main() -> int:
    """Entry point of `lansar-report`."""
    return run_command("lansar-report", run)


if __name__ == "__main__":
    sys.exit(main())
