"""The stability report: pages read and checked, cells measured by several processes, one HTML page written."""

import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from causticmpi import __version__
from causticmpi.compare import charts, tables
from causticmpi.compare.page import Image, Section, page
from causticmpi.compare.tables import Table
from causticmpi.config.command_line import Parser, count, one_line, positive
from causticmpi.config.convert import convert
from causticmpi.config.yaml_source import read_yaml
from causticmpi.errors import InputError
from causticmpi.output.directory import write_whole
from causticmpi.output.progress import clock
from causticmpi.stability import runs, seeds, show, show_runs, sweep, verdicts
from causticmpi.stability.records import Page
from causticmpi.stability.row import Kind

REPORT, TABLES = "report.html", "tables.md"
SUMMARY = "Verdicts"


@dataclass(frozen=True)
class Loaded:
    """A page, the name it has from its file, and the directory of that file."""

    name: str
    page: Page
    place: Path


def read_pages(files: Sequence[Path]) -> list[Loaded]:
    """Read and check every page. Raises InputError with its place."""
    pages = []
    for file in files:
        source = read_yaml(file)
        made = convert(source, (), source.data, Page)
        try:
            sweep.check_page(made, source.file.parent)
        except InputError as error:
            raise InputError(str(error), source.file) from None
        pages.append(Loaded(file.stem, made, source.file.parent))
    return pages


def make_report(files: Sequence[Path], out: Path, scale: float, processes: int, command: str, turns: int = 1) -> int:
    """Measure all pages and write the report into `out`; the number of cells that are wrong.

    scale: of all CPU times, numbers of runs and samples; turns: seeds of each sweep.
    """
    charts.require_matplotlib()
    pages = read_pages(files)
    out.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    # Spawned, not forked: each process has its own Embree device; compiled kernels come from the disk.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = [(loaded, _submit(pool.submit, loaded, out / loaded.name, scale, turns)) for loaded in pages]
        sections, wrong = [], 0
        for loaded, tasks in waiting:
            section, failed = _section(loaded, {name: task.result() for name, task in tasks.items()}, turns)
            print(f"{clock(time.monotonic() - began)} {loaded.name}: {section.paragraphs[1]}", flush=True)
            sections.append(section)
            wrong += failed
            # After every page: a report that is stopped holds what has been measured.
            _write(out, sections, scale, processes, time.monotonic() - began, command)
    print(out / REPORT)
    return wrong


def _submit(
    submit: Callable[..., Future[Any]], loaded: Loaded, out: Path, scale: float, turns: int
) -> dict[str, Future[Any]]:
    """Start a page's tasks; their results are what `_section` takes, a sweep's all by one seed, then by the next."""
    made = loaded.page
    if made.sweep is None:
        file = sweep.scene_file(made, loaded.place, out, 0)
        return {c.label: submit(runs.RUNS[made.kind], made, c, file, scale) for c in made.contenders}
    tasks = {
        f"{turn}/{i}": submit(sweep.measure_point, made, loaded.place, out / f"{turn}" if turn else out, i, scale, turn)
        for turn in range(turns)
        for i in range(len(made.sweep.values))
    }
    if sweep.rivals_are_common(made) and made.truth.rivals:
        tasks["rivals"] = submit(sweep.measure_rivals, made, loaded.place, out, scale)
    return tasks


def _section(loaded: Loaded, results: dict[str, Any], turns: int) -> tuple[Section, int]:
    """The section of a page, and how many of its cells are wrong."""
    made, name = loaded.page, loaded.name
    if made.sweep is None:
        of_runs = list(results.values())
        content: list[Table | Image] = [Image(name, charts.as_png(show_runs.chart(of_runs)), made.title)]
        content.append(show_runs.table(name, made, of_runs))
        return Section(made.title, [made.question, runs.verdict(of_runs)], content), 0
    rivals = results.pop("rivals", [])
    by_seed = sweep.rows_by_seed(made, list(results.values()), rivals, turns)
    every = [row for rows in by_seed for row in rows]
    rows = seeds.pooled(made, by_seed)
    failing = verdicts.failures(every)
    wrong = [row for row in every if row.kind is Kind.WRONG]
    cells = [] if made.claim is None else seeds.cells(made, made.claim, by_seed)
    found = f"{verdicts.verdict(made, rows)} {verdicts.unbiasedness(every)}".strip()
    if made.claim is not None and turns > 1:
        found = f"{seeds.said(made, made.claim, cells, turns)} {found}"
    paragraphs = [made.question, found]
    paragraphs += ["Cells that fail: " + "; ".join(failing) + "."] if failing else []
    caption = f"{made.title}. Below: pictures of {show.shown_in_pictures(made)} by {made.sweep.name}."
    content = [Image(name, charts.as_png(show.chart(made, rows)), caption)]
    content += [seeds.table(name, made, made.claim, cells, turns)] if made.claim is not None else []
    content.append(show.table(name, made, rows))
    alarm = f"{len(wrong)} cells are wrong." if wrong else ""
    return Section(made.title, paragraphs, content, alarm), len(wrong)


def _write(out: Path, sections: Sequence[Section], scale: float, processes: int, seconds: float, command: str) -> None:
    title = "Where methods fail"
    summary = Table(
        "verdicts", "All verdicts", ("page", "verdict"), tuple((s.title, s.paragraphs[1]) for s in sections)
    )
    introduction = [
        f"causticmpi {__version__}, {processes} processes, {clock(seconds)}, CPU times times {scale:g}. "
        f"Made anew by: {command}",
        "Each contender has the same CPU time in each cell, in independent batches; seeds are 1, 2, … for contenders, "
        f"{sweep.NEXT_SEED} more for each further seed of a page, and 1001, 1002, … for the rivals they are tested "
        "against. Verdicts are formed from the figures below them.",
    ]
    markdown = [f"# {title}", ""]
    for section in sections:
        markdown += [f"## {section.title}", "", *(text + "\n" for text in section.paragraphs)]
        for item in section.content:
            if isinstance(item, Image):
                _save(out / "figures" / f"{item.name}.{item.suffix}", item.data)
            else:
                markdown.append(tables.to_markdown(item))
                _save(out / "tables" / f"{item.name}.csv", tables.to_csv(item).encode())
    _save(out / TABLES, "\n".join(markdown).encode())
    whole = [Section(SUMMARY, [], [summary]), *sections]
    _save(out / REPORT, page(title, introduction, whole).encode())


def _save(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write_bytes(data))


def main(arguments: Sequence[str]) -> int:
    """`python -m causticmpi.stability PAGE… [options]`; 1 if a cell is wrong, 2 for bad input."""
    import shlex

    parser = Parser(prog="scripts/stability", description="Where methods fail: one page per question.")
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE", help="pages (YAML), see configs/stability")
    parser.add_argument("--out", type=Path, default=Path("out/stability"), help="output directory")
    parser.add_argument("--scale", type=positive, default=1.0, help="factor of all CPU times, runs and samples")
    parser.add_argument("--seeds", type=count, default=1, metavar="N", help="measure each sweep N times")
    parser.add_argument("-j", dest="processes", type=count, default=2, help="processes")
    command = shlex.join(["scripts/stability", *arguments])
    try:
        given = parser.parse_args(arguments)
        return 1 if make_report(given.pages, given.out, given.scale, given.processes, command, given.seeds) else 0
    except InputError as error:
        print(one_line(error, "stability"), file=sys.stderr)
        return 2
