"""Tables and charts of pages about whole runs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from causticmpi.compare.charts import PALETTE, plain_ticks
from causticmpi.compare.tables import Table, number
from causticmpi.stability.records import Page
from causticmpi.stability.runs import TRUE_WITHIN, Coverage, Long, Result, Stops

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


HEADS: dict[type[Result], tuple[tuple[str, ...], str]] = {
    Coverage: (
        (
            "method", "runs", "passes", "expected relMSE", "known to", "mean estimate / expected",
            "estimated_relmse / expected", f"estimates within {TRUE_WITHIN}", "intervals that hold it", "median factor",
            f"pictures' own errors within {TRUE_WITHIN} of their estimate",
        ),
        "Expected: mean squared error of the runs' pictures, each against the mean of all the others. The interval of "
        "a run is [estimate / factor, estimate x factor], from groups of its passes.",
    ),
    Stops: (
        (
            "method", "runs", "wanted relMSE", "mean error / wanted", "within the wanted", "passes",
            "difference of the mean", "z", "by their own error: passes", "difference", "z ",
        ),
        "Difference: of the mean of all pictures from a longer run, weighted as relMSE is. By their own error: the "
        "same passes, stopped as soon as all of them together seem good enough, which prefers pictures that lack rare "
        "bright paths.",
    ),
    Long: (
        ("method", "samples", "drift of the sum", "of a float32 sum", "z of the halves", "largest sample"),
        "Drift: the film's sum against the exactly rounded sum of all samples, relative.",
    ),
}  # fmt: skip
"""Columns and note of the table of each kind."""


def table(name: str, page: Page, results: Sequence[Result]) -> Table:
    """One row for each contender; results are all of one kind."""
    columns, note = HEADS[type(results[0])]
    return Table(name, f"{page.title}: all methods", columns, tuple(map(_cells, results)), note)


def _cells(found: Result) -> tuple[str, ...]:
    if isinstance(found, Coverage):
        own = np.abs(np.log(found.estimated / np.maximum(found.actual, 1e-300))) <= np.log(TRUE_WITHIN)
        return (
            found.label, str(len(found.estimated)), str(found.passes), number(found.expected),
            f"{100 * found.uncertainty:.1f} %", number(float(found.estimated.mean() / found.expected)),
            number(float(found.own.mean() / found.expected)),
            f"{100 * found.within:.0f} %", f"{100 * found.covered:.0f} %", number(float(np.median(found.factor))),
            f"{100 * own.mean():.0f} %",
        )  # fmt: skip
    if isinstance(found, Stops):
        ratio = found.actual / found.target
        return (
            found.label, str(len(ratio)), number(found.target), number(float(ratio.mean())),
            f"{100 * (ratio <= 1).mean():.0f} %", f"{found.passes.min():.0f} to {found.passes.max():.0f}",
            f"{100 * found.difference:+.2f} %", f"{found.z:+.2f}",
            f"{found.naive_passes.min():.0f} to {found.naive_passes.max():.0f}",
            f"{100 * found.naive_difference:+.2f} %", f"{found.naive_z:+.2f}",
        )  # fmt: skip
    return (
        found.label, f"{found.samples:,}", f"{found.drift:.1e}", f"{found.float32:.1e}", f"{found.z:+.2f}",
        f"{100 * found.share:.3g} % of the pixel",
    )  # fmt: skip


def chart(results: Sequence[Result]) -> "Figure":
    """What the runs did."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, found in enumerate(results):
        colour = PALETTE[i % len(PALETTE)]
        if isinstance(found, Coverage):
            _coverage(left, right, found, colour, i)
        elif isinstance(found, Stops):
            _stops(left, right, found, colour, i)
        else:
            _long(left, right, found, colour)
    for panel in (left, right):
        plain_ticks(panel)
        panel.grid(True, which="major", color="#dddddd", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.legend(fontsize=8, framealpha=0.85, edgecolor="none")
    return figure


def _coverage(left: "Axes", right: "Axes", found: Coverage, colour: str, index: int) -> None:
    ratio = found.estimated / found.expected
    order = np.argsort(ratio)
    x = np.arange(len(ratio)) + 0.2 * index
    ratio, factor = ratio[order], found.factor[order]
    left.vlines(x, ratio / factor, ratio * factor, color=colour, linewidth=1, alpha=0.5)
    left.plot(x, ratio, "o", color=colour, markersize=3.5, label=found.label)
    if index == 0:
        left.axhline(1, color="#555555", linewidth=1)
        left.axhspan(1 / TRUE_WITHIN, TRUE_WITHIN, color="#eeeeee", zorder=0, label=f"within {TRUE_WITHIN}")
    left.set(
        yscale="log",
        title="estimated over true relMSE, with its interval",
        xlabel="runs, in order of their estimates",
        ylabel="estimated / true",
    )
    right.plot(found.estimated, np.maximum(found.actual, 1e-300), "o", color=colour, markersize=4, label=found.label)
    right.set(xscale="log", yscale="log", xlabel="estimated relMSE", ylabel="squared error of the run's own picture")
    right.set_title("a run's estimate and its picture's own error")
    low, high = found.estimated.min() / 1.5, found.estimated.max() * 1.5
    right.plot([low, high], [low, high], color="#999999", linewidth=1, label="equal" if index == 0 else None)


def _stops(left: "Axes", right: "Axes", found: Stops, colour: str, index: int) -> None:
    left.plot(found.passes, found.actual / found.target, "o", color=colour, markersize=4, label=found.label)
    if index == 0:
        left.axhline(1, color="#555555", linewidth=1, label="as wanted")
    left.set(
        yscale="log",
        xscale="log",
        title="error where runs stopped",
        xlabel="passes of the run",
        ylabel="error / wanted error",
    )
    x = [f"{found.label},\nhalves stop\neach other", f"{found.label},\nown error"]
    half = abs(found.difference / found.z), abs(found.naive_difference / found.naive_z)
    right.errorbar(
        x, [100 * found.difference, 100 * found.naive_difference], [200 * h for h in half], fmt="o", color=colour,
        capsize=4, label=found.label,
    )  # fmt: skip
    right.axhline(0, color="#555555", linewidth=1)
    right.margins(x=0.15)
    right.set(title="mean of all pictures, with 2 standard errors", ylabel="off by [%]")


def _long(left: "Axes", right: "Axes", found: Long, colour: str) -> None:
    samples, mean, share = found.curve.T
    left.plot(samples, mean / mean[-1], color=colour, label=found.label)
    left.set(xscale="log", title="mean of a pixel, over the last one", xlabel="samples", ylabel="mean / last mean")
    right.plot(samples, share, color=colour, label=found.label)
    right.set(
        xscale="log", yscale="log", title="the largest sample's share of the pixel", xlabel="samples", ylabel="share"
    )
