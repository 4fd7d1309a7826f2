"""The report's plots."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_BLUE = "#4472a8"


def plot_in_a_row(summary: dict[str, Any], path: Path) -> None:
    """Bars: the share of chains with at least 1…5 commands fulfilled in a row (Table 5.1)."""
    shares = [100 * share for share in summary["in_a_row"]]
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    bars = axes.bar(range(1, len(shares) + 1), shares, color=_BLUE)
    axes.bar_label(bars, fmt="%.1f")
    axes.set(xlabel="commands in a row", ylabel="chains (%)", ylim=(0, 105))
    axes.set_title(f"{summary['episodes']} chains, average length {summary['average_length']:.2f}")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def plot_tasks(summary: dict[str, Any], path: Path) -> None:
    """Horizontal bars: each task's success per attempt, best on top (Figure 5.1)."""
    tasks = summary["tasks"]
    figure, axes = plt.subplots(figsize=(7, 1.2 + 0.24 * len(tasks)), layout="constrained")
    bars = axes.barh(list(tasks), [100 * counts["rate"] for counts in tasks.values()], color=_BLUE)
    axes.bar_label(bars, [f"{c['successes']}/{c['attempts']}" for c in tasks.values()], padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="success per attempt (%)", xlim=(0, 115), xticks=range(0, 101, 20))
    axes.tick_params(axis="y", labelsize=8)
    axes.margins(y=0.01)
    figure.savefig(path, dpi=150)
    plt.close(figure)
