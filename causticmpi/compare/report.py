"""What a finished comparison writes: tables, figures, the page that holds them all."""

from collections.abc import Sequence
from pathlib import Path

from causticmpi import __version__
from causticmpi.compare import charts, tables
from causticmpi.compare.analysis import PartResult
from causticmpi.compare.metrics import flip_missing
from causticmpi.compare.page import Image, Section, page, save, save_apart
from causticmpi.compare.paper import TWO_TABLES
from causticmpi.compare.plan import Plan
from causticmpi.compare.reference import told
from causticmpi.compare.tables import Table
from causticmpi.output.progress import clock

REPORT, TABLES, MEASUREMENTS = "report.html", "tables.md", "measurements.csv"

SHRUNK = "Whole pictures are shrunk, which hides noise: close-ups show pixels as they are."


def write_reports(plan: Plan, results: Sequence[PartResult], more: Sequence[Path] = ()) -> Path:
    """Write everything into the plan's directory; returns the path of the page.

    more: directories of further pictures (PNG), such as those of `causticmpi inspect`, to show on the page.
    """
    palette = charts.colours([variant.label for variant in plan.config.variants])
    sections = [_summary(plan, results), *(_section(result, palette) for result in results)]
    sections += [_further(directory) for directory in more]
    save_apart(plan.directory, sections)
    every = [item for section in sections for item in section.content if isinstance(item, Table)]
    save(plan.directory / TABLES, "\n".join([f"# {plan.config.title}", "", *map(tables.to_markdown, every)]).encode())
    save(plan.directory / MEASUREMENTS, tables.to_csv(tables.every_point(results)).encode())
    save(plan.directory / REPORT, page(plan.config.title, _introduction(plan, results), sections).encode())
    return plan.directory / REPORT


def _introduction(plan: Plan, results: Sequence[PartResult]) -> list[str]:
    runs = [measured for result in results for groups in result.groups.values() for g in groups for measured in g.runs]
    report = runs[0].report
    hosts = ", ".join(report["provenance"]["hosts"])
    scale = f" Budgets are scaled by {plan.config.scale:g}." if plan.config.scale != 1 else ""
    ranks = f"{report['ranks']} ranks" if report["ranks"] > 1 else "1 rank"
    lines = [
        f"causticmpi {__version__}, {ranks} on {hosts} (MPI: {report['provenance']['mpi']}), {len(runs)} runs one "
        f"after the other under one launch, {clock(sum(m.report['seconds']['total'] for m in runs))} in all.{scale}",
        "Every method has the same wall-clock time on the same ranks: loading the scene, the preprocess, tracing and "
        "writing are in it; compiling and loading the kernels are not. relMSE = mean((I - R)^2 / (R^2 + 0.01)) against "
        "the reference R, whose own variance is subtracted.",
    ]
    missing = flip_missing()
    return lines if missing is None else [*lines, missing + "."]


def _summary(plan: Plan, results: Sequence[PartResult]) -> Section:
    content = [
        table
        for table in (tables.samples_table(results), tables.timing_table(results, plan.config.scale))
        if table is not None
    ]
    disagreeing = [result.part.title for result in results if not result.reference.facts["agrees"]]
    alarm = f"References that failed their check: {', '.join(disagreeing)}." if disagreeing else ""
    references = [f"{result.part.title}: reference by {told(result.reference.facts)}." for result in results]
    return Section("References, samples and timings", references, content, alarm)


def _section(result: PartResult, palette: dict[str, str]) -> Section:
    name, longest = result.part.name, result.longest
    content: list[Table | Image] = [tables.error_table(result, seconds) for seconds in result.groups]
    content.append(tables.slope_table(result))
    variants = tables.variant_table(result)
    content += [] if variants is None else [variants]
    methods = ", ".join(group.name for group in longest)
    for against, words in (("seconds", "wall-clock time"), ("passes", "passes")):
        caption = f"{result.part.title}: error against {words}; {methods}. Thin lines: single seeds; FLIP: first seed."
        chart = charts.error_chart(result, palette, against)
        content.append(Image(f"{name}-error-against-{against}", charts.as_png(chart), caption))
    if len(result.groups) > 1:
        caption = f"{result.part.title}: pictures after each budget; {methods}. {SHRUNK}"
        content.append(Image(f"{name}-budgets", charts.as_jpeg(charts.budget_grid(result)), caption))
    for seconds, groups in result.groups.items():
        caption = f"{result.part.title} after {seconds:g} s: pictures at exposure 0, close-ups, error maps; {methods}."
        grid = charts.as_jpeg(charts.picture_grid(result, groups))
        content.append(Image(f"{name}-pictures-{seconds:g}s", grid, f"{caption} {SHRUNK}"))
    if result.part.scene.closeups and any(group.biased for group in longest):
        caption = (
            f"{result.part.title}: signed relative error in the close-ups; {methods}. Noise averages out over seeds "
            "and pixels, bias stays."
        )
        content.append(Image(f"{name}-bias", charts.as_jpeg(charts.bias_grid(result)), caption))
    return Section(result.part.title, [TWO_TABLES] if variants is not None else [], content)


def _further(directory: Path) -> Section:
    from PIL import Image as Picture

    images = []
    for path in sorted(directory.glob("*.png")):
        with Picture.open(path) as picture:
            caption = picture.info.get("Description", path.stem)
        images.append(Image(f"{directory.name}-{path.stem}", path.read_bytes(), caption))
    return Section(f"Inside the forecast: {directory.name}", [], images)
