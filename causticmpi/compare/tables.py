"""Tables of a comparison: plain rows first, then CSV, Markdown and HTML from the same rows."""

import csv
import html
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from causticmpi.compare.analysis import CURVES, Group, PartResult
from causticmpi.compare.paper import PAPER, TABLE_1
from causticmpi.compare.statistics import Interval, interval

NOTHING = "–"


@dataclass(frozen=True)
class Table:
    """A title, column names, rows of text; `note` says what a reader has to know."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def number(value: float, digits: int = 3) -> str:
    """A number for people; a dash for nan."""
    if not math.isfinite(value):
        return NOTHING
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def with_interval(found: Interval) -> str:
    """mean ± half, the interval left out where there is one value."""
    if found.count == 0 or not math.isfinite(found.mean):
        return NOTHING
    if not math.isfinite(found.half) or found.half <= 0:
        return number(found.mean)
    places = max(0, 1 - math.floor(math.log10(found.half)))  # two digits of the interval, as many places of the mean
    return f"{found.mean:.{places}f} ± {found.half:.{places}f}"


def error_table(result: PartResult, seconds: float) -> Table:
    """All metrics of one scene at one budget."""
    groups = result.groups[seconds]
    rows = [
        (
            group.name,
            with_interval(group.passes()),
            *(
                with_interval(group.error(metric))
                for metric in ("rmse", "relmse", "trimmed_relmse", "mask_relmse", "mask_trimmed_relmse", "flip")
            ),
            _speed_up(group, groups),
        )
        for group in groups
    ]
    errors = groups[0].final_errors
    return Table(
        f"errors-{result.part.name}-{seconds:g}s",
        f"{result.part.title}: after {seconds:g} s",
        (
            "method",
            "samples per pixel",
            "RMSE [radiance]",
            "relMSE",
            "relMSE trimmed",
            "relMSE in mask",
            "relMSE in mask, trimmed",
            "FLIP",
            "efficiency / pt",
        ),
        tuple(rows),
        f"Mean ± 95 % interval over {groups[0].seeds}{_too_few(groups[0])}. Trimmed: the worst 0.1 % of pixels left "
        f"out. Mask: {100 * result.mask.mean():.1f} % of the pixels, where the reference's caustic layer is above the "
        f"mask level. The reference's own relMSE, {number(errors.own_relmse)}, has been subtracted. Efficiency: relMSE "
        "of pt over that of the method, at equal time.",
    )


def _too_few(group: Group) -> str:
    return " (two are too few: it spans nine times their spread)" if len(group.runs) == 2 else ""


def _speed_up(group: Group, groups: Sequence[Group]) -> str:
    rival = next((other for other in groups if other.method == "pt"), None)
    if rival is None or group.error("relmse").mean <= 0:
        return NOTHING
    return number(rival.error("relmse").mean / group.error("relmse").mean)


def slope_table(result: PartResult) -> Table:
    """Fitted slopes at the longest budget."""
    groups = result.longest
    return Table(
        f"slopes-{result.part.name}",
        f"{result.part.title}: slope of log error against log passes",
        ("method", "passes", *CURVES.values(), "floor of relMSE", "floor in mask"),
        tuple(
            (
                group.name,
                _range(group),
                *(with_interval(group.slope(metric)) for metric in CURVES),
                *(with_interval(group.floor(metric)) for metric in ("relmse", "mask_relmse")),
            )
            for group in groups
        ),
        f"Fitted to the last decade of passes of the mean over {groups[0].seeds}, with a 95 % interval by the "
        "jackknife. An unbiased method has -1 in squared errors and no floor; a biased one flattens towards its floor, "
        "f in a fit of f + a / passes. Trimmed errors need not have -1: where few passes leave rare bright samples far "
        "apart, the part left out holds nearly all of them.",
    )


def _range(group: Group) -> str:
    points = group.runs[0].points
    last = points[-1].passes
    return f"{min(p.passes for p in points if p.passes >= last / 10)} to {last}"


def variant_table(result: PartResult) -> Table | None:
    """Variants of one method against the first at the longest budget, paired by seed.

    None for less than two seeds, and where methods are compared.
    """
    first, *others = result.longest
    if len(first.runs) < 2 or not others or {group.method for group in others} != {first.method}:
        return None
    rows = []
    for group in others:
        samples = np.array([m.final.passes for m in group.runs]) / [m.final.passes for m in first.runs]
        rmse = group.errors("rmse") / first.errors("rmse")
        relmse = group.errors("relmse") / first.errors("relmse")
        trimmed = group.errors("trimmed_relmse") / first.errors("trimmed_relmse")
        rows.append((group.name, *(_percent(ratios) for ratios in (samples, rmse, relmse, trimmed))))
    return Table(
        f"variants-{result.part.name}",
        f"{result.part.title}: difference to {first.name} at equal time",
        ("variant", "samples per pixel", "RMSE", "relMSE", "relMSE trimmed"),
        tuple(rows),
        f"Mean ± 95 % interval over {first.seeds}, paired by seed. Below zero is fewer samples, less error.",
    )


def _percent(ratios: np.ndarray) -> str:
    found = interval(100 * (ratios[np.isfinite(ratios)] - 1))
    if found.count == 0:
        return NOTHING
    return f"{found.mean:+.1f} % ± {found.half:.1f}"


def samples_table(results: Sequence[PartResult]) -> Table | None:
    """Samples per pixel at equal time beside the paper's."""
    rows = []
    for result in results:
        paper = PAPER.get(result.part.scene.paper or "")
        if paper is None or paper.samples is None:
            continue
        numbers, where = paper.samples, f"{paper.minutes:g} min, {paper.figure}"
        groups = result.longest
        ours = {group.label: group.passes().mean for group in groups}
        forecast = [group for group in groups if group.method == "iws+cf"]
        for group in groups:
            ratio = "" if not forecast else number(ours[group.label] / ours[forecast[0].label])
            theirs = numbers.get(group.method)
            rows.append(
                (
                    result.part.title,
                    group.name,
                    f"{ours[group.label]:.0f} in {group.seconds:g} s",
                    ratio,
                    NOTHING if theirs is None else f"{theirs} ({where})",
                    NOTHING if theirs is None else number(theirs / numbers["iws+cf"]),
                )
            )
    if not rows:
        return None
    return Table(
        "samples",
        "Samples per pixel at equal time, beside the paper's",
        ("scene", "method", "ours", "ratio to our first iws+cf", "paper (20 cores)", "paper's ratio to IWS+CF"),
        tuple(rows),
        "The paper has one IWS+CF, with two tables. Its ratio of path tracing to IWS+CF is 6.2 (Figure 3) and 6.75 "
        "(Figure 4). Its hardware and ray tracer are of 2008: compare ratios, not samples.",
    )


def timing_table(results: Sequence[PartResult], scale: float) -> Table | None:
    """The paper's Table 1: its rows, ours beside them, from the budget nearest to `scale` times the paper's."""
    columns = ["stage"]
    values: list[list[str]] = [[] for _ in range(len(TABLE_1) + 2)]
    for result in results:
        paper = PAPER.get(result.part.scene.paper or "")
        if paper is None:
            continue
        wanted = 60 * paper.minutes * scale
        nearest = result.groups[min(result.groups, key=lambda seconds: abs(seconds - wanted))]
        group = next((group for group in nearest if group.method == "iws+cf"), None)
        if group is None:
            continue
        columns += [f"{result.part.title}, {group.name}, {group.seconds:g} s", f"paper, {paper.minutes:g} min"]
        for row, (mine, theirs) in enumerate(zip(_timings(result, group), paper.timings.values(), strict=True)):
            values[row] += [mine, f"{theirs:g} s"]
        values[-2] += [f"{group.runs[0].report['forecast']['photons']:,}", f"{paper.photons:,}"]
        values[-1] += [f"{group.runs[0].final.passes}", NOTHING]
    if len(columns) == 1:
        return None
    names = (*TABLE_1, "forecast photons", "samples per pixel")
    return Table(
        "table-1",
        "Table 1: seconds by stage",
        tuple(columns),
        tuple((name, *row) for name, row in zip(names, values, strict=True)),
        f"Ours: wall clock on all ranks ({results[0].longest[0].runs[0].report['ranks']}), the preprocess on rank 0 "
        "alone. The paper's: the same pictures on a single core. Total without caustics: the cost of a pass of L_d "
        "alone, measured in a run of its own, times the passes of the run with caustics. CDFs are created for every "
        "group of neighbouring vertices inside the compiled gather and are not timed apart (–).",
    )


def _timings(result: PartResult, group: Group) -> list[str]:
    run = group.runs[0]
    seconds = run.report["seconds"]
    alone = next((m.report for m in result.timing if m.run.config.method == "iws"), None)
    without = NOTHING
    if alone is not None:
        without = f"{alone['seconds']['tracing'] / alone['passes'] * run.final.passes:.1f} s"
    tables = f"{seconds['tables']:.3g} s" if seconds["tables"] > 0 else NOTHING
    stages = [f"{seconds[stage]:.3g} s" for stage in ("photons", "clustering", "trees")]
    return [without, f"{seconds['total']:.1f} s", *stages, tables]


def every_point(results: Sequence[PartResult]) -> Table:
    """All measurements, one row for each picture of each run."""
    rows = []
    for result in results:
        for groups in result.groups.values():
            for group in groups:
                for measured in group.runs:
                    for point in measured.points:
                        errors = asdict(point.errors)
                        rows.append(
                            (
                                result.part.name,
                                group.name,
                                "yes" if group.biased else "no",
                                f"{group.seconds:g}",
                                str(measured.run.seed),
                                str(point.passes),
                                f"{point.seconds:.3f}",
                                *("" if math.isnan(value) else f"{value:.6g}" for value in errors.values()),
                            )
                        )
    names = ("scene", "method", "biased", "budget_seconds", "seed", "passes", "seconds")
    metrics = tuple(asdict(results[0].longest[0].final_errors))
    return Table("measurements", "Every picture of every run", (*names, *metrics), tuple(rows))


def to_csv(table: Table) -> str:
    """RFC 4180."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    return out.getvalue()


def to_markdown(table: Table) -> str:
    """A heading, the table, the note."""
    lines = [f"## {table.title}", ""]
    lines += ["| " + " | ".join(row) + " |" for row in (table.columns, ["---"] * len(table.columns), *table.rows)]
    return "\n".join([*lines, "", table.note, ""])


def to_html(table: Table) -> str:
    """The table and its note; the heading is the page's."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>{note}'
