"""Statistics of an episode, as LeRobot keeps them."""

from collections import Counter, defaultdict
from typing import Any

import numpy as np
from PIL import Image

from dataset_convert.layout import Picture

type Stats = dict[str, dict[str, np.ndarray]]
"""Feature -> name of a statistic -> its value."""

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""LeRobot's."""


class EpisodeStats:
    """What LeRobot's `compute_episode_stats` computes, block by block and exactly.

    LeRobot fills a histogram of 5000 bins per dimension to read quantiles from, 25 ms per episode and 8 ms per frame
    with pictures. Sorting, and counting colours, give the same quantiles exactly instead of to within a bin (the
    smallest value that at least a share q of the samples do not exceed) in a thirtieth of the time. LeRobot looks at
    every picture of an episode of up to 100 frames and at fewer of a longer one; here all colours are counted. Depth
    goes through LeRobot's own histograms, which take the pictures that LeRobot looks at block by block.
    """

    def __init__(self) -> None:
        self._columns: dict[str, list[np.ndarray]] = defaultdict(list)
        self._colours: dict[str, np.ndarray] = {}
        self._depths: dict[str, Any] = {}
        self._depth_pictures: Counter[str] = Counter()
        self._frames = 0

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Takes a block's vectors, each (n,) or (n, length)."""
        for key, column in columns.items():
            self._columns[key].append(column)
        self._frames += len(next(iter(columns.values())))

    def add_pictures(self, picture: Picture, pictures: np.ndarray) -> None:
        """Takes a block's pictures of one camera: all colours, (n, H, W, 3), or some distances, (n, H, W)."""
        if picture.is_depth:
            from lerobot.datasets.compute_stats import RunningQuantileStats

            if len(pictures):
                running = self._depths.setdefault(picture.key, RunningQuantileStats())
                running.update(pictures.reshape(-1, 1))
                self._depth_pictures[picture.key] += len(pictures)
            return
        flat = np.ascontiguousarray(pictures).reshape(-1, pictures.shape[2], 3)
        counts = np.array(Image.fromarray(flat).histogram(), dtype=np.int64).reshape(3, 256)
        self._colours[picture.key] = self._colours.get(picture.key, 0) + counts

    def in_order(self, key: str) -> list[int]:
        """A column's distinct values in the order in which they first occur."""
        return list(dict.fromkeys(np.concatenate(self._columns[key]).tolist()))

    def result(self) -> Stats:
        """Feature -> {"min", "max", "mean", "std", "count", "q01", …}, of shape (length,), for cameras (C, 1, 1),
        colours in [0, 1] and distances in metres.
        """
        stats: Stats = {}
        for key, parts in self._columns.items():
            column = np.concatenate(parts)
            values = np.sort(column.reshape(len(column), -1).astype(np.float64), axis=0)
            stats[key] = {
                "min": values[0],
                "max": values[-1],
                "mean": values.mean(axis=0),
                "std": values.std(axis=0),
                "count": np.array([len(values)]),
            }
            for q in QUANTILES:
                stats[key][_name(q)] = values[max(int(np.ceil(q * len(values))) - 1, 0)]
        for key, counts in self._colours.items():
            stats[key] = _colour_stats(counts, self._frames)
        for key, running in self._depths.items():
            found = {name: value.reshape(1, 1, 1) for name, value in running.get_statistics().items()}
            stats[key] = {**found, "count": np.array([self._depth_pictures[key]])}
        return stats


def sampled(length: int) -> np.ndarray:
    """Which pictures of an episode LeRobot's statistics look at: of 54,000 every fifteenth; (length,) bool."""
    from lerobot.datasets.compute_stats import sample_indices

    chosen = np.zeros(length, dtype=bool)
    chosen[sample_indices(length)] = True
    return chosen


def _name(q: float) -> str:
    return f"q{int(q * 100):02d}"


def _colour_stats(counts: np.ndarray, frames: int) -> dict[str, np.ndarray]:
    """From (3, 256) counts of the values of each channel."""
    levels = np.arange(256) / 255.0
    total = counts.sum(axis=1)
    cumulated = counts.cumsum(axis=1)
    mean = counts @ levels / total

    def level(at_least: np.ndarray) -> np.ndarray:
        return levels[(cumulated < at_least[:, None]).sum(axis=1)]

    stats = {
        "min": level(np.ones(3)),
        "max": level(total.astype(float)),
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
        **{_name(q): level(np.maximum(np.ceil(q * total), 1)) for q in QUANTILES},
    }
    shaped = {name: value.reshape(3, 1, 1) for name, value in stats.items()}
    return {**shaped, "count": np.array([frames])}
