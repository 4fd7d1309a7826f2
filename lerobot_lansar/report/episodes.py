"""What became of each episode, read from the files of an evaluation's folder.

episodes.jsonl     a line per finished episode, appended by the environment: commands, successes, settings
eval_config.json   what `lansar-eval` was asked for, written at its start: it tells which episodes are missing
eval_info.json     LeRobot's own results, written at an evaluation's end

LeRobot's file is enough: an episode's sum of rewards is the number of commands that it fulfilled in a row, and its
chain follows from its seed. Lines are enough too. Where both exist they must agree.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..benchmark import EPISODES_FILE, LH_MTLC, load_chains
from ..calvin import CHAIN_LENGTH, TASK_GROUPS, TASKS

DEFAULT_SEED = 1000
"""LeRobot's own default of `--seed`."""

INFO_FILE = "eval_info.json"
PLAN_FILE = "eval_config.json"
WEIGHTS = "weights of the policy"
"""What `eval_config.json` calls the SHA-256 of the policy's files."""

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
        steps: Control steps that each command took; empty if unknown.
        done: For each command its task if it was fulfilled, else the other task that was fulfilled first, or None;
            empty if unknown.
        origin: The known ones of policy, policy_reset and version.
    """

    commands: list[tuple[str, bool]]
    seed: int
    chain: int | None
    settings: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None
    steps: list[int] = field(default_factory=list)
    done: list[str | None] = field(default_factory=list, compare=False)
    origin: dict[str, Any] = field(default_factory=dict)

    @property
    def successes(self) -> int:
        """How many commands were fulfilled."""
        return sum(fulfilled for _, fulfilled in self.commands)

    @property
    def suite(self) -> str:
        """`"lh_mtlc"`, or the name of its single task."""
        return LH_MTLC if self.chain is not None else self.commands[0][0]

    @property
    def key(self) -> tuple[str, int]:
        """(suite, seed): what tells the episodes of an evaluation apart."""
        return self.suite, self.seed


@dataclass
class Plan:
    """What an evaluation was asked for; anything may be unknown (None, or empty).

    Attributes:
        seed: First seed of every suite.
        n_episodes: Episodes of every task.
        suites: Name of each suite to its tasks, as in `--env.task`.
        facts: policy, command, hardware, seconds.
        weights: Name of each of the policy's files to its SHA-256.
    """

    seed: int | None = None
    n_episodes: int | None = None
    suites: dict[str, list[str]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    weights: dict[str, str] = field(default_factory=dict)

    def expected(self) -> set[tuple[str, int]] | None:
        """The keys of all episodes; None if the plan does not tell."""
        if self.seed is None or self.n_episodes is None or not self.suites:
            return None
        seeds = range(self.seed, self.seed + self.n_episodes)
        return {(task, seed) for tasks in self.suites.values() for task in tasks for seed in seeds}


def read_plan(folder: Path) -> Plan:
    """Reads `eval_config.json`; a plan that knows nothing if there is no such file.

    Raises:
        ValueError: It is not what `lansar-eval` writes.
    """
    path = folder / PLAN_FILE
    if not path.is_file():
        return Plan()
    try:
        content = json.loads(path.read_text())
        seed, count = content.get("seed"), content.get("n_episodes")
        return Plan(
            None if seed is None else int(seed),
            None if count is None else int(count),
            {str(suite): [str(task) for task in tasks] for suite, tasks in (content.get("suites") or {}).items()},
            {key: content.get(key) for key in ("policy", "command", "hardware", "seconds")},
            dict((content.get("request") or {}).get(WEIGHTS) or {}),
        )
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not an {PLAN_FILE} of lansar-eval ({error})") from error


def read_lines(folder: Path) -> list[Episode]:
    """Reads the environment's own lines, `episodes.jsonl`; empty if there is no such file.

    A last line without an end is what an interrupted evaluation leaves, or one that is just being written: its
    episode counts as missing.

    Raises:
        ValueError: A line is not what the environment writes, or a seed has two different episodes.
    """
    path = folder / EPISODES_FILE
    if not path.is_file():
        return []
    whole = path.read_bytes().rpartition(b"\n")[0]
    episodes: dict[tuple[str, int], Episode] = {}
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            episode = _from_line(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}, line {number}: not an episode of the CALVIN environment ({error!r})") from error
        if episodes.setdefault(episode.key, episode) != episode:
            raise ValueError(
                f"{path} holds two different episodes of seed {episode.seed}, so it is of several evaluations; give "
                "each evaluation its own folder (--env.results_dir)"
            )
    return list(episodes.values())


def _from_line(line: dict[str, Any]) -> Episode:
    commands = [(str(command["task"]), bool(command["success"])) for command in line["commands"]]
    if not commands:
        raise ValueError("no command")
    return Episode(
        commands,
        int(line["seed"]),
        None if line["chain"] is None else int(line["chain"]),
        {key: line[key] for key in SETTINGS if key in line},
        line.get("reason"),
        [int(command["steps"]) for command in line["commands"] if "steps" in command],
        [command["done"] for command in line["commands"] if "done" in command],
        {key: line[key] for key in ("policy", "policy_reset", "version") if line.get(key) is not None},
    )


def read_eval_info(folder: Path) -> list[dict[str, Any]]:
    """Reads the evaluated environments' entries of `eval_info.json`; empty if there is no such file.

    Returns:
        [{"task_group": str, "task_id": int, "sum_rewards": [number per episode]}]. The group is a suite of
        `--env.task`, and the id the task's number in it.

    Raises:
        ValueError: The file is not LeRobot's, or holds no episode.
    """
    path = folder / INFO_FILE
    if not path.is_file():
        return []
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
        raise ValueError(f"{path}: not an {INFO_FILE} of lerobot-eval (no per_task … sum_rewards: {error})") from error
    if not any(entry["sum_rewards"] for entry in entries):
        raise ValueError(f"{path}: holds no episode")
    return entries


def collect(entries: list[dict[str, Any]], lines: list[Episode], seed: int | None) -> list[Episode]:
    """Brings LeRobot's results and the lines together.

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
        task = task_of(entry)
        own = {line.seed: line for line in _lines_of(task or entry["task_group"], lines)}
        first = seed if seed is not None else min(own, default=DEFAULT_SEED)
        for k, rewards in enumerate(entry["sum_rewards"]):
            episode = own.get(first + k) if own else _from_reward(rewards, first + k, task)
            if episode is None or episode.successes != rewards:
                found = "has no line for it" if episode is None else f"says {episode.successes}"
                raise ValueError(
                    f"episode {k} (seed {first + k}) fulfilled {rewards:g} commands in {INFO_FILE}, but "
                    f"{EPISODES_FILE} {found}: it is of another evaluation, or --seed is wrong"
                )
            episodes.append(episode)
    return episodes


def task_of(entry: dict[str, Any]) -> str | None:
    """The task that an entry of `read_eval_info` is about; None for chains and for groups of another name."""
    group = entry["task_group"]
    if group in TASK_GROUPS and 0 <= entry["task_id"] < len(TASK_GROUPS[group]):
        return TASK_GROUPS[group][entry["task_id"]]
    return group if group in TASKS else None


def _lines_of(name: str, lines: list[Episode]) -> list[Episode]:
    """The lines of a task, or of the chains; all lines if the name is neither."""
    return [line for line in lines if line.suite == name] if name in TASKS or name == LH_MTLC else lines


def _from_reward(rewards: float, seed: int, task: str | None) -> Episode:
    """An episode of a single task, or of the chain that follows from the seed if `task` is None."""
    fulfilled = int(rewards)
    if fulfilled != rewards or not 0 <= fulfilled <= (CHAIN_LENGTH if task is None else 1):
        raise ValueError(f"sum of rewards {rewards} in {INFO_FILE}: not an evaluation of the CALVIN environment")
    if task is not None:
        return Episode([(task, bool(fulfilled))], seed, None)
    chains = load_chains()
    chain = seed % len(chains)
    attempted = chains[chain].tasks[: fulfilled + 1]
    return Episode([(name, i < fulfilled) for i, name in enumerate(attempted)], seed, chain)
