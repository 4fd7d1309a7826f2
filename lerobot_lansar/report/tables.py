"""From evaluations to the tables of `report.json`."""

from collections.abc import Sequence
from typing import Any

from ..command import CommandError
from .episodes import SETTINGS
from .evaluation import Evaluation, agreed, kind, policy_reset
from .figures import difference, figures, share, standard_deviation
from .notes import of_evaluation, of_table
from .policy import Policy
from .published import PUBLISHED, Published


def describe(evaluation: Evaluation, policy_given: bool = False) -> dict[str, Any]:
    """An evaluation's entry in `report.json`: what it was, its figures, what must be known about it.

    Args:
        evaluation: With its label.
        policy_given: Whether the user named its policy, which must then be there.

    Returns:
        {"label", "folders", "policy", "policy_reads_scene_state", "reads", "action_steps", "trained_look",
        "policy_reset", "kind", "episodes", "expected", "missing", "missing_episodes", "ended_early", "seeds",
        "settings", "version", "facts", everything of `figures`, "notes"}. Unknown is None.

    Raises:
        CommandError: There is no such policy, and the user named it.
    """
    episodes, missing = evaluation.episodes, evaluation.missing
    policy = _policy(evaluation.policy, policy_given)
    seeds = [episode.seed for episode in episodes]
    row: dict[str, Any] = {
        "label": evaluation.label,
        "folders": [str(part.folder) for part in evaluation.parts],
        "policy": evaluation.policy,
        "policy_reads_scene_state": None if policy is None else policy.reads_scene_state,
        "reads": None if policy is None else policy.reads,
        "action_steps": None if policy is None else policy.action_steps,
        "trained_look": None if policy is None else policy.trained_look(),
        "policy_reset": policy_reset(episodes),
        "kind": kind(episodes),
        "episodes": len(episodes),
        "expected": None if missing is None else len(episodes) + len(missing),
        "missing": None if missing is None else len(missing),
        "missing_episodes": missing,
        "ended_early": sum(episode.reason is not None for episode in episodes),
        "seeds": [min(seeds), max(seeds)],
        "settings": {key: agreed(episode.settings.get(key) for episode in episodes) for key in SETTINGS},
        "version": agreed(episode.origin.get("version") for episode in episodes),
        "facts": _facts(evaluation),
        **figures(episodes),
    }
    row["notes"] = of_evaluation(row, all(part.chains_known for part in evaluation.parts))
    return row


def _policy(path: str | None, given: bool) -> Policy | None:
    """The policy, or None if it is unknown or not on this machine; one that the user named may be downloaded."""
    if path is None:
        return None
    try:
        return Policy(path, download=given)
    except CommandError:
        if given:
            raise
        return None


def _facts(evaluation: Evaluation) -> dict[str, Any]:
    """What `lansar-eval` noted of the evaluation: its commands, the hardware, the seconds of all parts."""
    facts = [part.facts for part in evaluation.parts]
    seconds = [fact.get("seconds") for fact in facts]
    return {
        "commands": [fact["command"] for fact in facts if "command" in fact],
        "hardware": agreed(fact.get("hardware") for fact in facts),
        "seconds": None if None in seconds else sum(seconds),  # type: ignore[arg-type]
    }


def build(
    title: str,
    evaluations: Sequence[tuple[Evaluation, dict[str, Any]]],
    published: Sequence[str] = (),
    tasks: bool = True,
) -> dict[str, Any]:
    """One table of `report.json`.

    Args:
        title: Its title.
        evaluations: Evaluations and what `describe` said of them. All are compared with the first.
        published: Names in `PUBLISHED`.
        tasks: Whether to show the success of each task.

    Returns:
        {"title", "notes", "show_tasks", "evaluations": what `describe` returns, "differences": what `difference`
        returns with the labels of "evaluation" and "baseline", "standard_deviation": of each share in a row over
        evaluations that differ in perturbation, else None, "published": [{"source", "rows", "standard_deviation"}]}
    """
    rows = [row for _, row in evaluations]
    first = evaluations[0][0]
    found = [(row["label"], difference(evaluation.episodes, first.episodes)) for evaluation, row in evaluations[1:]]
    perturbations = {str([r["settings"]["perturbation_every"], r["settings"]["perturbation_scale"]]) for r in rows}
    spread = len(perturbations) > 1 and all("in_a_row" in row for row in rows)
    return {
        "title": title,
        "notes": of_table(rows, bool(published)),
        "show_tasks": tasks,
        "evaluations": rows,
        "differences": [
            {"evaluation": label, "baseline": rows[0]["label"], **one} for label, one in found if one is not None
        ],
        "standard_deviation": standard_deviation(row["in_a_row"] for row in rows) if spread else None,
        "published": [published_table(name) for name in published],
    }


def published_table(name: str) -> dict[str, Any]:
    """A published table's entry in `report.json`."""
    table = PUBLISHED[name]
    return {
        "source": table.source,
        "rows": [_published_row(row) for row in table.rows],
        "standard_deviation": standard_deviation(row.in_a_row for row in table.rows) if table.spread else None,
    }


def _published_row(row: Published) -> dict[str, Any]:
    found: dict[str, Any] = {
        "label": f"{row.label}, {row.split}" if row.split else row.label,
        "reads": list(row.reads),
        "in_a_row": list(row.in_a_row),
        "average_length": row.average_length,
        "tasks": {task: share(*counts) for task, counts in row.tasks.items()},
    }
    if row.tasks:
        counts = row.tasks.values()
        found["local_success_rate"] = sum(s for s, _ in counts) / sum(n for _, n in counts)
    return found
