"""Figures of the sections."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from bench.contenders import CONTENDERS, LIMIT
from bench.tables import SWEEPS

COLOURS = {contender.name: f"C{i}" for i, contender in enumerate(CONTENDERS)}


def draw_sweep(title: str, axis: str, rows: Sequence[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(13, 5.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for sweep, axes in zip(SWEEPS, panels, strict=True):
        here = [row for row in rows if row["sweep"] == sweep]
        _lines(axes, here)
        axes.set(xlabel=axis, title=sweep)
    least, most = (
        edge(row[f"ns_per_query_{which}"] for row in rows) for edge, which in ((min, "min"), (max, "median"))
    )
    panels[0].set(ylabel="ns per query", ylim=(0.5 * least, 2 * most))
    figure.suptitle(title)
    handles = {line.get_label(): line for axes in panels for line in axes.get_lines()}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def _lines(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Lines through the minima, bars up to the medians; words as places are not joined."""
    places = list(dict.fromkeys(row["x"] for row in rows))
    words = any(isinstance(x, str) for x in places)
    for name, colour in COLOURS.items():
        chosen = [row for row in rows if row["contender"] == name]
        if not chosen:
            continue
        x = [places.index(row["x"]) if words else row["x"] for row in chosen]
        least, median = ([row[f"ns_per_query_{which}"] for row in chosen] for which in ("min", "median"))
        if name == LIMIT:
            axes.plot(x, least, "k--", lw=1.2, label=name)
            if not words:
                axes.fill_between(x, 1e-3, least, color="0.9", lw=0)
            continue
        ours = name.startswith("torchspline")
        style = "o" if words else "o-"
        axes.plot(
            x, least, style, color=colour, ms=4, lw=2.2 if ours else 1.2, label=name, zorder=3 if ours else 2
        )
        axes.vlines(x, least, median, color=colour, lw=1)
    axes.set_yscale("log")
    axes.grid(True, which="major", alpha=0.3)
    if words:
        axes.set_xticks(range(len(places)), [str(x).replace(", ", "\n") for x in places])
        axes.set_xlim(-0.5, len(places) - 0.5)
    else:
        axes.set_xscale("log")
        if max(places) <= 20:  # orders: every one of them
            axes.set_xticks(places, [str(x) for x in places])
            axes.xaxis.set_minor_formatter(NullFormatter())


def draw_goals(rows: Sequence[dict[str, Any]]) -> Figure:
    """What was measured as a share of its goal, the goal being at 1 and better being left of it."""
    chosen = [row for row in rows if row["bound"] is not None]
    figure = Figure(figsize=(9, 1.2 + 0.27 * len(chosen)), layout="constrained")
    axes = figure.subplots()
    for i, row in enumerate(chosen):
        low, middle = (
            row["bound"] / row[which] if row["at_least"] else row[which] / row["bound"]
            for which in ("min", "median")
        )
        colour = {"yes": "C2", "best only": "C1", "no": "C3"}[row["met"]]
        axes.plot([low, middle], [i, i], color=colour, lw=2)
        axes.plot(middle, i, "o", color=colour)
    axes.axvline(1.0, color="0.3", lw=1)
    axes.set_xscale("log")
    axes.set_yticks(range(len(chosen)), [row["goal"] for row in chosen])
    axes.invert_yaxis()
    axes.set(xlabel="measured / goal (point: median; line: to the least; left of 1 is met)", title="Goals")
    axes.grid(True, axis="x", which="both", alpha=0.3)
    return figure


def draw_operations(rows: Sequence[dict[str, Any]]) -> Figure:
    names = list(dict.fromkeys(row["operation"] for row in rows))
    contenders = list(dict.fromkeys(row["contender"] for row in rows))
    threads = sorted({row["threads"] for row in rows})
    figure = Figure(figsize=(6.5 * len(threads), 5), layout="constrained")
    panels = figure.subplots(1, len(threads), sharey=True, squeeze=False)[0]
    for count, axes in zip(threads, panels, strict=True):
        for i, name in enumerate(contenders):
            chosen = [row for row in rows if row["contender"] == name and row["threads"] == count]
            x = [names.index(row["operation"]) + 0.12 * (i - len(contenders) / 2) for row in chosen]
            least, median = ([row[f"ns_per_query_{which}"] for row in chosen] for which in ("min", "median"))
            axes.plot(x, least, "o", color=f"C{i}", label=name)
            axes.vlines(x, least, median, color=f"C{i}", lw=1)
        axes.set_yscale("log")
        axes.set_xticks(range(len(names)), names, rotation=15)
        axes.set_xlim(-0.6, len(names) - 0.4)
        axes.set_title(f"forward + backward, {count} thread{'s' * (count > 1)}")
        axes.grid(True, axis="y", which="both", alpha=0.3)
    panels[0].set_ylabel("ns each")
    panels[0].legend(fontsize=9)
    return figure
