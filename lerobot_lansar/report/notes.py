"""What a reader must know beside the figures, in sentences."""

from typing import Any

from ..benchmark import EPISODES_FILE, load_chains
from ..calvin import STEPS_PER_COMMAND
from .episodes import DEFAULT_SEED
from .policy import differences

PROTOCOL = {
    "scene": "D",
    "steps_per_command": STEPS_PER_COMMAND,
    "sentence": "first",
    "perturbation_every": 0,
}
"""Settings of CALVIN's long-horizon benchmark."""


def missing_text(row: dict[str, Any]) -> str:
    """How many episodes an evaluation lacks: "12 of 1000 chains missing".

    Args:
        row: An evaluation of `report.json`.
    """
    count = row["episodes"] if row["missing"] is None else row["expected"]
    what = ("chain" if row["kind"] == "chains" else "episode") + "s" * (count != 1)
    if row["missing"] is None:
        return f"{row['episodes']} {what}; how many are missing is unknown, since no file says how many were asked for"
    return f"{row['missing']} of {row['expected']} {what} missing"


def of_evaluation(row: dict[str, Any], chains_known: bool) -> list[str]:
    """Notes on one evaluation.

    Args:
        row: The evaluation of `report.json`, without its notes.
        chains_known: Whether files or options say which chains these are; else LeRobot's default seed is supposed.
    """
    return [
        *_assets(row["settings"]["assets"]),
        *_policy(row),
        *_policy_reset(row),
        *_episodes(row, chains_known),
    ]


def _assets(assets: Any) -> list[str]:
    if assets == "original":
        return []
    desk = "the built-in desk" if assets == "built-in" else "a desk that the files do not name"
    if isinstance(assets, list):
        desk = f"several desks ({', '.join(assets)})"
    return [f"Measured on {desk}: not comparable with published CALVIN numbers."]


def _policy(row: dict[str, Any]) -> list[str]:
    notes = []
    if row["policy_reads_scene_state"]:
        notes.append("The policy reads the simulator's own scene state (privileged), which a real robot does not have.")
    elif row["policy_reads_scene_state"] is None:
        notes.append("Whether the policy reads privileged scene state is unknown: give --policy_path.")
    other_look = differences(row["trained_look"] or {}, row["settings"])
    if other_look is not None:
        notes.append(f"The policy was trained on pictures of another look than it was evaluated on: {other_look}.")
    return notes


def _policy_reset(row: dict[str, Any]) -> list[str]:
    if row["kind"] == "single tasks" or row["policy_reset"] == "command":
        return []
    if row["policy_reset"] != "batch":
        return ["Whether the policy was reset at each command, as in CALVIN's benchmark, is unknown."]
    note = "The policy was reset once per batch, not at each command as in CALVIN's benchmark"
    steps = row["action_steps"]
    if steps is None:
        return [f"{note}: if it predicts several actions at once, it carried out stale ones after a fulfilled command."]
    if steps > 1:
        return [f"{note}: it carried out up to {steps - 1} stale actions after each fulfilled command."]
    return [f"{note}; it predicts one action at a time, so none was stale."]


def _episodes(row: dict[str, Any], chains_known: bool) -> list[str]:
    notes = []
    several = [key for key, value in row["settings"].items() if isinstance(value, list)]
    if several:
        notes.append(f"Its episodes were not all run alike: see {', '.join(several)}.")
    if row["missing"] and row["kind"] != "single tasks":
        notes.append(
            "Not finished: chains that fail soon are over before those that go on, so the average length will rise."
        )
    early = row["ended_early"]
    if early:
        notes.append(
            f"{early} episode{'s' if early > 1 else ''} failed because the desk refused an action or the simulation "
            f"diverged: see `reason` in {EPISODES_FILE}."
        )
    if row["kind"] == "single tasks":
        return notes
    if not chains_known:
        notes.append(
            "The files do not say which chains these are: success per task is right only if --seed was "
            f"{DEFAULT_SEED}, LeRobot's default. Give lansar-report the --seed of the evaluation."
        )
    if row["kind"] == "both":
        notes.append("Success of each task is over chains and single tasks together; in a row is over chains only.")
    elif row["episodes"] < len(load_chains()):
        notes.append(f"{row['episodes']} of the benchmark's {len(load_chains())} chains.")
    other = off_protocol(row)
    if other:
        notes.append(f"Not CALVIN's protocol: {', '.join(other)}.")
    return notes


def off_protocol(row: dict[str, Any]) -> list[str]:
    """The settings of an evaluation that are not those of CALVIN's benchmark, such as "sentence random"."""
    return [
        f"{key.replace('_', ' ')} {row['settings'][key]}"
        for key, value in PROTOCOL.items()
        if row["settings"][key] not in (None, value)
    ]


def grouped(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """The notes of several evaluations, each once: (labels of those it is about, note)."""
    found: dict[str, list[str]] = {}
    for row in rows:
        for note in row["notes"]:
            found.setdefault(note, []).append(row["label"])
    return [("; ".join(labels), note) for note, labels in found.items()]


def of_table(rows: list[dict[str, Any]], published: bool) -> list[str]:
    """What stands right above a table.

    Args:
        rows: The evaluations of a table of `report.json`.
        published: Whether published rows are printed beside.
    """
    notes = []
    foreign = [row for row in rows if row["settings"]["assets"] != "original"]
    if published and foreign:
        known = all(row["settings"]["assets"] == "built-in" for row in foreign)
        notes.append(
            "Not comparable: published rows were measured on CALVIN's original assets, but "
            f"{'; '.join(row['label'] for row in foreign)} on {'the built-in desk' if known else 'another desk'}."
        )
    privileged = [row["label"] for row in rows if row["policy_reads_scene_state"]]
    if privileged and (published or len(rows) > 1):
        verb = "read" if len(privileged) > 1 else "reads"
        notes.append(f"Privileged: {'; '.join(privileged)} {verb} the simulator's own scene state.")
    differing = [
        f"{key.replace('_', ' ')} ({', '.join(str(row['settings'][key]) for row in rows)})"
        for key in rows[0]["settings"]
        if len({str(row["settings"][key]) for row in rows}) > 1
    ]
    if len({str(row["policy_reset"]) for row in rows}) > 1:
        differing.append(f"policy reset at each ({', '.join(str(row['policy_reset'] or 'unknown') for row in rows)})")
    if differing:
        notes.append(f"The evaluations differ in {'; '.join(differing)}.")
    unknown = [row for row in rows if row["policy"] is None]
    if len(unknown) > 1 and len({str(row["settings"]) for row in unknown}) == 1:
        notes.append(
            f"{' and '.join(row['label'] for row in unknown)} are compared since their files do not name their "
            "policies; if they are parts of one evaluation, give --policy_path and they are merged."
        )
    return notes
