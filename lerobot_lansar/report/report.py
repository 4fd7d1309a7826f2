"""`lansar-report`: tables, plots and a page of evaluations."""

import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import draccus

from ..command import CommandError, run_command
from .curves import read_training
from .evaluation import Evaluation, group, merge, read_part, set_labels
from .markdown import as_markdown
from .options import EvaluationConfig, ReportConfig, TableConfig, as_list, check, output_dir
from .tables import build, describe

Described = tuple[Evaluation, dict[str, Any]]
"""An evaluation and its entry in `report.json`."""


def report(config: ReportConfig) -> dict[str, Any]:
    """Writes `report.html`, `report.json` and `report.md`, and pushes the results if asked to.

    Args:
        config: The command's options.

    Returns:
        The content of `report.json`: {"title", "lerobot_policy_lansar": version, "left_out": [what a file with tables
        names and is not there], "tables": what `build` returns, "trainings": what `read_training` returns}.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is malformed, or files are of different evaluations.
        CommandError: Options contradict each other, or there is no such policy.
    """
    check(config)
    folder = output_dir(config)
    left_out: list[str] = []
    tables, described = _tables(config, left_out)
    content = {
        "title": config.title,
        "lerobot_policy_lansar": version("lerobot_policy_lansar"),
        "left_out": left_out,
        "tables": tables,
        "trainings": _trainings(config, left_out),
    }
    if not tables and not content["trainings"]:
        raise CommandError("nothing to report yet: " + "; ".join(left_out))
    if config.push_to_hub is not None and len(described) != 1:
        raise CommandError(
            f"--push_to_hub writes the results of one evaluation, but these are {len(described)}: report the one alone"
        )
    texts = {"report.json": json.dumps(content, indent=2) + "\n", "report.md": as_markdown(content)}
    from .page import as_html  # matplotlib and jinja2 take a second to import

    texts["report.html"] = as_html(content, described, folder)
    _write(folder, texts)
    if config.push_to_hub is not None:
        from .hub import push

        push(config.push_to_hub, described[0][1])
    return content


def _tables(config: ReportConfig, left_out: list[str]) -> tuple[list[dict[str, Any]], list[Described]]:
    """The tables, and every evaluation in them once; notes in `left_out` what is not there."""
    if config.tables:
        return _tables_of_file(config.tables, left_out)
    folders, policies = as_list(config.eval_dir), config.policy_path
    if not folders:
        return [], []
    per_folder = policies if isinstance(policies, list) else [policies] * len(folders)
    pairs = zip(folders, per_folder, strict=True)
    parts = [read_part(Path(name), config.seed, policy) for name, policy in pairs]
    named = sorted({part.named for part in parts if part.named is not None})
    one = all(part.weights and part.weights == parts[0].weights for part in parts)
    if isinstance(policies, str) and len(named) > 1 and not one:
        raise CommandError(
            f"--policy_path names one policy, but the evaluations name {len(named)}: {', '.join(named)}. Give a list "
            "with one for each folder of --eval_dir, or leave it out"
        )
    evaluations = group(parts)
    _name(evaluations, as_list(config.labels))
    described = [(evaluation, describe(evaluation, policies is not None)) for evaluation in evaluations]
    title = described[0][0].label if len(described) == 1 else "Comparison"
    return [build(title, described, as_list(config.published))], described


def _name(evaluations: list[Evaluation], labels: list[str]) -> None:
    if labels and len(labels) != len(evaluations):
        folders = "; ".join(" and ".join(str(part.folder) for part in e.parts) for e in evaluations)
        raise CommandError(
            f"--labels has {len(labels)} names, but there are {len(evaluations)} evaluations: {folders}. Name each"
        )
    for evaluation, label in zip(evaluations, labels, strict=False):
        evaluation.label = label
    set_labels(evaluations)


def _tables_of_file(configs: list[TableConfig], left_out: list[str]) -> tuple[list[dict[str, Any]], list[Described]]:
    """Several tables may show the same evaluation, which is then read once."""
    known: dict[tuple[Any, ...], Described] = {}

    def read(row: EvaluationConfig) -> Described:
        key = (tuple(as_list(row.eval_dir)), row.policy_path, row.seed)
        if key not in known:
            parts = [read_part(Path(name), row.seed, row.policy_path) for name in key[0]]
            evaluation = merge(parts, row.label)
            known[key] = evaluation, describe(evaluation, row.policy_path is not None)
        evaluation, entry = known[key]
        return evaluation, {**entry, "label": row.label}

    tables = []
    for table in configs:
        if not table.evaluations:
            raise CommandError(f"the table {table.title!r} names no evaluations")
        try:
            rows = [read(row) for row in table.evaluations]
        except FileNotFoundError as error:
            left_out.append(f"{table.title} ({error})")
            continue
        tables.append(build(table.title, rows, as_list(table.published), table.tasks))
    shown = {folder for table in tables for row in table["evaluations"] for folder in row["folders"]}
    return tables, [pair for pair in known.values() if shown.issuperset(pair[1]["folders"])]


def _trainings(config: ReportConfig, left_out: list[str]) -> list[dict[str, Any]]:
    """The losses of trainings; those of a file with tables may be missing."""
    found = [read_training(Path(name)) for name in as_list(config.train_dir)]
    for training in config.trainings:
        try:
            found.append(read_training(Path(training.train_dir), training.label))
        except FileNotFoundError as error:
            left_out.append(f"losses of {training.label} ({error})")
    return found


def _write(folder: Path, texts: dict[str, str]) -> None:
    """Writes files whole or not at all: each under another name first."""
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = {name: folder / f".{name}.unfinished" for name in texts}
    try:
        for name, path in unfinished.items():
            path.write_text(texts[name], encoding="utf-8")
        for name, path in unfinished.items():
            path.replace(folder / name)
    finally:
        for path in unfinished.values():
            path.unlink(missing_ok=True)


@draccus.wrap()
def run(config: ReportConfig) -> None:
    """Writes the report, prints it and says where it is."""
    print(as_markdown(report(config)))
    print(f"report.html, report.json and report.md are in {output_dir(config)}")


def main() -> int:
    """Entry point of `lansar-report`."""
    return run_command("lansar-report", run)


if __name__ == "__main__":
    sys.exit(main())
