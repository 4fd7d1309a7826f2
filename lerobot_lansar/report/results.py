"""From what `lerobot-eval` leaves behind to success rates.

`eval_info.json` is enough: an episode's sum of rewards is the number of commands it fulfilled in a row, and
which chain it ran follows from its seed. Where the environment also wrote `episodes-*.jsonl`
(`--env.results_dir`), those lines tell which commands were attempted, under which settings, and are held
against `eval_info.json`.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..benchmark import LH_MTLC, load_chains
from ..calvin import CHAIN_LENGTH, TASKS

DEFAULT_SEED = 1000
"""LeRobot's own default of `--seed`."""

SETTINGS = (
    "scene",
    "assets",
    "renderer",
    "control_mode",
    "steps_per_command",
    "perturbation_every",
    "perturbation_scale",
)
"""What an episode's line may say about how it was run."""


@dataclass
class Episode:
    """The commands one episode attempted, in order.

    Attributes:
        commands: (task name, fulfilled) of each; all but the last are fulfilled.
        seed: The episode's reset seed.
        chain: Number of the chain, or None for a single task.
        settings: Those of `SETTINGS` that are known.
    """

    commands: list[tuple[str, bool]]
    seed: int
    chain: int | None
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def successes(self) -> int:
        """How many commands it fulfilled."""
        return sum(fulfilled for _, fulfilled in self.commands)


def read_eval_info(eval_dir: Path) -> list[dict[str, Any]]:
    """Reads the evaluated environments' entries of `eval_info.json`.

    Returns:
        [{"task_group": str, "sum_rewards": [number per episode]}].

    Raises:
        FileNotFoundError: The evaluation has not finished or is elsewhere.
        ValueError: It is not LeRobot's file.
    """
    path = eval_dir / "eval_info.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing: --eval_dir must be the --output_dir of a finished lerobot-eval run"
        )
    try:
        entries = [
            {"task_group": str(entry["task_group"]), "sum_rewards": list(entry["metrics"]["sum_rewards"])}
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
    """Reads the environment's own lines, `episodes-*.jsonl`; empty if there are none.

    Raises:
        ValueError: A line is not what the environment writes.
    """
    episodes = []
    for path in sorted(folder.glob("episodes-*.jsonl")):
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            try:
                stored = json.loads(line)
                commands = [(command["task"], bool(command["success"])) for command in stored["commands"]]
                if not commands:
                    raise ValueError("no command")
                episodes.append(
                    Episode(
                        commands=commands,
                        seed=int(stored["seed"]),
                        chain=stored["chain"],
                        settings={key: stored[key] for key in SETTINGS if key in stored},
                    )
                )
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"{path}, line {number}: not an episode of the CALVIN environment ({error!r})"
                ) from error
    return episodes


def collect(entries: list[dict[str, Any]], lines: list[Episode], seed: int | None) -> list[Episode]:
    """Brings both sources together.

    Args:
        entries: Of `read_eval_info`.
        lines: Of `read_lines`; they may hold more episodes than counted, as the last batch is full.
        seed: The evaluation's `--seed`; None: the smallest one in the lines, or LeRobot's default.

    Returns:
        The counted episodes.

    Raises:
        ValueError: The sources contradict each other, or something cannot be told without the lines.
    """
    episodes = []
    for entry in entries:
        group = entry["task_group"]
        task = group if group in TASKS else None
        # One task per entry, or one entry for all lines: chains, or a single task in a group of another name.
        own = [line for line in lines if task is None or (line.chain is None and line.commands[0][0] == task)]
        if group == LH_MTLC:
            own = [line for line in own if line.chain is not None]
        first = seed if seed is not None else min((line.seed for line in own), default=DEFAULT_SEED)
        by_seed: dict[int, Episode] = {}
        for line in own:
            if by_seed.setdefault(line.seed, line) != line:
                raise ValueError(
                    f"the episodes-*.jsonl files hold two different episodes of seed {line.seed}: they are "
                    "of several evaluations; give each evaluation its own --env.results_dir"
                )
        for k, rewards in enumerate(entry["sum_rewards"]):
            episode = by_seed.get(first + k) if own else _from_reward(rewards, first + k, task)
            if episode is None or episode.successes != rewards:
                found = "no line" if episode is None else f"{episode.successes}"
                raise ValueError(
                    f"episode {k} (seed {first + k}) fulfilled {rewards:g} commands in eval_info.json, but "
                    f"episodes-*.jsonl say {found}: they are of another evaluation, or --seed is wrong"
                )
            episodes.append(episode)
    return episodes


def _from_reward(rewards: float, seed: int, task: str | None) -> Episode:
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
        {"episodes", "seeds": [first, last], "settings", "tasks": {task: {"successes", "attempts", "rate"}},
        "local_success_rate"} and, for chains, {"in_a_row": [share with at least 1…5], "average_length"}. The
        average length is the sum of the five shares; the local success rate is that over attempted commands.
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
    distinct = {value for value in values if value is not None}
    return distinct.pop() if len(distinct) == 1 else sorted(distinct) or None
