"""What the stability laboratory writes: the HTML page, all tables, and the verdicts as a document holds them."""

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from causticmpi import __version__
from causticmpi.compare import tables
from causticmpi.compare.page import Image, Section, page, save, save_apart
from causticmpi.compare.tables import Table
from causticmpi.errors import InputError
from causticmpi.stability import seeds, sweep
from causticmpi.stability.records import Page

HTML, TABLES, VERDICTS = "report.html", "tables.md", "verdicts.md"
TITLE = "Where methods fail"


@dataclass(frozen=True)
class Finding:
    """What one page found. name: of its file; found: its verdict; means: how the tests of means went, empty for a page
    of runs; content: chart and tables; failing: cells; wrong: cells whose means are; cells: the claim over seeds;
    seconds: CPU time."""

    name: str
    page: Page
    found: str
    means: str
    content: Sequence[Table | Image]
    failing: Sequence[str] = ()
    wrong: int = 0
    cells: Sequence[seeds.Cell] = ()
    seconds: float = 0.0

    @property
    def said(self) -> str:
        """The whole verdict."""
        return f"{self.found} {self.means}".strip()


@dataclass(frozen=True)
class Making:
    """How a report is made. version: of the program, when it began; command: that makes it anew; scale: of CPU times;
    repeats: of each sweep, by other seeds; seconds: of wall clock."""

    version: str
    command: str
    scale: float
    processes: int
    repeats: int
    seconds: float


def write(out: Path, findings: Sequence[Finding], made: Making) -> None:
    """All files of the report so far into `out`."""
    summary = Table("verdicts", "All verdicts", ("page", "verdict"), tuple((f.page.title, f.said) for f in findings))
    costs = Table(
        "costs", "What each page costs", ("page", "CPU seconds"), tuple((f.name, f"{f.seconds:.0f}") for f in findings)
    )
    sections = [_section(finding) for finding in findings]
    save_apart(out, sections)
    markdown = [f"# {TITLE}", ""]
    for section in sections:
        markdown += [f"## {section.title}", "", *(text + "\n" for text in section.paragraphs)]
        markdown += [tables.to_markdown(item) for item in section.content if isinstance(item, Table)]
    save(out / TABLES, "\n".join(markdown).encode())
    save(out / VERDICTS, as_markdown(findings, made).encode())
    whole = [Section("Verdicts", [], [summary, costs]), *sections]
    introduction = [
        _how(made),
        "Each contender has the same CPU time in each cell, in independent batches; seeds are 1, 2, … for contenders, "
        f"{sweep.REPEAT_SEEDS} more for each further repeat of a page, and {sweep.RIVAL_SEED}, … for the rivals they "
        "are tested against. A contender whose mean fails is measured once more, by other passes in "
        f"{sweep.AGAIN:g} times the time, and judged by those alone. Verdicts are formed from the figures below them.",
    ]
    save(out / HTML, page(TITLE, introduction, whole).encode())


def _section(finding: Finding) -> Section:
    paragraphs = [finding.page.question, finding.said]
    paragraphs += ["Cells that fail: " + "; ".join(finding.failing) + "."] if finding.failing else []
    alarm = f"{finding.wrong} cells are wrong." if finding.wrong else ""
    return Section(finding.page.title, paragraphs, finding.content, alarm)


def _how(made: Making) -> str:
    seconds = f"{made.seconds / 60:.0f} minutes" if made.seconds >= 120 else f"{made.seconds:.0f} s"
    return (
        f"causticmpi {made.version}, {made.processes} processes on {_machine()}, {seconds}, {_seeds(made.repeats)}, "
        f"CPU times times {made.scale:g}. Made anew by: {made.command}"
    )


def _seeds(repeats: int) -> str:
    last = f" to {1 + (repeats - 1) * sweep.REPEAT_SEEDS}" if repeats > 1 else ""
    return f"seeds from {sweep.SEED}{last}, rivals' from {sweep.RIVAL_SEED}"


def version() -> str:
    """Of the program, and the revision of its clone, if it is in one."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return __version__
    return f"{__version__} ({found.stdout.strip()})" if found.returncode == 0 else __version__


def _machine() -> str:
    """The processor's name and how many cores it has."""
    import os
    import platform

    names = []
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{os.cpu_count()} cores of {names[0] if names else platform.machine()}"


def as_markdown(findings: Sequence[Finding], made: Making) -> str:
    """What a document holds: of several seeds the claims, else all verdicts."""
    lines = [_how(made).replace(made.command, f"`{made.command}`") + ".", ""]
    if made.repeats > 1:
        lines += [seeds.markdown([(f.name, f.page, f.cells) for f in findings]), ""]
    rows = [("page", "question", "verdict", "means", "CPU s"), ("---",) * 5]
    rows += [(f"`{f.name}`", f.page.question, f.found, f.means, f"{f.seconds:.0f}") for f in findings]
    # A bar would end the cell.
    return "\n".join([*lines, *("| " + " | ".join(t.replace("|", "\\|") for t in row) + " |" for row in rows), ""])


def _marks(repeats: int) -> tuple[str, str]:
    """Lines of a document around what `write_into` puts there. repeats: of each sweep."""
    name = "verdicts" if repeats == 1 else "seeds"
    return f"<!-- {name}: by scripts/stability --docs -->\n", f"<!-- end of {name} -->\n"


def check_place(document: Path, repeats: int) -> None:
    """Raises InputError for a document without the marks that `write_into` needs."""
    for mark in _marks(repeats):
        if not document.is_file() or mark not in document.read_text():
            raise InputError(f"--docs: found no line {mark.strip()} in {document}; needed: the lines {_marks(repeats)}")


def write_into(document: Path, findings: Sequence[Finding], made: Making) -> None:
    """Put `as_markdown` between the marks of a document, in place of what is there."""
    begin, end = _marks(made.repeats)
    before, _, rest = document.read_text().partition(begin)
    _, _, after = rest.partition(end)
    save(document, f"{before}{begin}\n{as_markdown(findings, made)}\n{end}{after}".encode())
