"""The cells of a page over several seeds: efficiencies with their intervals, and how often a claim fails.

The claim: never below ENOUGH of the baseline, and never below KEPT of the best fixed setting. Each seed has its own
photons, its own pilot, its own paths; ratios are formed within a seed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np

from causticmpi.compare.statistics import interval
from causticmpi.compare.tables import Table, number
from causticmpi.stability.judge import with_losses
from causticmpi.stability.records import Claim, Page
from causticmpi.stability.row import FINE, Kind, Row
from causticmpi.stability.verdicts import shown

ENOUGH = 0.95
"""Of the baseline's efficiency."""
KEPT = 0.9
"""Of the efficiency of the best fixed setting."""


@dataclass(frozen=True)
class Ratio:
    """Efficiency over another contender's, over seeds.

    over: its label; wanted: the least by the claim; mean: geometric; low, high: 95 % interval of it, nan for one seed;
    least: of one seed; below: seeds below the wanted, of `count`; of_means: the ratio of the errors' plain means;
    trimmed: as mean, of errors without the worst pixels; blind: whether a cell of either has too few hits for its error
    to be believed.
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
    trimmed: float
    blind: bool

    @property
    def verdict(self) -> Literal["holds", "open", "FAILS", "blind"]:
        """Of the claim, by the interval; by the value alone for one seed."""
        if self.blind:
            return "blind"
        low, high = (self.low, self.high) if math.isfinite(self.low) else (self.mean, self.mean)
        return "holds" if low >= self.wanted else "FAILS" if high < self.wanted else "open"


def pooled(page: Page, by_seed: Sequence[Sequence[Row]]) -> list[Row]:
    """One row for each cell: that of the seed with the worst verdict, the first of equals, but for the error, which is
    the mean over seeds. Whether it loses to the baseline goes by that mean.
    """
    rows = [_pooled(cell) for cell in zip(*by_seed, strict=True)]
    return [row for _, cell in groupby(rows, key=lambda row: row.value) for row in with_losses([*cell], page.baseline)]


def _pooled(rows: Sequence[Row]) -> Row:
    unjudged = [replace(row, verdict=FINE) if row.kind is Kind.LOSES else row for row in rows]
    worst = max(unjudged, key=lambda row: row.kind)
    return replace(worst, relmse=float(np.mean([row.relmse for row in rows])))


def ratio(over: Sequence[Row], of: Sequence[Row], wanted: float) -> Ratio:
    """Efficiency of `of` over that of `over`, rows of one cell by seed, their errors finite and not 0."""
    theirs, own = (np.array([row.relmse for row in rows]) for rows in (over, of))
    each = theirs / own
    trimmed = each * [mine.fireflies / other.fireflies for mine, other in zip(of, over, strict=True)]
    logs = interval(np.log(each))
    return Ratio(
        over=over[0].label,
        wanted=wanted,
        mean=float(np.exp(logs.mean)),
        low=float(np.exp(logs.mean - logs.half)),
        high=float(np.exp(logs.mean + logs.half)),
        least=float(each.min()),
        below=int((each < wanted).sum()),
        count=len(each),
        of_means=float(theirs.mean() / own.mean()),
        trimmed=float(np.exp(np.log(trimmed).mean())),
        blind=any(not row.trusted for row in (*over, *of)),
    )


@dataclass(frozen=True)
class Cell:
    """The claim in one cell. fireflies: median of the claimant's error over its trimmed one."""

    value: str
    base: Ratio
    best: Ratio
    fireflies: float


def cells(page: Page, claim: Claim, by_seed: Sequence[Sequence[Row]]) -> list[Cell]:
    """All cells of the page. The best fixed setting is that of the least mean error over all seeds, blind ones left
    out."""
    assert page.sweep is not None and page.baseline is not None
    made = []
    for value in page.sweep.values:
        by_label = {
            label: [row for rows in by_seed for row in rows if row.label == label and row.value == value]
            for label in (claim.of, page.baseline, *claim.fixed)
        }
        if any(not 0 < row.relmse < math.inf for rows in by_label.values() for row in rows):
            continue  # refused, or never begun: named among the cells that fail
        known = [label for label in claim.fixed if all(row.trusted for row in by_label[label])] or claim.fixed
        best = min(known, key=lambda label: float(np.mean([row.relmse for row in by_label[label]])))
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


def table(name: str, page: Page, claim: Claim, found: Sequence[Cell], seeds: int) -> Table:
    """The claim in every cell. seeds: how many."""
    assert page.sweep is not None
    rows = [
        (cell.value, *_figures(cell.base), cell.best.over, *_figures(cell.best), number(cell.fireflies))
        for cell in found
    ]
    columns = (
        page.sweep.name, f"efficiency / {page.baseline}", f"below {ENOUGH}", "of mean errors", "trimmed", "claim",
        "best fixed", "efficiency / best fixed", f"below {KEPT}", "of mean errors ", "trimmed ", "claim ",
        "error / trimmed",
    )  # fmt: skip
    return Table(
        f"{name}-seeds",
        f"{page.title}: {claim.of} over {seeds} seeds",
        columns,
        tuple(rows),
        f"Efficiency: the other's relMSE at {page.equal_time:g} CPU seconds over that of {claim.of}, within each seed; "
        "geometric mean with its 95 % interval over seeds, the least in brackets. Below: in how many seeds. Of mean "
        "errors: ratio of the means over seeds. The claim holds where all of the interval is above, FAILS where all of "
        "it is below, else it is open; blind: one of the two met too little light in some seed for its error to be "
        "believed (that of who is blind is mostly too small). Best fixed: of least mean error. Trimmed: without the "
        "worst 0.1 % of the pixels, geometric mean; error / trimmed: of the claimant, median over seeds.",
    )


def _figures(found: Ratio) -> tuple[str, str, str, str, str]:
    mean = f"{_spread(found)} [{number(found.least)}]"
    below = f"{found.below} of {found.count}"
    return mean, below, number(found.of_means), number(found.trimmed), found.verdict


def said(page: Page, claim: Claim, found: Sequence[Cell], seeds: int) -> str:
    """One sentence: where the claim holds, is open or fails. seeds: how many."""
    parts = []
    for name, wanted, ratios in (
        (str(page.baseline), ENOUGH, [(cell.value, cell.base) for cell in found]),
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
    return f"Over {seeds} seeds {'; '.join(parts)}."


def markdown(pages: Sequence[tuple[str, Page, Sequence[Cell]]]) -> str:
    """The claims of several pages in one table, for a document. pages: name, page and its cells."""
    columns = (
        "page", "cell", "over the baseline", f"below {ENOUGH}", "claim", "over the best fixed setting", "trimmed",
        f"below {KEPT}", "claim", "error / trimmed",
    )  # fmt: skip
    rows = [columns, ("---",) * len(columns)]
    for name, page, found in pages:
        for cell in found:
            assert page.sweep is not None
            plain, best = cell.base, cell.best
            rows.append((
                f"`{name}`", f"{page.sweep.name} {cell.value}", f"{page.baseline}: {_spread(plain)}",
                f"{plain.below} of {plain.count}", plain.verdict, f"{best.over}: {_spread(best)}",
                number(best.trimmed), f"{best.below} of {best.count}", best.verdict, number(cell.fireflies),
            ))  # fmt: skip
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _spread(ratio: Ratio) -> str:
    """Geometric mean and its interval, where there is one."""
    spread = f" ({ratio.low:.2g} to {ratio.high:.2g})" if math.isfinite(ratio.low) else ""
    return number(ratio.mean) + spread
