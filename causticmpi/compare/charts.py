"""Charts and picture grids, drawn by matplotlib, which the extra `compare` brings along."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from causticmpi.compare.analysis import CURVES, SMOOTHING, Group, PartResult
from causticmpi.compare.metrics import relative_error
from causticmpi.compare.statistics import mean_curve
from causticmpi.errors import InputError
from causticmpi.output.png import srgb_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#5b4a9e", "#7f7f7f")
"""Okabe and Ito's colours, which the colour-blind tell apart; one for each variant, the same in all charts."""
CELL = 2.6
"""Inches of a picture in a grid."""


def require_matplotlib() -> None:
    """Raises InputError where the charts could not be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError("compare needs matplotlib for its charts: pip install '.[compare]' in the clone") from None


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour for every variant, by its place in the config."""
    return {label: PALETTE[i % len(PALETTE)] for i, label in enumerate(labels)}


def error_chart(result: PartResult, palette: Mapping[str, str], against: str) -> "Figure":
    """Error curves of all methods, one panel per metric. against: `seconds` or `passes`."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    # Padding in inches: a panel's title must not touch the axis above it.
    figure = Figure(figsize=(13, 9.6), layout=ConstrainedLayoutEngine(h_pad=0.12))
    panels = figure.subplots(2, 3)
    for panel, (metric, name) in zip(panels.flat, CURVES.items(), strict=True):
        panel.set(title=name + (" [radiance²]" if metric == "mse" else ""))
        drawn = [_curve(panel, group, metric, palette[group.label], against) for group in result.longest]
        if not any(drawn):
            nothing_to_show(panel, "no error above the reference's own")
            continue
        panel.set(xscale="log", yscale="log")
        panel.set_xlabel("wall-clock time [s]" if against == "seconds" else "passes (samples per pixel)")
        if metric != "flip" and against == "passes":
            _guide(panel)
        panel.grid(True, which="major", color="#dddddd", linewidth=0.8)
        panel.set_axisbelow(True)
        plain_ticks(panel)
        panel.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, edgecolor="none")
    axis = "time" if against == "seconds" else "passes"
    figure.suptitle(
        f"{result.part.title}: error against {axis}, budget {result.longest[0].seconds:g} s, "
        f"{result.longest[0].seeds}; in brackets the slope against passes"
    )
    return figure


def nothing_to_show(panel: "Axes", why: str) -> None:
    """Leave a panel empty: a logarithmic axis has no place for what is not positive."""
    panel.set(xticks=[], yticks=[])
    panel.text(0.5, 0.5, why, transform=panel.transAxes, ha="center", va="center", color="#666666")


def _curve(panel: "Axes", group: Group, metric: str, colour: str, against: str) -> bool:
    """Returns whether there was a point that could be drawn."""
    fit = group.slope(metric)
    label = group.name + (f" ({fit.mean:.2f})" if np.isfinite(fit.mean) else "")
    curves = group.curves(metric, against)
    if not curves:
        return False
    if len(curves) > 1:
        for curve in curves:
            panel.plot(*_positive(curve).T, color=colour, linewidth=0.7, alpha=0.35)
    mean = _positive(mean_curve(curves))
    panel.plot(*mean.T, "-o", color=colour, markersize=3.5, linewidth=1.8, label=label)
    return len(mean) > 0


def _positive(curve: np.ndarray) -> np.ndarray:
    """Without the points that a logarithmic axis cannot show."""
    return curve[curve[:, 1] > 0]


def plain_ticks(panel: "Axes") -> None:
    """Plain figures on logarithmic axes, the closer the shorter: powers of ten alone may leave one without a label."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() != "log":
            continue
        low, high = axis.get_view_interval()
        subs = (1.0,) if high > 200 * low else (1.0, 2.0, 5.0) if high > 8 * low else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
        axis.set_major_locator(LogLocator(10, subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _guide(panel: "Axes") -> None:
    """A dashed line of slope -1 through the middle of the panel."""
    (x0, x1), (y0, y1) = panel.get_xlim(), panel.get_ylim()
    x = np.geomspace(x0, x1, 2)
    y = np.sqrt(y0 * y1) * np.sqrt(x0 * x1) / x
    panel.plot(x, y, "--", color="#999999", linewidth=1, label="slope -1", zorder=0)
    panel.set(xlim=(x0, x1), ylim=(y0, y1))


def picture_grid(result: PartResult, groups: Sequence[Group]) -> "Figure":
    """The reference and every method: picture, close-ups, error map, signed error; as the paper's Figures 3 to 6."""
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure

    closeups = result.part.scene.closeups
    height, width, _ = result.reference.rgb.shape
    aspect = height / width
    heights = [aspect, *(_shape(c) for c in closeups), aspect, aspect]
    columns = len(groups) + 1
    figure = Figure(
        figsize=(CELL * columns + 1.0, CELL * sum(heights) + 0.25 * len(heights) + 0.5), layout="constrained"
    )
    cells = figure.subplots(len(heights), columns, height_ratios=heights, squeeze=False)
    for cell in cells.flat:
        cell.set(xticks=[], yticks=[])
        cell.set_frame_on(False)
    pictures = [("reference", result.reference.rgb)]
    pictures += [(f"{g.name}\n{g.runs[0].final.passes} samples per pixel", g.rgb) for g in groups]
    for column, (name, rgb) in enumerate(pictures):
        _show_picture(list(cells[:, column]), name, rgb, result)
    errors = [relative_error(group.rgb, result.reference) for group in groups]
    top = max(float(np.percentile(np.concatenate([e.ravel() for e in errors]), 99)), 1e-5)
    signed_top = max(float(np.percentile(np.abs(np.concatenate([g.signed.ravel() for g in groups])), 99)), 1e-6)
    for column, (group, error) in enumerate(zip(groups, errors, strict=True), 1):
        heat = cells[-2, column].imshow(
            np.maximum(error, top / 1e3), norm=LogNorm(top / 1e3, top), cmap="magma", interpolation="nearest"
        )
        signed = cells[-1, column].imshow(
            group.signed, norm=Normalize(-signed_top, signed_top), cmap="RdBu_r", interpolation="nearest"
        )
    figure.colorbar(heat, ax=cells[-2, :], fraction=0.03, pad=0.01)
    figure.colorbar(signed, ax=cells[-1, :], fraction=0.03, pad=0.01)
    cells[-2, 0].text(0.5, 0.5, "squared relative\nerror, first seed", ha="center", va="center", fontsize=11)
    cells[-1, 0].text(
        0.5, 0.5,
        f"signed relative error,\nmean of {groups[0].seeds} and\nof {SMOOTHING} x {SMOOTHING} pixels;\nred: too bright",
        ha="center", va="center", fontsize=11,
    )  # fmt: skip
    figure.suptitle(f"{result.part.title}: after {groups[0].seconds:g} s", fontsize=13)
    return figure


def _shape(rectangle: Sequence[int]) -> float:
    x0, y0, x1, y1 = rectangle
    return (y1 - y0) / (x1 - x0)


def _show_picture(cells: Sequence[Any], name: str, rgb: np.ndarray, result: PartResult) -> None:
    from matplotlib.patches import Rectangle

    cells[0].set_title(name, fontsize=10)
    shown = srgb_bytes(rgb)
    cells[0].imshow(shown, interpolation="antialiased")
    left, top = result.part.base.film.window[:2]
    for cell, (x0, y0, x1, y1) in zip(cells[1:], result.part.scene.closeups, strict=False):
        cell.imshow(shown[y0 - top : y1 - top, x0 - left : x1 - left], interpolation="nearest")
        frame = (x0 - left - 0.5, y0 - top - 0.5)
        cells[0].add_patch(Rectangle(frame, x1 - x0, y1 - y0, fill=False, edgecolor="#ffd400", linewidth=1))


def budget_grid(result: PartResult) -> "Figure":
    """Methods down, budgets across: the paper's Figure 5."""
    from matplotlib.figure import Figure

    budgets = sorted(result.groups)
    labels = [group.label for group in result.longest]
    height, width, _ = result.reference.rgb.shape
    figure = Figure(
        figsize=(CELL * len(budgets) + 0.6, CELL * height / width * len(labels) + 0.9), layout="constrained"
    )
    cells = figure.subplots(len(labels), len(budgets), squeeze=False)
    for column, seconds in enumerate(budgets):
        for row, group in enumerate(result.groups[seconds]):
            cell = cells[row, column]
            cell.set(xticks=[], yticks=[])
            cell.imshow(srgb_bytes(group.rgb), interpolation="antialiased")
            caption = f"{group.runs[0].final.passes} samples per pixel"
            cell.set_title(f"{seconds:g} s\n{caption}" if row == 0 else caption, fontsize=9)
            if column == 0:
                cell.set_ylabel(group.name, fontsize=10)
    figure.suptitle(f"{result.part.title}: methods and budgets", fontsize=13)
    return figure


def bias_grid(result: PartResult) -> "Figure":
    """Signed relative error in the close-ups, one column per method, one scale a row: bias does not average out."""
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    groups, closeups = result.longest, result.part.scene.closeups
    left, top = result.part.base.film.window[:2]
    heights = [_shape(closeup) for closeup in closeups]
    figure = Figure(
        figsize=(CELL * len(groups) + 1.0, CELL * sum(heights) + 0.3 * len(heights) + 0.6), layout="constrained"
    )
    cells = figure.subplots(len(closeups), len(groups), height_ratios=heights, squeeze=False)
    parts = [[g.signed[y0 - top : y1 - top, x0 - left : x1 - left] for g in groups] for x0, y0, x1, y1 in closeups]
    for row, crops in zip(cells, parts, strict=True):
        most = max(float(np.percentile(np.abs(np.concatenate([crop.ravel() for crop in crops])), 99)), 1e-6)
        for cell, crop in zip(row, crops, strict=True):
            cell.set(xticks=[], yticks=[])
            shown = cell.imshow(crop, norm=Normalize(-most, most), cmap="RdBu_r", interpolation="nearest")
        figure.colorbar(shown, ax=row, fraction=0.03, pad=0.01)
    for cell, group in zip(cells[0], groups, strict=True):
        cell.set_title(f"{group.name}\n{group.runs[0].final.passes} samples per pixel", fontsize=10)
    figure.suptitle(
        f"{result.part.title}: close-ups\nsigned relative error, mean of {groups[0].seeds}\nred: too bright",
        fontsize=12,
    )
    return figure


def as_png(figure: "Figure") -> bytes:
    """For charts: few colours, sharp lines."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()


def as_jpeg(figure: "Figure") -> bytes:
    """For pictures, a tenth of a PNG's size: noise hardly compresses."""
    out = io.BytesIO()
    figure.savefig(out, format="jpeg", dpi=130, pil_kwargs={"quality": 88})
    return out.getvalue()
