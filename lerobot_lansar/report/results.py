"""From the files of an evaluation to success rates.

LeRobot's `eval_info.json` is enough: an episode's sum of rewards is the number of commands that it fulfilled in a row,
and its chain follows from its seed. If the environment wrote `episodes.jsonl` too (`--env.results_dir`), those lines
tell which commands were attempted and under which settings, and are checked against `eval_info.json`.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..benchmark import EPISODES_FILE, LH_MTLC, load_chains
from ..calvin import CHAIN_LENGTH, TASK_GROUPS, TASKS

DEFAULT_SEED = 1000
"""LeRobot's own default of `--seed`."""

SETTINGS = (
    "scene",
    "assets",
    "renderer",
    "image_size",
    "control_mode",
    "steps_per_command",
    "sentence",
    "perturbation_every",
    "perturbation_scale",
)
"""Entries of an episode's line that say how it was run; older lines may lack some."""


@dataclass
class Episode:
    """The commands one episode attempted, in order.

    Attributes:
        commands: (task name, whether it was fulfilled) of each; all but the last were.
        seed: The episode's reset seed.
        chain: Number of the chain, or None for a single task.
        settings: The known ones of `SETTINGS`.
        reason: Why it ended before its time: an action that the desk refused, or a simulation that diverged.
    """

    commands: list[tuple[str, bool]]
    seed: int
    chain: int | None
    settings: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None

    @property
    def successes(self) -> int:
        """How many commands were fulfilled."""
        return sum(fulfilled for _, fulfilled in self.commands)


def read_eval_info(eval_dir: Path) -> list[dict[str, Any]]:
    """Reads the evaluated environments' entries of `eval_info.json`.

    Returns:
        [{"task_group": str, "task_id": int, "sum_rewards": [number per episode]}]. The group is a suite of
        `--env.task`, and the id the task's number in it.

    Raises:
        FileNotFoundError: The evaluation has not finished, or its folder is another one.
        ValueError: The file is not LeRobot's, or holds no episode.
    """
    path = eval_dir / "eval_info.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing: --eval_dir must be the --output_dir of a finished lerobot-eval run"
        )
    try:
        entries = [
            {
                "task_group": str(entry["task_group"]),
                "task_id": int(entry["task_id"]),
                "sum_rewards": list(entry["metrics"]["sum_rewards"]),
            }
            for entry in json.loads(path.read_text())["per_task"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: not an eval_info.json of lerobot-eval (no per_task … sum_rewards: {error})"
        ) from error
    if not any(entry["sum_rewards"] for entry in entries):
        raise ValueError(f"{path}: holds no episode")
    return entries


def read_lines(folder: Path) -> list[Episode]:
    """Reads the environment's own lines, `episodes.jsonl`; empty if there is no such file.

    Raises:
        ValueError: A line is not what the environment writes.
    """
    path = folder / EPISODES_FILE
    if not path.is_file():
        return []
    episodes = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            episodes.append(_from_line(json.loads(line)))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}, line {number}: not an episode of the CALVIN environment ({error!r})") from error
    return episodes


def _from_line(line: dict[str, Any]) -> Episode:
    commands = [(command["task"], bool(command["success"])) for command in line["commands"]]
    if not commands:
        raise ValueError("no command")
    settings = {key: line[key] for key in SETTINGS if key in line}
    return Episode(commands, int(line["seed"]), line["chain"], settings, line.get("reason"))


def collect(entries: list[dict[str, Any]], lines: list[Episode], seed: int | None) -> list[Episode]:
    """Brings both sources together.

    Args:
        entries: What `read_eval_info` returned.
        lines: What `read_lines` returned. There may be more than LeRobot counts, since its last batch is full.
        seed: The evaluation's `--seed`; None: the smallest one in the lines, or LeRobot's default.

    Returns:
        The episodes that LeRobot counts.

    Raises:
        ValueError: The sources contradict each other, or `eval_info.json` is of another environment.
    """
    episodes = []
    for entry in entries:
        task = _task_of(entry)
        own = _lines_of(task or entry["task_group"], lines)
        by_seed: dict[int, Episode] = {}
        for line in own:
            if by_seed.setdefault(line.seed, line) != line:
                raise ValueError(
                    f"{EPISODES_FILE} holds two different episodes of seed {line.seed}, so it is of several "
                    "evaluations; give each evaluation its own --env.results_dir"
                )
        first = seed if seed is not None else min(by_seed, default=DEFAULT_SEED)
        for k, rewards in enumerate(entry["sum_rewards"]):
            episode = by_seed.get(first + k) if own else _from_reward(rewards, first + k, task)
            if episode is None or episode.successes != rewards:
                found = "has no line for it" if episode is None else f"says {episode.successes}"
                raise ValueError(
                    f"episode {k} (seed {first + k}) fulfilled {rewards:g} commands in eval_info.json, but "
                    f"{EPISODES_FILE} {found}: it is of another evaluation, or --seed is wrong"
                )
            episodes.append(episode)
    return episodes


def _task_of(entry: dict[str, Any]) -> str | None:
    """The task that an entry of `read_eval_info` is about; None for chains and for groups of another name."""
    group = entry["task_group"]
    if group in TASK_GROUPS:
        return TASK_GROUPS[group][entry["task_id"]]
    return group if group in TASKS else None


def _lines_of(name: str, lines: list[Episode]) -> list[Episode]:
    """The lines of a task, or of the chains; all lines if the name is neither."""
    if name in TASKS:
        return [line for line in lines if line.chain is None and line.commands[0][0] == name]
    if name == LH_MTLC:
        return [line for line in lines if line.chain is not None]
    return lines


def _from_reward(rewards: float, seed: int, task: str | None) -> Episode:
    """An episode of a single task, or of the chain that follows from the seed if `task` is None."""
    fulfilled = int(rewards)
    if fulfilled != rewards or not 0 <= fulfilled <= (CHAIN_LENGTH if task is None else 1):
        raise ValueError(f"sum of rewards {rewards} in eval_info.json: not an evaluation of the CALVIN environment")
    if task is not None:
        return Episode([(task, bool(fulfilled))], seed, None)
    chains = load_chains()
    chain = seed % len(chains)
    attempted = chains[chain].tasks[: fulfilled + 1]
    return Episode([(name, i < fulfilled) for i, name in enumerate(attempted)], seed, chain)


def summarise(episodes: list[Episode]) -> dict[str, Any]:
    """Computes every figure of the report.

    Returns:
        {"episodes", "ended_early", "seeds": [first, last], "settings", "tasks": {task: {"successes", "attempts",
        "rate"}}, "local_success_rate"} and, for chains, {"in_a_row": [share with at least 1…5], "average_length"}.
        The average length is the sum of the five shares; the local success rate is the share of attempted commands
        that were fulfilled. Episodes that `ended_early` have a `reason`.
    """
    tasks: dict[str, dict[str, Any]] = {}
    for name, fulfilled in (command for episode in episodes for command in episode.commands):
        counts = tasks.setdefault(name, {"successes": 0, "attempts": 0})
        counts["successes"] += fulfilled
        counts["attempts"] += 1
    for counts in tasks.values():
        counts["rate"] = counts["successes"] / counts["attempts"]
    summary: dict[str, Any] = {
        "episodes": len(episodes),
        "ended_early": sum(e.reason is not None for e in episodes),
        "seeds": [min(e.seed for e in episodes), max(e.seed for e in episodes)],
        "settings": {key: _agreed(e.settings.get(key) for e in episodes) for key in SETTINGS},
        "tasks": dict(sorted(tasks.items(), key=lambda item: (-item[1]["rate"], item[0]))),
        "local_success_rate": sum(c["successes"] for c in tasks.values()) / sum(c["attempts"] for c in tasks.values()),
    }
    if all(episode.chain is not None for episode in episodes):
        rows = range(1, CHAIN_LENGTH + 1)
        summary["in_a_row"] = [sum(e.successes >= k for e in episodes) / len(episodes) for k in rows]
        summary["average_length"] = sum(summary["in_a_row"])
    return summary


def _agreed(values: Iterable[Any]) -> Any:
    """The value that all agree on, the sorted list of different ones, or None if all are None."""
    distinct = {value for value in values if value is not None}
    return distinct.pop() if len(distinct) == 1 else sorted(distinct) or None
