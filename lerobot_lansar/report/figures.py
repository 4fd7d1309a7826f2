"""From episodes to figures: success rates with their 95 % intervals, paired differences, standard deviations."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..calvin import CHAIN_LENGTH
from .episodes import Episode

LEVEL = 0.95
"""Of every interval."""

NOTHING = "nothing"
"""What was done where no task was fulfilled."""

RESAMPLES = 9999
"""Bootstrap samples; the draws are the same in every report."""

Interval = list[float] | None


def wilson(successes: int, attempts: int) -> Interval:
    """Wilson's score interval of a share; None without attempts."""
    if attempts == 0:
        return None
    from scipy.stats import binomtest  # late: takes a second to import

    interval = binomtest(successes, attempts).proportion_ci(LEVEL, method="wilson")
    return [float(interval.low), float(interval.high)]


def bootstrap(values: Sequence[Sequence[float]] | np.ndarray) -> list[Interval]:
    """Percentile bootstrap intervals of means over chains.

    Args:
        values: (k, n): k quantities of n chains. All quantities are resampled together.

    Returns:
        An interval for each quantity; None where all chains are alike, about which resampling says nothing.
    """
    data = np.asarray(values, dtype=float)
    if data.shape[1] < 2:
        return [None] * len(data)
    from scipy.stats import bootstrap as resample

    interval = resample(
        (data,),
        np.mean,
        axis=-1,
        n_resamples=RESAMPLES,
        batch=max(1, 500_000 // data.size),
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    alike = data.min(axis=1) == data.max(axis=1)
    pairs = zip(alike, interval.low, interval.high, strict=True)
    return [None if same else [float(low), float(high)] for same, low, high in pairs]


def share(successes: int, attempts: int) -> dict[str, Any]:
    """{"successes", "attempts", "rate", "interval"}."""
    return {
        "successes": successes,
        "attempts": attempts,
        "rate": successes / attempts,
        "interval": wilson(successes, attempts),
    }


def figures(episodes: list[Episode]) -> dict[str, Any]:
    """Every figure of one evaluation.

    Returns:
        {"tasks": {task: what `share` returns}, "local_success_rate", "local_success_rate_interval"} and, if there are
        chains, {"in_a_row": [share of chains with at least 1…5], "in_a_row_intervals", "average_length",
        "average_length_interval"} and, if the lines tell what was done, {"told": {task: {task that was done first, or
        "nothing": how often}}}. The average length is the sum of the five shares; the local success rate is the
        share of attempted commands that were fulfilled.
    """
    counts: dict[str, list[int]] = {}
    for name, fulfilled in (command for episode in episodes for command in episode.commands):
        count = counts.setdefault(name, [0, 0])
        count[0] += fulfilled
        count[1] += 1
    tasks = {name: share(*count) for name, count in counts.items()}
    local = share(sum(count[0] for count in counts.values()), sum(count[1] for count in counts.values()))
    found = {
        "tasks": dict(sorted(tasks.items(), key=lambda item: (-item[1]["rate"], item[0]))),
        "local_success_rate": local["rate"],
        "local_success_rate_interval": local["interval"],
    }
    lengths = [episode.successes for episode in episodes if episode.chain is not None]
    if lengths:
        rows = [sum(length >= k for length in lengths) for k in range(1, CHAIN_LENGTH + 1)]
        found["in_a_row"] = [count / len(lengths) for count in rows]
        found["in_a_row_intervals"] = [wilson(count, len(lengths)) for count in rows]
        found["average_length"] = sum(found["in_a_row"])
        found["average_length_interval"] = bootstrap([lengths])[0]
    if all(episode.done for episode in episodes):
        found["told"] = _told(episodes)
    return found


def _told(episodes: list[Episode]) -> dict[str, dict[str, int]]:
    """Each commanded task to what was done: {task, or "nothing": how often}."""
    told: dict[str, dict[str, int]] = {}
    for episode in episodes:
        for (task, _), done in zip(episode.commands, episode.done, strict=True):
            row = told.setdefault(task, {})
            row[done or NOTHING] = row.get(done or NOTHING, 0) + 1
    return told


def difference(episodes: list[Episode], baseline: list[Episode]) -> dict[str, Any] | None:
    """How much better the first does than the second on the chains that both played.

    Returns:
        {"chains", "average_length", "average_length_interval", "in_a_row", "in_a_row_intervals"}: means over these
        chains of the differences, chain by chain; None if there are none, or if one played a chain twice.
    """
    one, other = _by_chain(episodes), _by_chain(baseline)
    chains = sorted(one.keys() & other.keys()) if one is not None and other is not None else []
    if one is None or other is None or not chains:
        return None
    lengths = np.array([[one[chain] for chain in chains], [other[chain] for chain in chains]])
    reached = lengths[:, None] >= np.arange(1, CHAIN_LENGTH + 1)[:, None]  # (2, 5, chains)
    differences = np.vstack([lengths[0] - lengths[1], reached[0].astype(int) - reached[1].astype(int)])
    means, intervals = differences.mean(axis=1).tolist(), bootstrap(differences)
    return {
        "chains": len(chains),
        "average_length": means[0],
        "average_length_interval": intervals[0],
        "in_a_row": means[1:],
        "in_a_row_intervals": intervals[1:],
    }


def _by_chain(episodes: list[Episode]) -> dict[int, int] | None:
    """Number of each chain to the commands fulfilled in it; None if one was played twice."""
    chains = [episode for episode in episodes if episode.chain is not None]
    found = {episode.chain: episode.successes for episode in chains if episode.chain is not None}
    return found if len(found) == len(chains) else None


def standard_deviation(rows: Iterable[Sequence[float]]) -> list[float]:
    """Population standard deviation of each column, as in Table 5.4 of the thesis."""
    return np.std(list(rows), axis=0).tolist()
