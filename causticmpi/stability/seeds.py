"""The cells of a page over several seeds: efficiencies with their intervals, and how often a claim fails.

The claim: never below ENOUGH of the baseline, and never below KEPT of the best fixed setting. Each seed has its own
photons, its own pilot, its own paths; ratios are formed within a seed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from causticmpi.compare.statistics import interval
from causticmpi.compare.tables import NOTHING, Table, number
from causticmpi.stability.judge import Row
from causticmpi.stability.records import Claim, Page
from causticmpi.stability.verdicts import shown

ENOUGH = 0.95
"""Of the baseline's efficiency."""
KEPT = 0.9
"""Of the efficiency of the best fixed setting."""

Turn = Sequence[Row]
"""All rows of a page by one seed."""


@dataclass(frozen=True)
class Ratio:
    """Efficiency over another contender's, over seeds.

    over: its label; wanted: the least by the claim; mean: geometric; low, high: 95 % interval of it, nan for one seed;
    least: of one seed; below: seeds below the wanted, of `count`; of_means: the ratio of the errors' plain means;
    blind: whether a cell of either has too few hits for its error to be believed.
    """

    over: str
    wanted: float
    mean: float
    low: float
    high: float
    least: float
    below: int
    count: int
    of_means: float
    blind: bool

    @property
    def verdict(self) -> str:
        """Of the claim, by the interval; by the value alone for one seed."""
        if self.blind:
            return "blind"
        low, high = (self.low, self.high) if math.isfinite(self.low) else (self.mean, self.mean)
        return "holds" if low >= self.wanted else "FAILS" if high < self.wanted else "open"


def pooled(turns: Sequence[Turn]) -> list[Row]:
    """One row for each cell: the first seed's, with the mean error and the worst verdict of all."""
    return [_pooled([turn[i] for turn in turns]) for i in range(len(turns[0]))]


def _pooled(rows: Sequence[Row]) -> Row:
    def worst(verdict: str) -> int:
        return 2 if verdict == "WRONG" else 1 if verdict.startswith("blind") else 0

    first = max(rows, key=lambda row: worst(row.verdict)).verdict if any(worst(row.verdict) for row in rows) else None
    verdict = rows[0].verdict if first is None else first
    return replace(rows[0], relmse=float(np.mean([row.relmse for row in rows])), verdict=verdict)


def ratio(over: Sequence[Row], of: Sequence[Row], wanted: float) -> Ratio:
    """Efficiency of `of` over that of `over`, rows of one cell by seed."""
    a, b = (np.array([row.relmse for row in rows]) for rows in (over, of))
    with np.errstate(divide="ignore", invalid="ignore"):
        each = a / b
    logs = interval(np.log(each[np.isfinite(each) & (each > 0)]))
    return Ratio(
        over=over[0].label,
        wanted=wanted,
        mean=math.exp(logs.mean),
        low=math.exp(logs.mean - logs.half),
        high=math.exp(logs.mean + logs.half),
        least=float(each.min()),
        below=int((each < wanted).sum()),
        count=len(each),
        of_means=float(a.mean() / b.mean()),
        blind=any(not row.trusted for row in (*over, *of)),
    )


@dataclass(frozen=True)
class Cell:
    """The claim in one cell. fireflies: median of the claimant's error over its trimmed one."""

    value: str
    plain: Ratio
    best: Ratio
    fireflies: float


def cells(page: Page, claim: Claim, turns: Sequence[Turn]) -> list[Cell]:
    """All cells of the page. The best fixed setting is that of the least mean error over all seeds."""
    assert page.sweep is not None and page.baseline is not None
    made = []
    for value in page.sweep.values:
        by_label = {
            label: [row for turn in turns for row in turn if row.label == label and row.value == value]
            for label in (claim.of, page.baseline, *claim.fixed)
        }
        if any(not math.isfinite(row.relmse) for rows in by_label.values() for row in rows):
            continue  # refused, or never begun: named among the cells that fail
        best = min(claim.fixed, key=lambda label: float(np.mean([row.relmse for row in by_label[label]])))
        own = by_label[claim.of]
        made.append(
            Cell(
                shown(value),
                ratio(by_label[page.baseline], own, ENOUGH),
                ratio(by_label[best], own, KEPT),
                float(np.median([row.fireflies for row in own])),
            )
        )
    return made


def table(name: str, page: Page, claim: Claim, turns: Sequence[Turn]) -> Table:
    """The claim in every cell."""
    assert page.sweep is not None
    rows = [
        (
            cell.value, _with_bounds(cell.plain), _below(cell.plain), number(cell.plain.of_means), cell.plain.verdict,
            cell.best.over, _with_bounds(cell.best), _below(cell.best), number(cell.best.of_means), cell.best.verdict,
            number(cell.fireflies),
        )
        for cell in cells(page, claim, turns)
    ]  # fmt: skip
    columns = (
        page.sweep.name, f"efficiency / {page.baseline}", f"below {ENOUGH}", "of mean errors", "claim",
        "best fixed", "efficiency / best fixed", f"below {KEPT}", "of mean errors ", "claim ", "error / trimmed",
    )  # fmt: skip
    return Table(
        f"{name}-seeds",
        f"{page.title}: {claim.of} over {len(turns)} seeds",
        columns,
        tuple(rows),
        f"Efficiency: the other's relMSE at {page.equal_time:g} CPU seconds over that of {claim.of}, within each seed; "
        "geometric mean with its 95 % interval over seeds, the least in brackets. Below: in how many seeds. Of mean "
        "errors: ratio of the means over seeds. The claim holds where all of the interval is above, FAILS where all of "
        "it is below, else it is open; blind: one of the two met too little light in some seed for its error to be "
        "believed (that of who is blind is mostly too small). Best fixed: of least mean error. Trimmed: without the "
        "worst 0.1 % of the pixels; median over seeds.",
    )


def _with_bounds(found: Ratio) -> str:
    if not math.isfinite(found.mean):
        return NOTHING
    spread = f" ({number(found.low)} to {number(found.high)})" if math.isfinite(found.low) else ""
    return f"{number(found.mean)}{spread} [{number(found.least)}]"


def _below(found: Ratio) -> str:
    return f"{found.below} of {found.count}"


def said(page: Page, claim: Claim, turns: Sequence[Turn]) -> str:
    """One sentence: where the claim holds, is open or fails."""
    found = cells(page, claim, turns)
    parts = []
    for name, wanted, ratios in (
        (str(page.baseline), ENOUGH, [(cell.value, cell.plain) for cell in found]),
        ("the best fixed setting", KEPT, [(cell.value, cell.best) for cell in found]),
    ):
        held = sum(r.verdict == "holds" for _, r in ratios)
        text = f"{claim.of} is at least {wanted} as efficient as {name} in {held} of {len(ratios)} cells"
        for verdict in ("open", "FAILS", "blind"):
            named = [
                f"{value} (x {number(r.mean)}, {r.below} of {r.count} seeds below)"
                for value, r in ratios
                if r.verdict == verdict
            ]
            text += f", {verdict} at {', '.join(named)}" if named else ""
        parts.append(text)
    return f"Over {len(turns)} seeds {'; '.join(parts)}."
