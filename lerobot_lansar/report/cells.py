"""What stands in the cells of a report's tables, for its text and its page alike."""

from collections.abc import Sequence
from typing import Any

from ..calvin import CHAIN_LENGTH
from .figures import NOTHING

INTERVALS = (
    "In brackets: 95 % intervals. Shares have Wilson's, which takes attempts as independent; averages and differences "
    "have a percentile bootstrap over chains. They tell what the choice of chains leaves open, not what another "
    "training would change."
)


def percent(share: float, digits: int = 1) -> str:
    """A share in percent, without the sign."""
    return f"{100 * share:.{digits}f}"


def bracket(interval: Sequence[float] | None, scale: float = 1, digits: int = 2, sign: str = "") -> str:
    """An interval in brackets; empty if there is none."""
    if interval is None:
        return ""
    low, high = (number(scale * end, digits, sign) for end in interval)
    return f" [{low}, {high}]"


def number(value: float, digits: int, sign: str = "+") -> str:
    """A number with a minus sign, not a hyphen; also with a plus sign unless `sign` is empty."""
    return format(value, f"{sign}.{digits}f").replace("-", "−")


def share_text(share: float, interval: Sequence[float] | None) -> str:
    """A share in percent with its interval."""
    return percent(share) + bracket(interval, 100, 1)


def length_text(row: dict[str, Any]) -> str:
    """The average length of a row with its interval."""
    return f"{row['average_length']:.3f}" + bracket(row.get("average_length_interval"))


def facts(row: dict[str, Any]) -> list[tuple[str, str]]:
    """What an evaluation was, as (name, value); what is unknown is left out or said to be."""
    settings = {key: value for key, value in row["settings"].items() if value is not None}
    first, last = row["seeds"]
    found = [
        ("episodes", str(row["episodes"])),
        ("seeds", f"{first} to {last}"),
        ("policy", row["policy"] or "unknown"),
        ("reads", "unknown" if row["reads"] is None else ", ".join(row["reads"]) or "nothing beside language"),
    ]
    if row["kind"] != "single tasks":
        found.append(
            (
                "policy reset",
                {"command": "at each command", "batch": "once per batch"}.get(str(row["policy_reset"]), "unknown"),
            )
        )
    found += [(key.replace("_", " "), _value(value)) for key, value in settings.items()]
    if row["version"] is not None:
        found.append(("version", _value(row["version"])))
    if row["facts"]["hardware"] is not None:
        found.append(("hardware", _value(row["facts"]["hardware"])))
    if row["facts"]["seconds"] is not None:
        found.append(("minutes", f"{row['facts']['seconds'] / 60:.1f}"))
    found += [("command", command) for command in row["facts"]["commands"]]
    found.append(("folder", ", ".join(row["folders"])))
    return found


def _value(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def in_a_row_rows(table: dict[str, Any]) -> list[list[str]]:
    """Cells of the table of success in a row: ours, then published ones. Empty if no evaluation has chains."""
    rows = []
    for row in table["evaluations"]:
        if "in_a_row" not in row:
            continue
        shares = [share_text(*pair) for pair in zip(row["in_a_row"], row["in_a_row_intervals"], strict=True)]
        local = share_text(row["local_success_rate"], row["local_success_rate_interval"])
        rows.append([row["label"], *shares, length_text(row), local, ", ".join(row["reads"] or ["unknown"])])
    if table["standard_deviation"] is not None:
        rows.append(["standard deviation", *(percent(s, 4) for s in table["standard_deviation"]), "", "", ""])
    for published in table["published"]:
        for row in published["rows"]:
            local = percent(row["local_success_rate"], 2) if "local_success_rate" in row else ""
            shares = [percent(share, 2) for share in row["in_a_row"]]
            name = f"published: {row['label']}"
            rows.append([name, *shares, f"{row['average_length']:.2f}", local, ", ".join(row["reads"])])
        if published["standard_deviation"] is not None:
            spread = [percent(s, 4) for s in published["standard_deviation"]]
            rows.append(["published: standard deviation", *spread, "", "", ""])
    return rows


IN_A_ROW_HEADER = [
    "in a row, % of chains",
    *map(str, range(1, CHAIN_LENGTH + 1)),
    "average length",
    "local success, %",
    "reads",
]


def difference_rows(table: dict[str, Any]) -> list[list[str]]:
    """Cells of the table of paired differences."""
    rows = []
    for one in table["differences"]:
        pairs = zip(one["in_a_row"], one["in_a_row_intervals"], strict=True)
        shares = [number(100 * share, 1) + bracket(interval, 100, 1, "+") for share, interval in pairs]
        length = number(one["average_length"], 3) + bracket(one["average_length_interval"], 1, 2, "+")
        rows.append([f"{one['evaluation']} − {one['baseline']}", *shares, length, str(one["chains"])])
    return rows


DIFFERENCE_HEADER = ["difference, points", *map(str, range(1, CHAIN_LENGTH + 1)), "average length", "chains compared"]


def task_rows(table: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and cells of the success of each task, in the first evaluation's order; published ones last."""
    columns = [(row["label"], row["tasks"]) for row in table["evaluations"]]
    for published in table["published"]:
        columns += [(f"published: {row['label']}", row["tasks"]) for row in published["rows"] if row["tasks"]]
    names = list(dict.fromkeys(task for _, tasks in columns for task in tasks))
    return ["task, %", *(label for label, _ in columns)], [
        [name, *(_task_cell(tasks.get(name)) for _, tasks in columns)] for name in names
    ]


def _task_cell(counts: dict[str, Any] | None) -> str:
    if counts is None:
        return "not attempted"
    return f"{share_text(counts['rate'], counts['interval'])} ({counts['successes']} of {counts['attempts']})"


def mistakes(row: dict[str, Any], most: int = 5) -> str:
    """What became of an evaluation's commands, in a sentence with the most frequent mistakes.

    Args:
        row: An evaluation of `report.json` with "told".
        most: How many mistakes to name.
    """
    told = row["told"]
    counts = {(task, name): count for task, done in told.items() for name, count in done.items() if name != task}
    total = sum(sum(done.values()) for done in told.values())
    nothing = sum(count for (_, name), count in counts.items() if name == NOTHING)
    wrong = {pair: count for pair, count in counts.items() if pair[1] != NOTHING}
    text = f"of {total} commands {total - sum(counts.values())} were carried out, {nothing} led to nothing and "
    text += f"{sum(wrong.values())} to another task first"
    most_often = sorted(wrong.items(), key=lambda item: (-item[1], item[0]))[:most]
    named = ", ".join(f"{name} instead of {task} ({count})" for (task, name), count in most_often)
    return f"{text}; most often {named}" if named else text


def distinct(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Every evaluation once, under its first label, although several tables may show it."""
    found: dict[tuple[str, ...], dict[str, Any]] = {}
    for table in report["tables"]:
        for row in table["evaluations"]:
            found.setdefault(tuple(row["folders"]), row)
    return list(found.values())
