"""The stability report: pages read and checked, cells measured by several processes, the longest first."""

import multiprocessing
import sys
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from causticmpi.compare import charts
from causticmpi.compare.page import Image
from causticmpi.compare.tables import Table
from causticmpi.config.command_line import Parser, count, one_line, positive
from causticmpi.config.convert import convert
from causticmpi.config.yaml_source import read_yaml
from causticmpi.errors import InputError
from causticmpi.output.progress import clock
from causticmpi.stability import report, runs, seeds, show, show_runs, sweep, verdicts
from causticmpi.stability.cell import Measured
from causticmpi.stability.records import Page
from causticmpi.stability.report import Finding, Making
from causticmpi.stability.row import Kind
from causticmpi.stability.sweep import CellKey, Point

RIVALS = "rivals"
"""Name of the task of a page's common rivals."""


@dataclass(frozen=True)
class Loaded:
    """A page, the name it has from its file, and the directory of that file."""

    name: str
    page: Page
    place: Path


def read_pages(files: Sequence[Path]) -> list[Loaded]:
    """Read and check every page. Raises InputError with its place."""
    pages: list[Loaded] = []
    for file in files:
        source = read_yaml(file)
        page = convert(source, (), source.data, Page)
        try:
            sweep.check_page(page, source.file.parent)
        except InputError as error:
            raise InputError(str(error), source.file) from None
        if any(file.stem == other.name for other in pages):
            raise InputError(f"found two pages named {file.stem}; allowed: names that differ", source.file)
        pages.append(Loaded(file.stem, page, source.file.parent))
    return pages


def make_report(
    files: Sequence[Path],
    out: Path,
    scale: float,
    processes: int,
    command: str,
    repeats: int = 1,
    docs: Path | None = None,
) -> int:
    """Measure all pages and write the report into `out`; the number of cells that are wrong.

    scale: of all CPU times, numbers of runs and samples; repeats: of each sweep, by other seeds; docs: a document that
    has a place for the verdicts.
    """
    charts.require_matplotlib()
    pages = read_pages(files)
    if docs is not None:
        report.check_place(docs, repeats)
    out.mkdir(parents=True, exist_ok=True)
    began, version = time.monotonic(), report.version()
    findings: dict[str, Finding] = {}
    for loaded, results, seconds in _measured(pages, out, scale, processes, repeats):
        if loaded.page.sweep is None:
            finding = _finding_of_runs(loaded, list(results.values()), seconds)
        else:
            rivals = results.pop(RIVALS, [])
            finding = _finding_of_sweep(loaded, list(results.values()), rivals, out / loaded.name, scale, seconds)
        findings[loaded.name] = finding
        so_far = [findings[p.name] for p in pages if p.name in findings]
        made = Making(version, command, scale, processes, repeats, time.monotonic() - began)
        print(f"{clock(made.seconds)} {loaded.name}: {finding.said}", flush=True)
        # After every page: a report that is stopped holds what has been measured.
        report.write(out, so_far, made)
    if docs is not None:
        report.write_into(docs, so_far, made)
    print(out / report.HTML)
    return sum(finding.wrong for finding in findings.values())


class _Task(NamedTuple):
    """name: in what a page's tasks give; cost: CPU seconds, about; key: tasks of one key are measured once."""

    name: str
    cost: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    key: Hashable = None


def _measured(
    pages: Sequence[Loaded], out: Path, scale: float, processes: int, repeats: int
) -> Iterator[tuple[Loaded, dict[str, Any], float]]:
    """Pages as they are done, their tasks' results by name, and their CPU seconds: of shared tasks, in the first."""
    by_page = {loaded.name: (loaded, _tasks(loaded, out / loaded.name, scale, repeats)) for loaded in pages}
    shared: dict[Hashable, list[tuple[str, _Task]]] = {}
    for name, (_, tasks) in by_page.items():
        for task in tasks:
            shared.setdefault(task.key or (name, task.name), []).append((name, task))
    # The longest first: no process stands idle at the end while another has a long one before it.
    queue = sorted(shared.values(), key=lambda equal: -equal[0][1].cost)
    with _workers(processes) as pool:
        futures = {pool.submit(_timed, equal[0][1].function, equal[0][1].arguments): equal for equal in queue}
        results: dict[str, dict[str, Any]] = {name: {} for name in by_page}
        seconds = dict.fromkeys(by_page, 0.0)
        for future in as_completed(list(futures)):
            equal = futures.pop(future)
            result, spent = future.result()
            seconds[equal[0][0]] += spent
            for name, task in equal:
                results[name][task.name] = result
                loaded, tasks = by_page[name]
                if len(results[name]) == len(tasks):
                    # In the tasks' order, whichever was done first.
                    yield loaded, {t.name: results[name][t.name] for t in tasks}, seconds[name]
                    results[name] = {}


def _workers(processes: int) -> ProcessPoolExecutor:
    """Spawned, not forked: each process has its own Embree device; compiled kernels come from the disk."""
    return ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))


def _timed(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, float]:
    """Its result, and the CPU seconds it took."""
    began = time.process_time()
    return function(*arguments), time.process_time() - began


def _tasks(loaded: Loaded, out: Path, scale: float, repeats: int) -> list[_Task]:
    """A page's tasks; of a sweep all of the first repeat, then all of the next."""
    page = loaded.page
    if page.sweep is None:
        file = sweep.scene_file(page, loaded.place, out, 0)
        run = runs.RUNS[page.kind]
        # Of unknown length, but mostly longer than any cell.
        return [_Task(c.label, float("inf"), run, (page, c, file, scale)) for c in page.contenders]
    tasks = [
        _Task(
            f"{repeat}/{i}",
            sweep.point_seconds(page, scale, repeat),
            sweep.measure_point,
            (page, loaded.place, _scenes_of(out, repeat), i, scale, repeat),
        )
        for repeat in range(repeats)
        for i in range(len(page.sweep.values))
    ]
    if sweep.rivals_are_common(page) and page.truth.rivals:
        cost = sweep.rivals_seconds(page, scale)
        arguments = (page, loaded.place, out, scale)
        tasks.append(_Task(RIVALS, cost, sweep.measure_rivals, arguments, sweep.rivals_key(page, loaded.place)))
    return tasks


def _scenes_of(out: Path, repeat: int) -> Path:
    """Where a repeat's scenes go: no two processes write the same file at once."""
    return out / f"{repeat}" if repeat else out


def _finding_of_runs(loaded: Loaded, results: Sequence[runs.Result], seconds: float) -> Finding:
    """What a page about whole runs found. seconds: of CPU time."""
    page, name = loaded.page, loaded.name
    chart = Image(name, charts.as_png(show_runs.chart(results)), page.title)
    return Finding(
        name, page, runs.verdict(results), "", [chart, show_runs.table(name, page, results)], seconds=seconds
    )


def _finding_of_sweep(
    loaded: Loaded, points: Sequence[Point], rivals: Sequence[Measured], out: Path, scale: float, seconds: float
) -> Finding:
    """What a sweep found; what is doubtful is measured once more. points: of all repeats, one after the other;
    rivals: those that all cells share; out: of the page; seconds: of CPU time so far."""
    page, name = loaded.page, loaded.name
    assert page.sweep is not None

    def again(key: CellKey) -> Measured:
        nonlocal seconds
        arguments = (page, loaded.place, _scenes_of(out, key.repeat), key, scale)
        # Not in this process, which holds the report: it could not tell what memory the method needs.
        with _workers(1) as pool:
            found, spent = pool.submit(_timed, sweep.measure_again, arguments).result()
        seconds += spent
        return found

    count = len(page.sweep.values)
    repeats = [points[first : first + count] for first in range(0, len(points), count)]
    by_seed = sweep.settled_rows(page, repeats, rivals, again)
    every = [row for rows in by_seed for row in rows]
    rows = seeds.pooled(page, by_seed)
    caption = f"{page.title}. Below: pictures of {show.shown_in_pictures(page)} by {page.sweep.name}."
    content: list[Table | Image] = [Image(name, charts.as_png(show.chart(page, rows)), caption)]
    found, cells = verdicts.verdict(page, rows), []
    if page.claim is not None:
        cells = seeds.cells(page, page.claim, by_seed)
        content.append(seeds.table(name, page, page.claim, cells, len(repeats)))
        if len(repeats) > 1:
            found = f"{seeds.said(page, page.claim, cells, len(repeats))} {found}"
    content.append(show.table(name, page, rows))
    return Finding(
        name, page, found, verdicts.unbiasedness(every), content, verdicts.failures(every),
        sum(row.kind is Kind.WRONG for row in every), cells, seconds,
    )  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    """`python -m causticmpi.stability PAGE… [options]`; 1 if a cell is wrong, 2 for bad input."""
    import shlex

    parser = Parser(prog="scripts/stability", description="Where methods fail: one page per question.")
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE", help="pages (YAML), see configs/stability")
    parser.add_argument("--out", type=Path, default=Path("out/stability"), help="output directory")
    parser.add_argument("--scale", type=positive, default=1.0, help="factor of all CPU times, runs and samples")
    parser.add_argument("--seeds", type=count, default=1, metavar="N", help="measure each sweep N times")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="document to put the verdicts into, at its marks")
    parser.add_argument("-j", dest="processes", type=count, default=2, help="processes")
    every = {str(file) for file in Path("configs/stability").glob("*.yaml")}
    # Those of all pages are the script's own words.
    typed = [word for word in arguments if word not in every] if every <= {*arguments} else arguments
    command = shlex.join(["scripts/stability", *typed])
    try:
        given = parser.parse_args(arguments)
        wrong = make_report(given.pages, given.out, given.scale, given.processes, command, given.seeds, given.docs)
        return 1 if wrong else 0
    except InputError as error:
        print(one_line(error, "stability"), file=sys.stderr)
        return 2
