"""Tables and charts of a page."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from causticmpi.compare.charts import PALETTE
from causticmpi.compare.statistics import FEW_HITS
from causticmpi.compare.tables import NOTHING, Table, number
from causticmpi.output.png import srgb_bytes
from causticmpi.stability.records import Page
from causticmpi.stability.row import Kind, Row
from causticmpi.stability.sweep import AGAIN
from causticmpi.stability.verdicts import shown

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

LONGEST = 160
"""Characters of a reason in a table."""
SPREAD = 4.0
"""Points between the marks of two methods in the chart of z."""
MOST_TICKS = 8
"""Values that have a tick of their own each on a logarithmic axis."""
GREY = "#777777"
FIT = 52
"""Characters beside one another under a panel."""
FAR = 6.0
"""Standard errors at which the chart of z ends."""


def table(name: str, page: Page, rows: Sequence[Row]) -> Table:
    """All cells of a sweep."""
    assert page.sweep is not None
    columns = (
        page.sweep.name, "method", f"relMSE at {page.equal_time:g} s", "bias² (relative)", "passes", "ms / pass",
        "rays / sample", "mean L_c", "preprocess [s]", "slowest / mean pass", "memory [MB]", "worst pixel's share",
        "tested against", "p", "z of mean", "difference", "resolution", "verdict", "seed", "warned beforehand",
    )  # fmt: skip
    return Table(
        name,
        f"{page.title}: all cells",
        columns,
        tuple(_cells(row) for row in rows),
        f"relMSE: what {page.equal_time:g} CPU seconds would leave, preprocess included, from the variance over "
        f"{page.batches} batches; biased methods add their squared bias. p: Welch's t-test of the mean and 48 means of "
        "squares, Sidak-corrected; resolution: standard error of the difference of the pictures' means. WRONG: the "
        f"test fails, and fails again for other passes in {AGAIN:g} times the CPU time, whose figures then stand here. "
        "Blind: some mean is too low (or the light is met by chance), none too high, and the picture is "
        f"made of so few rare hits (their number; below {FEW_HITS}) that neither mean nor error can be believed. Of "
        "several seeds: relMSE is the mean over all, the rest is of the seed named, that of the worst verdict.",
    )


def _cells(row: Row) -> tuple[str, ...]:
    name = row.label + (" (biased)" if row.biased else "")
    relmse = "∞" if row.relmse == math.inf else number(row.relmse)
    return (
        shown(row.value), name, relmse, number(row.bias, 2), str(row.passes or NOTHING),
        number(1e3 * row.pass_seconds), number(row.rays), number(row.caustic), number(row.preprocess, 2),
        number(row.slowest, 2), number(row.memory_mb), _percent(row.share), row.against or NOTHING, number(row.p, 2),
        f"{row.whole:+.2f}" if math.isfinite(row.whole) else NOTHING, _percent(row.difference, "+"),
        _percent(row.resolution), row.verdict.words[:LONGEST],
        NOTHING if row.seed is None else str(row.seed), "; ".join(row.warnings)[:LONGEST],
    )  # fmt: skip


def _percent(value: float, sign: str = "") -> str:
    return f"{100 * value:{sign}.2g} %" if math.isfinite(value) else NOTHING


def chart(page: Page, rows: Sequence[Row]) -> "Figure":
    """Error at equal time and z of the picture's mean against the parameter, a strip of pictures below."""
    from matplotlib.figure import Figure

    assert page.sweep is not None
    values = page.sweep.values
    figure = Figure(figsize=(9.5, 6.6), layout="constrained")
    grid = figure.subfigures(2, 1, height_ratios=(3, 1.25), squeeze=False)
    upper, lower = grid[:, 0]
    error, deviation = upper.subplots(1, 2)
    by_number = all(math.isfinite(row.x) and row.x > 0 for row in rows)
    place = {shown(row.value): row.x if by_number else float(_index(values, row)) for row in rows}
    for panel in (error, deviation):
        _axis(panel, page, rows, place, by_number)
    for i, contender in enumerate(page.contenders):
        own = sorted((row for row in rows if row.label == contender.label), key=lambda row: place[shown(row.value)])
        aside = SPREAD * (i - (len(page.contenders) - 1) / 2)
        _curves(error, deviation, own, place, PALETTE[i % len(PALETTE)], aside)
    if any(not row.trusted and math.isfinite(row.relmse) for row in rows):
        error.plot([], [], "o:", color=GREY, markerfacecolor="white", label="too few hits to judge")
    if any(row.off for row in rows):
        error.plot([], [], "X", color=GREY, markersize=9, label="wrong")
    error.set(yscale="log", title=f"relMSE after {page.equal_time:g} CPU seconds", ylabel="relMSE")
    title = "deviation of the picture's mean from the truth" if page.truth.exact != 0 else "leaked radiance"
    deviation.axhspan(-3, 3, color="#eeeeee", zorder=0)
    deviation.set(ylim=(-FAR - 0.5, FAR + 0.5), title=title, ylabel=f"standard errors (clipped at {FAR:g})")
    deviation.set_xlim(error.get_xlim())
    _legend(upper, (error, deviation))
    _strip(lower, page, sorted(rows, key=lambda row: place[shown(row.value)]))
    return figure


def _legend(figure: "SubFigure", panels: Sequence["Axes"]) -> None:
    """Of what is drawn, each name once, below the panels: in one it would hide marks."""
    named: dict[str, Artist] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    figure.legend(named.values(), named.keys(), fontsize=8, edgecolor="none", ncols=6, loc="outside lower center")


def _index(values: Sequence[object], row: Row) -> int:
    return list(values).index(row.value)


def _axis(panel: "Axes", page: Page, rows: Sequence[Row], place: dict[str, float], by_number: bool) -> None:
    assert page.sweep is not None
    # `auto` has a number of its own, beside others: a line shows it.
    ticks = {label: x for label, x in place.items() if not (by_number and label == page.sweep.start == "auto")}
    panel.set_xlabel(page.sweep.name)
    if by_number and max(place.values()) > 8 * min(place.values()):
        panel.set_xscale("log")
        if len(ticks) <= MOST_TICKS:
            panel.set_xticks(list(ticks.values()), list(ticks))
            panel.set_xticks([], minor=True)
    elif by_number and len(ticks) <= MOST_TICKS and _apart(list(ticks.values())):
        panel.set_xticks(list(ticks.values()), list(ticks))
    if not by_number:
        turned = sum(len(label) + 2 for label in place) > FIT
        panel.set_xticks(
            list(place.values()), list(place), rotation=30 if turned else 0, ha="right" if turned else "center"
        )
        panel.set_xlim(-0.4, len(place) - 0.6)
    start = None if page.sweep.start is None else place.get(shown(page.sweep.start))
    if start is not None:
        name = "default (auto)" if page.sweep.start == "auto" else "default"
        panel.axvline(start, color="#999999", linestyle=":", linewidth=1.5, label=name)
    for label in {shown(row.value) for row in rows} - {
        shown(row.value) for row in rows if row.kind is not Kind.REFUSED
    }:
        at = (place[label], 0.02)
        panel.annotate("refused", at, xycoords=("data", "axes fraction"), rotation=90, fontsize=8, color=GREY)
    panel.grid(True, which="major", color="#dddddd", linewidth=0.8)
    panel.set_axisbelow(True)


def _apart(values: list[float]) -> bool:
    """Whether labels at these values would not touch."""
    gaps = np.diff(sorted(values))
    return len(gaps) == 0 or bool(gaps.min() > 0.06 * gaps.sum())


def _curves(
    error: "Axes", deviation: "Axes", rows: Sequence[Row], place: dict[str, float], colour: str, aside: float
) -> None:
    """aside: points by which the marks of z are moved, so that none hides another."""
    from matplotlib.transforms import ScaledTranslation

    known = [row for row in rows if math.isfinite(row.relmse) and row.relmse > 0]
    if not rows:
        return
    label = rows[0].label + (" (biased)" if any(row.biased for row in rows) else "")
    if known:
        x = [place[shown(row.value)] for row in known]
        error.plot(x, [row.relmse for row in known], ":", color=colour, linewidth=1.2, alpha=0.8)
        believed = [row.relmse if row.trusted else math.nan for row in known]  # a line from one believed to the next
        error.plot(x, believed, "-", color=colour, linewidth=1.6, alpha=0.8)
        error.plot([], [], "-o", color=colour, label=label)
        for row in known:
            marker, size = ("X", 9.0) if row.off else ("o", 6.0)
            face = colour if row.trusted else "white"
            error.plot(place[shown(row.value)], row.relmse, marker, color=colour, markerfacecolor=face, markersize=size)
    moved = deviation.transData + ScaledTranslation(aside / 72, 0, deviation.figure.dpi_scale_trans)
    for row in (row for row in rows if row.kind is not Kind.REFUSED):
        meaning, marker, face, size = _mark(row, colour)
        placed = row.tested or row.kind is Kind.BLIND and math.isfinite(row.whole)
        z = float(np.clip(row.whole, -FAR, FAR)) if placed else -FAR
        deviation.plot(
            place[shown(row.value)], z, marker, color=colour, markerfacecolor=face, markersize=size, transform=moved
        )
        if meaning:  # grey: it is the shape that has this meaning, in any colour
            shape = "none" if face == "none" else GREY
            deviation.plot([], [], marker, color=GREY, markerfacecolor=shape, markersize=size, label=meaning)


def _mark(row: Row, colour: str) -> tuple[str | None, str, str, float]:
    """Name in the legend, shape, face and size of a mark of z."""
    if row.kind is Kind.BLIND:
        return "too few hits to judge", "o", "none", 5
    if not row.tested:
        return "not tested", "|", colour, 9
    if row.off:
        return "wrong", "X", colour, 9
    return None, "o", colour, 5


def shown_in_pictures(page: Page) -> str:
    """Label of the contender whose pictures stand below the chart."""
    return page.claim.of if page.claim is not None else page.contenders[-1].label


def _strip(figure: "SubFigure", page: Page, rows: Sequence[Row]) -> None:
    """One contender's picture at each value, or what is wrong with it if it is biased; a cell without a picture
    says why."""
    assert page.sweep is not None
    label = shown_in_pictures(page)
    own = [row for row in rows if row.label == label]
    cells = figure.subplots(1, len(own), squeeze=False)[0]
    for cell, row in zip(cells, own, strict=True):
        cell.set(xticks=[], yticks=[])
        cell.set_title(shown(row.value), fontsize=9)
        if row.rgb is None:
            cell.set_box_aspect(1)
            cell.text(0.5, 0.5, "refused", ha="center", va="center", fontsize=8, wrap=True)
        elif row.signed is not None:
            cell.imshow(row.signed, vmin=-0.5, vmax=0.5, cmap="RdBu_r", interpolation="nearest")
        else:
            cell.imshow(srgb_bytes(row.rgb), interpolation="nearest")
    signed = any(row.signed is not None for row in own)
    cells[0].set_ylabel(f"{label}:\ntoo bright red,\ntoo dark blue\n(±50 %)" if signed else label, fontsize=8)
