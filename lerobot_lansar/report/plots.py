"""The report's plots, as SVG to be put into its page: they take the page's text colour, light or dark."""

import io
import re
from typing import Any

import matplotlib
from matplotlib.figure import Figure  # without pyplot, which takes half a second more to import
from matplotlib.patches import Rectangle

from ..calvin import CHAIN_LENGTH, TASKS
from .figures import NOTHING

COLOURS = ("#3b7dbb", "#d0762b", "#3f9a5d", "#a565b8", "#c4504f", "#8a7a52", "#4aa3a0", "#7d7f8a")
"""Of evaluations and trainings in their order; readable on white and on near black."""

_INK, _RULE = "#010203", "#040506"
"""Stand-ins in matplotlib for the page's colours of text and of rules."""

_STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.edgecolor": _RULE,
    "grid.color": _RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.labelcolor": _INK,
    "figure.constrained_layout.use": True,
}


def plot_in_a_row(table: dict[str, Any], salt: str) -> str:
    """Bars with intervals: the share of chains with at least 1…5 commands fulfilled in a row (Table 5.1).

    Args:
        table: A table of `report.json`; evaluations without chains are left out.
        salt: Differs from plot to plot of a page, so that their ids differ.

    Returns:
        An `<svg>` element.
    """
    rows = [row for row in table["evaluations"] if "in_a_row" in row]
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": salt}):
        figure = Figure(figsize=(5.2, 3.2))
        axes = figure.subplots()
        width = 0.8 / len(rows)
        for i, row in enumerate(rows):
            places = [k + (i - (len(rows) - 1) / 2) * width for k in range(1, CHAIN_LENGTH + 1)]
            shares = [100 * share for share in row["in_a_row"]]
            axes.bar(places, shares, width * 0.9, color=_colour(i), label=_plain(row["label"]))
            low_high = zip(shares, row["in_a_row_intervals"], strict=True)
            spans = [(max(0, s - 100 * low), max(0, 100 * high - s)) for s, (low, high) in low_high]
            axes.errorbar(places, shares, yerr=list(zip(*spans, strict=True)), fmt="none", ecolor=_INK, elinewidth=1)
        axes.grid(axis="y", linewidth=0.6)
        axes.set(xlabel="commands in a row", ylabel="chains (%)", ylim=(0, 104), xticks=range(1, CHAIN_LENGTH + 1))
        _legend(figure)
        return _svg(figure, f"Success of 1 to 5 commands in a row: {', '.join(row['label'] for row in rows)}")


def plot_tasks(table: dict[str, Any], salt: str) -> str:
    """Horizontal bars: each task's success per attempt, the first evaluation's best on top (Figures 5.1 and 5.2)."""
    rows = table["evaluations"]
    names = list(dict.fromkeys(task for row in rows for task in row["tasks"]))
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": salt}):
        height = 0.8 + len(names) * (0.24 if len(rows) == 1 else 0.1 + 0.1 * len(rows))
        figure = Figure(figsize=(5.2, height))
        axes = figure.subplots()
        thick = 0.8 / len(rows)
        for i, row in enumerate(rows):
            own = [(k, row["tasks"][name]) for k, name in enumerate(names) if name in row["tasks"]]
            places = [k + (i - (len(rows) - 1) / 2) * thick for k, _ in own]
            rates = [100 * counts["rate"] for _, counts in own]
            bars = axes.barh(places, rates, thick * 0.85, color=_colour(i), label=_plain(row["label"]))
            if len(rows) == 1:
                labels = [f"{c['successes']}/{c['attempts']}" for _, c in own]
                axes.bar_label(bars, labels, padding=3, fontsize=8)
        axes.set_yticks(range(len(names)), names, fontsize=9)
        axes.invert_yaxis()
        axes.grid(axis="x", linewidth=0.6)
        axes.set(xlabel="success per attempt (%)", xlim=(0, 114), xticks=range(0, 101, 20))
        axes.margins(y=0.01)
        _legend(figure)
        return _svg(figure, f"Success of each task: {', '.join(row['label'] for row in rows)}")


def plot_told(row: dict[str, Any], salt: str) -> str:
    """A matrix: the commanded task (rows) against the one that was fulfilled first (columns), in percent of attempts.

    Args:
        row: An evaluation of `report.json` with "told".
        salt: As for `plot_in_a_row`.
    """
    told = row["told"]
    done = {name for counts in told.values() for name in counts}
    rows = [task for task in TASKS if task in told]
    columns = [task for task in TASKS if task in told or task in done] + [NOTHING]
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": salt}):
        figure = Figure(figsize=(2.2 + 0.2 * len(columns), 2 + 0.2 * len(rows)))
        axes = figure.subplots()
        for y, task in enumerate(rows):
            attempts = sum(told[task].values())
            for name, count in told[task].items():
                x, share = columns.index(name), count / attempts
                colour = COLOURS[0 if name == task else -1 if name == NOTHING else 1]
                axes.add_patch(
                    Rectangle((x - 0.5, y - 0.5), 1, 1, color=colour, alpha=0.15 + 0.75 * share, linewidth=0)
                )
                axes.text(x, y, f"{100 * share:.0f}", ha="center", va="center", fontsize=6.5)
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
        axes.set_yticks(range(len(rows)), rows, fontsize=8)
        axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5), xlabel="done", ylabel="told")
        axes.tick_params(length=0)
        return _svg(figure, f"What {row['label']} did, by what it was told")


def plot_losses(trainings: list[dict[str, Any]], salt: str) -> str:
    """Lines: training loss, and dashed the held-out loss, over updates (Figure 6.9)."""
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": salt}):
        figure = Figure(figsize=(5.2, 3.2))
        axes = figure.subplots()
        for i, training in enumerate(trainings):
            label = _plain(training["label"])
            for key, style, name in (("training", "-", "training"), ("held_out", "--", "held out")):
                points = [(u, float("nan") if loss is None else loss) for u, loss in _thin(training[key])]
                if points:
                    mark = "o" if len(points) == 1 else None
                    axes.plot(*zip(*points, strict=True), style, color=_colour(i), marker=mark, linewidth=1.4,
                              label=f"{label}, {name}")  # fmt: skip
        axes.grid(axis="y", linewidth=0.6)
        axes.set(xlabel="updates", ylabel="loss")
        _legend(figure)
        return _svg(figure, f"Losses of {', '.join(training['label'] for training in trainings)}")


def _thin(points: list[list[Any]], most: int = 1000) -> list[list[Any]]:
    """Every n-th point, so that a long training does not swell the page; the last one stays."""
    every = -(-len(points) // most) or 1
    return points if every == 1 else [*points[:-1:every], points[-1]]


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _plain(label: str) -> str:
    """A label for a legend: not too long, without the mathematics of $…$, and never left out, as _… would be."""
    short = label if len(label) <= 48 else f"{label[:47]}…"
    return ("\u200b" if short.startswith("_") else "") + short.replace("$", r"\$")


def _legend(figure: Figure) -> None:
    """A legend above the plot, in two columns if the names are short enough for that."""
    names = figure.axes[0].get_legend_handles_labels()[1]
    if len(names) > 1:
        columns = 2 if max(map(len, names)) <= 28 else 1
        figure.legend(loc="outside upper left", ncols=columns, fontsize=9, handlelength=1.2)


def _svg(figure: Figure, description: str) -> str:
    """The figure as an `<svg>` element that names itself to screen readers."""
    file = io.StringIO()
    figure.savefig(file, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    text = text[text.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*">', "<g>", text)  # figure_1, axes_1 …: the same in every plot
    text = re.sub(r'\s*xmlns:xlink="[^"]*"', "", text).replace("xlink:href", "href")
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = text.replace(_INK, "currentColor").replace(_RULE, "var(--rule)")
    label = description.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
