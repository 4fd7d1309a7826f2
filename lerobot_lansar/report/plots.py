"""The report's pictures."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

if TYPE_CHECKING:
    from .attention import Attention

_BLUE = "#4472a8"
FRAMES = 9  # of a rollout, above its heat map


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


def plot_context_attention(attention: "Attention", path: Path) -> None:
    """Heat map: attention to each modality (rows) at each step (columns), under frames of the rollout (Figure 6.4)."""
    weights, steps = attention.per_modality(), len(attention.context)
    shown = np.unique(np.linspace(0, steps - 1, FRAMES).round().astype(int))
    figure = plt.figure(figsize=(12, 5.5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 2))  # type: ignore[misc]
    for axes, step in zip(np.atleast_1d(above.subplots(1, len(shown))), shown, strict=True):
        axes.imshow(attention.frames[step])
        axes.set_title(f"step {step}", fontsize=8)
        axes.axis("off")
    axes = below.subplots()
    image = axes.imshow(weights.T, aspect="auto", interpolation="nearest", cmap="viridis", vmin=0)
    axes.set(xlabel="control step", yticks=range(len(attention.tokens)), yticklabels=attention.tokens)
    for step in [t for t in range(1, steps) if attention.commands[t] != attention.commands[t - 1]]:
        axes.axvline(step - 0.5, color="white", linewidth=1)
    below.colorbar(image, ax=axes, label="attention (1 = indifferent)")
    sentences = list(dict.fromkeys(attention.commands))
    axes.set_title("context encoder: " + "; ".join(f"“{sentence}”" for sentence in sentences), fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def plot_decoder_attention(attention: "Attention", steps: list[int], path: Path) -> None:
    """Heat maps: from the newest step to the window's tokens, per decoder layer, mean over heads (Figure 6.1); above
    them the static camera's picture of that step.
    """
    steps = [step for step in steps if step < len(attention.decoder)] or [len(attention.decoder) - 1]
    figure, grid = plt.subplots(
        3, len(steps), figsize=(1 + 5.5 * len(steps), 8), squeeze=False, layout="constrained"
    )
    for column, step in enumerate(steps):
        grid[0, column].imshow(attention.frames[step])
        grid[0, column].set_title(f"step {step}: “{attention.commands[step]}”", fontsize=9)
        grid[0, column].axis("off")
        for axes, (kind, other) in zip(grid[1:, column], (("self", "X"), ("cross", "E")), strict=True):
            weights = attention.decoder[step][kind].mean(axis=1)  # (layers, tokens)
            count = weights.shape[1]
            if attention.prepended:
                names = ["C", *(f"{other}{i}" for i in range(count - 1))]
            else:
                names = [("C" if i % 2 == 0 else other) + str(i // 2) for i in range(count)]
            image = axes.imshow(weights, aspect="auto", interpolation="nearest", cmap="viridis", vmin=0)
            # every token, or some of the odd ones: X or E
            labelled = range(count) if count <= 16 else range(1, count, 2 * (count // 32 + 1))
            axes.set(
                xticks=labelled, xticklabels=[names[i] for i in labelled], yticks=range(len(weights)),
                ylabel="layer", title=f"{kind}-attention",
            )  # fmt: skip
            axes.tick_params(axis="x", labelrotation=90, labelsize=7)
            figure.colorbar(image, ax=axes)
    figure.savefig(path, dpi=130)
    plt.close(figure)
