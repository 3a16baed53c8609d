"""Error against CPU time, both logarithmic: a row of panels for each scene, untrimmed and trimmed."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from causticmpi.compare.charts import nothing_to_show, plain_ticks
from causticmpi.peers.results import ALL, Contender, Point, averaged

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METRICS = {"relmse": "relMSE", "trimmed": "relMSE, the worst 0.1 % of pixels left out"}
MARKERS = {"causticmpi": "o", "Mitsuba": "s", "LuxCore": "^"}
COLOURS = {
    "causticmpi": ("#7f7f7f", "#d55e00", "#0072b2"),
    "Mitsuba": ("#009e73", "#8fd0b8"),
    "LuxCore": ("#5b4a9e", "#cc79a7", "#b08cd9", "#e69f00", "#8c6d31"),
}


def chart(scenes: Mapping[str, Sequence[Point]]) -> "Figure":
    """All scenes of `scenes`, points by name. Dashed: methods that do not converge to the reference."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 3.6 * len(scenes) + 0.6), layout="constrained")
    panels = figure.subplots(len(scenes), len(METRICS), squeeze=False)
    lines: dict[str, Any] = {}
    for row, (scene, points) in zip(panels, scenes.items(), strict=True):
        for panel, (metric, title) in zip(row, METRICS.items(), strict=True):
            panel.set(title=f"{scene}: {title}")
            lines |= _draw(panel, averaged(points), metric)
            if not any(getattr(point, metric) > 0 for point in points):
                nothing_to_show(panel, "no error above the reference's own")
                continue
            panel.set(xscale="log", yscale="log", xlabel="CPU seconds, one thread")
            panel.grid(True, which="major", color="#dddddd", linewidth=0.8)
            panel.set_axisbelow(True)
            plain_ticks(panel)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def _draw(panel: "Axes", points: Sequence[Point], metric: str) -> dict[str, Any]:
    """One line for each contender; returns lines by label."""
    lines = {}
    contenders = list(dict.fromkeys(point.contender for point in points))
    for contender in contenders:
        curve = [(p.seconds, getattr(p, metric)) for p in points if p.contender == contender]
        curve = [(x, y) for x, y in curve if y > 0]
        own = contender.renderer == "causticmpi"
        label = f"{contender.renderer} {contender.label}"
        label += f" ({contender.caveat.partition(':')[0]})" if contender.caveat else ""
        (lines[label],) = panel.plot(
            *zip(*curve, strict=True) if curve else ([], []),
            linestyle="--" if contender.caveat else "-",
            marker=MARKERS.get(contender.renderer, "d"),
            color=_colour(contender),
            linewidth=2.6 if own else 1.4,
            markersize=6 if own else 4.5,
            zorder=3 if own else 2,
        )
    return lines


def _colour(contender: Contender) -> str:
    """The same for a method whatever others are drawn."""
    family = [other.name for other in ALL if other.renderer == contender.renderer]
    colours = COLOURS[contender.renderer]
    return colours[family.index(contender.name) % len(colours)]
