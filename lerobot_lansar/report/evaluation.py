"""Evaluations: which folders make one, which episodes it lacks, where its videos are."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..benchmark import EPISODES_FILE, LH_MTLC
from ..calvin import TASK_GROUPS
from .episodes import (
    INFO_FILE,
    PLAN_FILE,
    SETTINGS,
    Episode,
    Plan,
    collect,
    read_eval_info,
    read_lines,
    read_plan,
    task_of,
)


@dataclass
class Part:
    """One folder of an evaluation.

    Attributes:
        folder: As given by `--eval_dir`.
        episodes: The finished episodes that count.
        expected: Keys of all episodes that were asked for; None if unknown.
        policy: `--policy.path` of the evaluation; None if unknown.
        named: The policy that its own files name, even if the user named another.
        facts: command, hardware and seconds of `eval_config.json`, where known.
        weights: SHA-256 of the policy's files, where known.
        chains_known: Whether the files or `--seed` say which chains these are.
        videos: Key of an episode to its video, where one exists.
    """

    folder: Path
    episodes: list[Episode]
    expected: set[tuple[str, int]] | None
    policy: str | None
    named: str | None
    facts: dict[str, Any]
    weights: dict[str, str]
    chains_known: bool
    videos: dict[tuple[str, int], Path]

    @property
    def identity(self) -> tuple[Any, ...]:
        """What parts of one evaluation have in common, the policy apart."""
        settings = {key: agreed(e.settings.get(key) for e in self.episodes) for key in SETTINGS}
        return repr(settings), repr(policy_reset(self.episodes)), kind(self.episodes)

    def same_policy(self, other: "Part") -> bool | None:
        """By the weights, wherever they lie, or else by the path; None if unknown."""
        if self.weights and other.weights:
            return self.weights == other.weights
        return None if None in (self.policy, other.policy) else self.policy == other.policy


@dataclass
class Evaluation:
    """One evaluation of one policy, from one or more folders.

    Attributes:
        parts: Its folders.
        label: Its name in tables.
    """

    parts: list[Part]
    label: str = ""
    episodes: list[Episode] = field(init=False)

    def __post_init__(self) -> None:
        self.episodes = sorted((e for part in self.parts for e in part.episodes), key=lambda e: (e.suite, e.seed))

    @property
    def policy(self) -> str | None:
        """Its `--policy.path`, or None if unknown."""
        return self.parts[0].policy

    @property
    def missing(self) -> list[tuple[str, int]] | None:
        """Keys of the episodes that were asked for and are not there, in order; None if unknown."""
        if any(part.expected is None for part in self.parts):
            return None
        expected = {key for part in self.parts for key in part.expected or ()}
        return sorted(expected - {episode.key for episode in self.episodes})

    @property
    def videos(self) -> dict[tuple[str, int], Path]:
        """Key of an episode to its video, where one exists."""
        return {key: path for part in self.parts for key, path in part.videos.items()}


def read_part(folder: Path, seed: int | None = None, policy: str | None = None) -> Part:
    """Reads one folder of an evaluation, finished or not.

    Args:
        folder: That of `episodes.jsonl`, `eval_info.json` or both.
        seed: The evaluation's `--seed`, where the files do not tell.
        policy: Its `--policy.path`; None: what the files say.

    Raises:
        FileNotFoundError: There is no folder, or no finished episode in it.
        ValueError: A file is malformed, or the files are of different evaluations.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"--eval_dir={folder} is not a folder")
    plan, lines, entries = read_plan(folder), read_lines(folder), read_eval_info(folder)
    if not lines and not entries:
        begun = f"no episode has finished yet ({PLAN_FILE} is there)" if (folder / PLAN_FILE).exists() else ""
        raise FileNotFoundError(
            f"--eval_dir={folder}: "
            + (begun or f"holds neither {EPISODES_FILE} nor {INFO_FILE}")
            + "; it must be the --output_dir or --env.results_dir of an evaluation"
        )
    plan.seed = plan.seed if seed is None else seed
    expected = plan.expected()
    episodes = collect(entries, lines, plan.seed) if entries else lines
    if expected is not None and not entries:
        episodes = [episode for episode in lines if episode.key in expected]  # LeRobot's last batch is full
        if not episodes:
            raise ValueError(f"{folder}: {EPISODES_FILE} holds none of the episodes that {PLAN_FILE} asks for")
    if expected is None and entries:
        expected = {episode.key for episode in episodes}
    named = _policy(folder, episodes, plan)
    return Part(
        folder,
        episodes,
        expected,
        policy or named,
        named,
        {key: value for key, value in plan.facts.items() if key != "policy" and value is not None},
        plan.weights,
        chains_known=plan.seed is not None or bool(lines),
        videos=_videos(folder, episodes, plan, entries),
    )


def _policy(folder: Path, episodes: list[Episode], plan: Plan) -> str | None:
    named = agreed(e.origin.get("policy") for e in episodes)
    if isinstance(named, list):
        raise ValueError(
            f"{folder / EPISODES_FILE} is of several policies: {', '.join(named)}; give each its own folder"
        )
    return named or plan.facts.get("policy")


def _videos(
    folder: Path, episodes: list[Episode], plan: Plan, entries: list[dict[str, Any]]
) -> dict[tuple[str, int], Path]:
    """The videos of a folder, which LeRobot numbers from an evaluation's first seed on, separately for each task."""
    if not (folder / "videos").is_dir():
        return {}
    there = {path.relative_to(folder).as_posix() for path in folder.glob("videos/*/eval_episode_*.mp4")}
    names = {(task_of(entry) or LH_MTLC): f"{entry['task_group']}_{entry['task_id']}" for entry in entries}
    names |= {task: f"{suite}_{i}" for suite, tasks in plan.suites.items() for i, task in enumerate(tasks)}
    groups = {task: f"{group}_{i}" for group, tasks in TASK_GROUPS.items() for i, task in enumerate(tasks)}
    first: dict[str, int] = {}
    for episode in episodes:
        first[episode.suite] = min(first.get(episode.suite, episode.seed), episode.seed)
    found = {}
    for suite, seed in (episode.key for episode in episodes):
        number = seed - (plan.seed if plan.seed is not None else first[suite])
        for name in dict.fromkeys((names.get(suite), f"{suite}_0", groups.get(suite))):
            path = f"videos/{name}/eval_episode_{number}.mp4"
            if path in there:
                found[suite, seed] = folder / path
                break
    return found


def agreed(values: Iterable[Any]) -> Any:
    """The value that all agree on, the sorted list of different ones, or None if all are None."""
    distinct = {value for value in values if value is not None}
    return distinct.pop() if len(distinct) == 1 else sorted(distinct, key=str) or None


def policy_reset(episodes: list[Episode]) -> Any:
    """When the policy was reset: `"command"`, `"batch"`, None if unknown, or a list where episodes differ."""
    return agreed(episode.origin.get("policy_reset") for episode in episodes)


def kind(episodes: list[Episode]) -> str:
    """`"chains"`, `"single tasks"` or `"both"`."""
    chains = sum(episode.chain is not None for episode in episodes)
    return "chains" if chains == len(episodes) else "both" if chains else "single tasks"


def merge(parts: Sequence[Part], label: str = "") -> Evaluation:
    """One evaluation from folders that the user says to be of one.

    Raises:
        ValueError: They are of several.
    """
    first = parts[0]
    for i, part in enumerate(parts[1:], start=1):
        problem = None
        if part.identity != first.identity:
            problem = "have different settings"
        elif part.same_policy(first) is False:
            both = f"policies, {first.policy} and {part.policy}"
            problem = f"are of different {f'weights of {part.policy}' if part.policy == first.policy else both}"
        elif shared := {e.key for e in part.episodes} & {e.key for p in parts[:i] for e in p.episodes}:
            problem = f"both hold the episode of seed {min(seed for _, seed in shared)}"
        if problem is not None:
            raise ValueError(f"{first.folder} and {part.folder} {problem}, so they are not of one evaluation")
    return Evaluation(list(parts), label)


def group(parts: Iterable[Part]) -> list[Evaluation]:
    """Merges folders of one evaluation: the same known policy and settings, and no episode twice."""
    groups: list[list[Part]] = []
    for part in parts:
        for members in groups:
            same = part.same_policy(members[0]) and part.identity == members[0].identity
            taken = {e.key for member in members for e in member.episodes}
            if same and taken.isdisjoint(e.key for e in part.episodes):
                members.append(part)
                break
        else:
            groups.append([part])
    return [Evaluation(members) for members in groups]


def set_labels(evaluations: list[Evaluation]) -> None:
    """Names evaluations that have no label after what their policies' paths, or else their folders', do not share."""
    if all(evaluation.label for evaluation in evaluations):
        return
    policies = [evaluation.policy for evaluation in evaluations]
    distinct = None not in policies and len(set(policies)) == len(policies)
    paths = [Path(str(e.policy) if distinct else e.parts[0].folder).parts for e in evaluations]
    if len(paths) == 1:
        tail = ("checkpoints", paths[0][-2], "pretrained_model") if len(paths[0]) > 3 else ()
        parts = paths[0][:-3] if tail and paths[0][-3:] == tail else paths[0]
        evaluations[0].label = parts[-1] if parts else str(paths[0])
        return
    front = _shared(paths)
    back = _shared([path[front:][::-1] for path in paths])
    for evaluation, path in zip(evaluations, paths, strict=True):
        own = "/".join(path[front : len(path) - back]) or "/".join(path[-1:])
        evaluation.label = evaluation.label or own
    labels = [evaluation.label for evaluation in evaluations]
    for i, evaluation in enumerate(evaluations):
        if labels.count(labels[i]) > 1:
            evaluation.label = f"{labels[i]} ({i + 1})"


def _shared(paths: list[tuple[str, ...]]) -> int:
    """How many components all paths begin with."""
    count = 0
    while all(len(path) > count for path in paths) and len({path[count] for path in paths}) == 1:
        count += 1
    return count
