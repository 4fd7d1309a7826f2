"""Results in a model card on the hub, as the hub's own metadata (`model-index`).

An entry says on which desk it was measured, so that results on built-in assets are never taken for CALVIN's. Entries of
other origin in the card are left as they are.
"""

import json
import tempfile
from pathlib import Path
from typing import Any

from ..benchmark import LH_MTLC
from ..calvin import TASK_GROUPS, TASKS
from ..command import CommandError
from .figures import share
from .notes import off_protocol

SOURCE = "lerobot_policy_lansar"
"""Name of the source in every entry of ours; by it a later push finds them."""

SOURCE_URL = "https://pypi.org/project/lerobot_policy_lansar"

_PROGRESS = ("episodes", "missing", "last_seed", "version")
"""Entries of `protocol` in which a finished evaluation may differ from what it was before."""

DESKS = {"original": "CALVIN's original assets", "built-in": "built-in desk, not comparable with CALVIN"}


def model_index(row: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The results of one evaluation as the hub's `model-index`.

    Args:
        row: An evaluation of `report.json`.
        name: Name of the model.
    """
    from huggingface_hub import EvalResult
    from huggingface_hub.repocard_data import eval_results_to_model_index

    assets = row["settings"]["assets"]
    desk = DESKS.get(str(assets), "unknown desk, not comparable with CALVIN")
    chains = row["kind"] != "single tasks"
    what = "CALVIN LH-MTLC" if chains else "CALVIN tasks"
    common = {
        "task_type": "robotics",
        "task_name": "long-horizon language-conditioned manipulation" if chains else "single commands",
        # The hub groups entries by type and configuration: both tell the desk.
        "dataset_type": "calvin" if assets == "original" else "calvin-built-in-desk",
        "dataset_name": f"{what}, scene {row['settings']['scene'] or 'unknown'} ({desk})",
        "dataset_config": _configuration(row),
        "dataset_args": protocol(row),
        "source_name": SOURCE,
        "source_url": SOURCE_URL,
    }
    results = [EvalResult(metric_type=kind, metric_name=text, metric_value=value, metric_args=extra, **common)  # type: ignore[arg-type]
               for kind, text, value, extra in _metrics(row)]  # fmt: skip
    return eval_results_to_model_index(name, results)


def _configuration(row: dict[str, Any]) -> str:
    """What was evaluated, in words by which the hub groups results."""
    chains = row["kind"] != "single tasks"
    tasks = LH_MTLC if chains else "all tasks" if len(row["tasks"]) == len(TASKS) else ", ".join(sorted(row["tasks"]))
    planned = row["episodes"] + (row["missing"] or 0)
    assets = f"{row['settings']['assets'] or 'unknown'} assets"
    return ", ".join([tasks, assets, f"{planned} {'chains' if chains else 'episodes'}", *off_protocol(row)])


def _metrics(row: dict[str, Any]) -> list[tuple[str, str, float, dict[str, Any] | None]]:
    """(type, name, value, arguments) of every figure in the card; rates are in percent."""
    found: list[tuple[str, str, float, dict[str, Any] | None]] = []
    if "in_a_row" in row:
        interval = row["average_length_interval"]
        found.append(("average_length", "Average length (of 5)", round(row["average_length"], 4), _interval(interval)))
        for k, (reached, interval) in enumerate(zip(row["in_a_row"], row["in_a_row_intervals"], strict=True), start=1):
            text = f"At least {k} in a row (%)"
            found.append(("success_rate", text, round(100 * reached, 2), _interval(interval, 100)))
    local = row["local_success_rate_interval"]
    text = "Success per attempted command (%)"
    found.append(("success_rate", text, round(100 * row["local_success_rate"], 2), _interval(local, 100)))
    if row["kind"] == "single tasks" and len(row["tasks"]) > 1:
        for group, tasks in TASK_GROUPS.items():
            counts = [row["tasks"][task] for task in tasks if task in row["tasks"]]
            if counts:
                one = share(sum(c["successes"] for c in counts), sum(c["attempts"] for c in counts))
                text = f"{group}: {', '.join(task for task in tasks if task in row['tasks'])} (%)"
                found.append(("success_rate", text, round(100 * one["rate"], 2), _interval(one["interval"], 100)))
    return found


def _interval(interval: list[float] | None, scale: float = 1) -> dict[str, Any] | None:
    return None if interval is None else {"interval_95": [round(scale * end, 4) for end in interval]}


def protocol(row: dict[str, Any]) -> dict[str, Any]:
    """What the figures depend on; the hub keeps it beside them. Unknown is said to be unknown."""
    state = row["policy_reads_scene_state"]
    settings = {key: "unknown" if value is None else value for key, value in row["settings"].items()}
    missing = "unknown" if row["missing"] is None else row["missing"]
    return {
        **settings,
        "episodes": row["episodes"],
        "missing": missing,
        "first_seed": row["seeds"][0],
        "last_seed": row["seeds"][1],
        "policy_reset": row["policy_reset"] or "unknown",
        "privileged_scene_state": "unknown" if state is None else state,
        "version": row["version"] or "unknown",
    }


def push(repo_id: str, row: dict[str, Any]) -> None:
    """Writes the results of one evaluation into a model's card. Pushed again, they replace the earlier ones.

    Args:
        repo_id: The model, "user/name".
        row: The evaluation of `report.json`.

    Raises:
        CommandError: There is no such model, it may not be written to, or its card is malformed.
    """
    from httpx import HTTPError
    from huggingface_hub import HfApi, metadata_load, metadata_save
    from huggingface_hub.errors import (
        EntryNotFoundError,
        HfHubHTTPError,
        HFValidationError,
        LocalEntryNotFoundError,
    )

    api = HfApi()
    with tempfile.TemporaryDirectory() as folder:
        card = Path(folder) / "README.md"
        try:
            try:
                card.write_bytes(Path(api.hf_hub_download(repo_id, "README.md")).read_bytes())
                metadata = metadata_load(card) or {}
            except LocalEntryNotFoundError:  # the hub did not answer
                raise
            except EntryNotFoundError:
                card.write_text(f"# {repo_id.rpartition('/')[2]}\n")
                metadata = {}
            merged = merge_index(metadata.get("model-index"), model_index(row, repo_id.rpartition("/")[2]))
            metadata_save(card, {**metadata, "model-index": merged})
            message = "Evaluation on the CALVIN desk"
            api.upload_file(path_or_fileobj=card, path_in_repo="README.md", repo_id=repo_id, commit_message=message)
        except (HfHubHTTPError, HFValidationError, HTTPError, OSError) as error:
            raise CommandError(
                f"--push_to_hub={repo_id}: cannot write the card of that model: {error}. It must exist, and you must "
                "be logged in (hf auth login) with a token that may write to it"
            ) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise CommandError(f"--push_to_hub={repo_id}: the header of its README.md is malformed: {error}") from error


def merge_index(old: Any, new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A card's `model-index` with our results in it: those of other tasks, assets or settings, and all others, stay.

    Args:
        old: What the card has; None if it has none.
        new: What `model_index` returned.
    """
    if not old:
        return new
    ours = {_place(result) for result in new[0]["results"]}
    first, *others = [dict(model) for model in old]
    kept = [result for result in first.get("results") or [] if _place(result) not in ours]
    return [{**first, "results": [*kept, *new[0]["results"]]}, *others]


def _place(result: dict[str, Any]) -> tuple[Any, ...]:
    """What a later push of the same evaluation has in common with an earlier one."""
    dataset, source = result.get("dataset") or {}, result.get("source") or {}
    args = {key: value for key, value in (dataset.get("args") or {}).items() if key not in _PROGRESS}
    return source.get("name"), dataset.get("type"), dataset.get("config"), json.dumps(args, sort_keys=True)
