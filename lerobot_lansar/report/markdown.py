"""The report as text: Markdown that also reads well in a terminal."""

from collections.abc import Iterable, Sequence
from typing import Any

from .cells import (
    DIFFERENCE_HEADER,
    IN_A_ROW_HEADER,
    INTERVALS,
    bracket,
    difference_rows,
    distinct,
    facts,
    in_a_row_rows,
    mistakes,
    task_rows,
)
from .notes import grouped, missing_text


def as_markdown(report: dict[str, Any]) -> str:
    """The report as text.

    Args:
        report: The content of `report.json`.
    """
    lines = [f"# {report['title']}", ""]
    lines += [f"* {row['label']}: {missing_text(row)}" for row in distinct(report)]
    lines += [f"* Left out: {note}" for note in report["left_out"]]
    for table in report["tables"]:
        lines += ["", f"## {table['title']}", "", *_table(table)]
    for training in report["trainings"]:
        lines += ["", f"## Losses of {training['label']}", "", f"From {training['source']}."]
        for name, key in (("training", "training"), ("held out", "held_out")):
            if training[key]:
                update, loss = training[key][-1]
                last = "not finite" if loss is None else f"{loss:.4g}"
                lines.append(f"* {name}: {len(training[key])} values, the last {last} at update {update}")
    return "\n".join(lines) + "\n"


def _table(table: dict[str, Any]) -> list[str]:
    lines = [f"* {note}" for note in table["notes"]]
    several = len(table["evaluations"]) > 1
    lines += [f"* {labels}: {note}" if several else f"* {note}" for labels, note in grouped(table["evaluations"])]
    for row in table["evaluations"]:
        prefix = f"{row['label']}: " if several else ""
        lines.append(f"* {prefix}" + "; ".join(f"{name} {value}" for name, value in facts(row)) + ".")
    shares = in_a_row_rows(table)
    if shares:
        lines += ["", *grid(IN_A_ROW_HEADER, shares)]
    if table["differences"]:
        lines += ["", *grid(DIFFERENCE_HEADER, difference_rows(table))]
    if table["show_tasks"] or not shares:
        lines += ["", *grid(*task_rows(table)), ""]
        for row in table["evaluations"]:
            local = f"{100 * row['local_success_rate']:.2f} %" + bracket(row["local_success_rate_interval"], 100, 1)
            lines.append(f"* {row['label']}: local success rate (all attempted commands) {local}")
        lines += [f"* {row['label']}: {mistakes(row)}" for row in table["evaluations"] if "told" in row]
    lines += [f"* published: {published['source']}" for published in table["published"]]
    return [*lines, "", INTERVALS]


def grid(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table with columns of one width."""
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in [header, *rows]]
    widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(header))]
    lines = [
        "| " + " | ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    return [lines[0], "| " + " | ".join("-" * width for width in widths) + " |", *lines[1:]]
