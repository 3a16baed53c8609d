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
from causticmpi.stability.records import Page
from causticmpi.stability.report import Finding, Making
from causticmpi.stability.row import Kind

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
        made = convert(source, (), source.data, Page)
        try:
            sweep.check_page(made, source.file.parent)
        except InputError as error:
            raise InputError(str(error), source.file) from None
        if any(file.stem == other.name for other in pages):
            raise InputError(f"found two pages named {file.stem}; allowed: names that differ", source.file)
        pages.append(Loaded(file.stem, made, source.file.parent))
    return pages


def make_report(
    files: Sequence[Path],
    out: Path,
    scale: float,
    processes: int,
    command: str,
    turns: int = 1,
    docs: Path | None = None,
) -> int:
    """Measure all pages and write the report into `out`; the number of cells that are wrong.

    scale: of all CPU times, numbers of runs and samples; turns: seeds of each sweep; docs: a document that has a place
    for the verdicts.
    """
    charts.require_matplotlib()
    pages = read_pages(files)
    if docs is not None:
        report.check_place(docs, turns)
    out.mkdir(parents=True, exist_ok=True)
    began, version = time.monotonic(), report.version()
    findings: dict[str, Finding] = {}
    for loaded, results, seconds in _measured(pages, out, scale, processes, turns):
        finding = _finding(loaded, results, turns, seconds)
        findings[loaded.name] = finding
        so_far = [findings[p.name] for p in pages if p.name in findings]
        made = Making(version, command, scale, processes, turns, time.monotonic() - began)
        print(f"{clock(made.seconds)} {loaded.name}: {finding.said}", flush=True)
        # After every page: a report that is stopped holds what has been measured.
        report.write(out, so_far, made)
    if docs is not None:
        report.write_into(docs, so_far, made)
    print(out / report.HTML)
    return sum(finding.wrong for finding in findings.values())


class _Task(NamedTuple):
    """name: in what `_finding` takes; cost: CPU seconds, about; same: tasks of equal ones are measured once."""

    name: str
    cost: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    same: Hashable = None


def _measured(
    pages: Sequence[Loaded], out: Path, scale: float, processes: int, turns: int
) -> Iterator[tuple[Loaded, dict[str, Any], float]]:
    """Pages as they are done, their tasks' results by name, and their CPU seconds: of shared tasks, in the first."""
    by_page = {loaded.name: (loaded, _tasks(loaded, out / loaded.name, scale, turns)) for loaded in pages}
    users: dict[Hashable, list[tuple[str, _Task]]] = {}
    for name, (_, tasks) in by_page.items():
        for task in tasks:
            users.setdefault(task.same or (name, task.name), []).append((name, task))
    # The longest first: no process stands idle at the end while another has a long one before it.
    queue = sorted(users.values(), key=lambda own: -own[0][1].cost)
    # Spawned, not forked: each process has its own Embree device; compiled kernels come from the disk.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        futures = {pool.submit(_timed, own[0][1].function, own[0][1].arguments): own for own in queue}
        results: dict[str, dict[str, Any]] = {name: {} for name in by_page}
        seconds = dict.fromkeys(by_page, 0.0)
        for future in as_completed(list(futures)):
            own = futures.pop(future)
            result, spent = future.result()
            seconds[own[0][0]] += spent
            for name, task in own:
                results[name][task.name] = result
                loaded, tasks = by_page[name]
                if len(results[name]) == len(tasks):
                    # In the tasks' order, whichever was done first.
                    yield loaded, {t.name: results[name][t.name] for t in tasks}, seconds[name]
                    results[name] = {}


def _timed(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, float]:
    """Its result, and the CPU seconds it took."""
    began = time.process_time()
    return function(*arguments), time.process_time() - began


def _tasks(loaded: Loaded, out: Path, scale: float, turns: int) -> list[_Task]:
    """A page's tasks, a sweep's all by one seed, then by the next."""
    made = loaded.page
    if made.sweep is None:
        file = sweep.scene_file(made, loaded.place, out, 0)
        run = runs.RUNS[made.kind]
        # Of unknown length, but mostly longer than any cell.
        return [_Task(c.label, float("inf"), run, (made, c, file, scale)) for c in made.contenders]
    tasks = [
        _Task(
            f"{turn}/{i}",
            sweep.point_seconds(made, scale, turn),
            sweep.measure_point,
            (made, loaded.place, out / f"{turn}" if turn else out, i, scale, turn),
        )
        for turn in range(turns)
        for i in range(len(made.sweep.values))
    ]
    if sweep.rivals_are_common(made) and made.truth.rivals:
        cost = sweep.rivals_seconds(made, scale)
        arguments = (made, loaded.place, out, scale)
        tasks.append(_Task(RIVALS, cost, sweep.measure_rivals, arguments, sweep.rivals_of(made, loaded.place)))
    return tasks


def _finding(loaded: Loaded, results: dict[str, Any], turns: int, seconds: float) -> Finding:
    """What a page found. seconds: of CPU time."""
    made, name = loaded.page, loaded.name
    if made.sweep is None:
        of_runs = list(results.values())
        content: list[Table | Image] = [Image(name, charts.as_png(show_runs.chart(of_runs)), made.title)]
        content.append(show_runs.table(name, made, of_runs))
        return Finding(name, made, runs.verdict(of_runs), "", content, seconds=seconds)
    rivals = results.pop(RIVALS, [])
    by_seed = sweep.rows_by_seed(made, list(results.values()), rivals, turns)
    every = [row for rows in by_seed for row in rows]
    rows = seeds.pooled(made, by_seed)
    cells = [] if made.claim is None else seeds.cells(made, made.claim, by_seed)
    found = verdicts.verdict(made, rows)
    if made.claim is not None and turns > 1:
        found = f"{seeds.said(made, made.claim, cells, turns)} {found}"
    caption = f"{made.title}. Below: pictures of {show.shown_in_pictures(made)} by {made.sweep.name}."
    content = [Image(name, charts.as_png(show.chart(made, rows)), caption)]
    content += [seeds.table(name, made, made.claim, cells, turns)] if made.claim is not None else []
    content.append(show.table(name, made, rows))
    return Finding(
        name, made, found, verdicts.unbiasedness(every), content, verdicts.failures(every),
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
