"""The report as one HTML page that needs nothing else: no network, no script to be read."""

import os
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2

from ..benchmark import load_chains
from ..calvin import CHAIN_LENGTH, TASKS
from . import plots
from .cells import (
    DIFFERENCE_HEADER,
    IN_A_ROW_HEADER,
    INTERVALS,
    difference_rows,
    distinct,
    facts,
    in_a_row_rows,
    mistakes,
    task_rows,
)
from .episodes import Episode
from .evaluation import Evaluation
from .notes import grouped, missing_text

FILES = Path(__file__).parent / "page_files"
"""The page's template, style and script."""


def as_html(report: dict[str, Any], described: list[tuple[Evaluation, dict[str, Any]]], folder: Path) -> str:
    """The page.

    Args:
        report: The content of `report.json`.
        described: Every evaluation once, with its entry there.
        folder: Where the page will lie; links to videos are relative to it.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FILES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    rows = episode_rows([evaluation for evaluation, _ in described], folder)
    return environment.get_template("page.html").render(
        report=report,
        evaluations=[{**row, "missing_text": missing_text(row)} for row in distinct(report)],
        notes=grouped(distinct(report)),
        fact_names=_fact_names(distinct(report)),
        tables=[_table(table, number) for number, table in enumerate(report["tables"], start=1)],
        losses=plots.plot_losses(report["trainings"], "losses") if report["trainings"] else "",
        intervals=INTERVALS,
        labels=[row["label"] for _, row in described],
        what="Chains" if all(row["kind"] == "chains" for _, row in described) else "Episodes",
        rows=rows,
        tasks=sorted({task for row in rows for task, _, _ in row["commands"]}, key=list(TASKS).index),
        most=max((row["most"] for row in rows), default=0),
    )


def _fact_names(evaluations: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """(name, value of each evaluation) of everything that is known of any of them."""
    known = [dict(facts(row)) for row in evaluations]
    names = dict.fromkeys(name for each in known for name in each)
    return [(name, [each.get(name, "unknown") for each in known]) for name in names]


def _table(table: dict[str, Any], number: int) -> dict[str, Any]:
    """What the template shows of a table."""
    shares = in_a_row_rows(table)
    tasks = table["show_tasks"] or not shares
    return {
        "table": table,
        "in_a_row": (IN_A_ROW_HEADER, shares) if shares else None,
        "in_a_row_plot": plots.plot_in_a_row(table, f"in-a-row-{number}") if shares else "",
        "differences": (DIFFERENCE_HEADER, difference_rows(table)) if table["differences"] else None,
        "tasks": task_rows(table) if tasks else None,
        "tasks_plot": plots.plot_tasks(table, f"tasks-{number}") if tasks else "",
        "told": [
            (row["label"], mistakes(row), plots.plot_told(row, f"told-{number}-{i}"))
            for i, row in enumerate(table["evaluations"])
            if tasks and "told" in row
        ],
    }


def episode_rows(evaluations: list[Evaluation], folder: Path) -> list[dict[str, Any]]:
    """Every chain, or episode of a single task, with its outcome in each evaluation; those that failed most first.

    Returns:
        [{"name": number of the chain, or its seed, "commands": [(task, mark, steps)], "cells": [outcome in each
        evaluation or None], "verdicts": the outcomes for the filter, "most": commands at most}]. Marks and steps stand
        with the commands where there is one evaluation, else in the cells.
    """
    found: dict[tuple[Any, ...], list[Episode | None]] = {}
    for i, evaluation in enumerate(evaluations):
        seen: Counter[tuple[Any, ...]] = Counter()
        for episode in evaluation.episodes:
            key = (episode.suite, episode.seed if episode.chain is None else episode.chain)
            found.setdefault((*key, seen[key]), [None] * len(evaluations))[i] = episode
            seen[key] += 1
    rows = [_row(key, episodes, evaluations, folder) for key, episodes in found.items()]
    return sorted(rows, key=lambda row: row["order"])


def _row(
    key: tuple[Any, ...], episodes: list[Episode | None], evaluations: list[Evaluation], folder: Path
) -> dict[str, Any]:
    there = [episode for episode in episodes if episode is not None]
    tasks, alone = _commands(there), len(episodes) == 1
    marks = _marks(there[0]) if alone else []
    marks += [("", "")] * (len(tasks) - len(marks))
    verdicts = [f"{episode.successes} of {len(tasks)}" for episode in there]
    flags = ["early"] * any(episode.reason for episode in there) + ["differ"] * (len(set(verdicts)) > 1)
    return {
        "name": key[1],
        "commands": [(task, *mark) for task, mark in zip(tasks, marks, strict=True)],
        "cells": [
            _cell(episode, len(tasks), e, folder, alone) for episode, e in zip(episodes, evaluations, strict=True)
        ],
        "verdicts": " ".join([*dict.fromkeys(str(episode.successes) for episode in there), *flags]),
        "most": len(tasks),
        "order": (sum(episode.successes for episode in there) / len(there), key[0], key[1], key[2]),
    }


def _commands(episodes: list[Episode]) -> list[str]:
    """The tasks of a chain, also those that no one attempted."""
    attempted = max(([task for task, _ in episode.commands] for episode in episodes), key=len)
    chain = episodes[0].chain
    if chain is not None and chain < len(load_chains()):
        all_five = list(load_chains()[chain].tasks)
        if len(all_five) == CHAIN_LENGTH and all_five[: len(attempted)] == attempted:
            return all_five
    return attempted


def _marks(episode: Episode) -> list[tuple[str, str]]:
    """(mark, steps) of each attempted command."""
    steps = [str(count) for count in episode.steps] or [""] * len(episode.commands)
    return [("✓" if fulfilled else "✗", count) for (_, fulfilled), count in zip(episode.commands, steps, strict=True)]


def _cell(
    episode: Episode | None, commands: int, evaluation: Evaluation, folder: Path, alone: bool
) -> dict[str, Any] | None:
    if episode is None:
        return None
    video = evaluation.videos.get(episode.key)
    link = None if video is None else quote(os.path.relpath(video, folder).replace(os.sep, "/"))
    return {
        "verdict": f"{episode.successes} of {commands}",
        "steps": "" if alone else " ".join(f"{mark}\u00a0{steps}".strip() for mark, steps in _marks(episode)),
        "reason": episode.reason,
        "video": link,
    }
