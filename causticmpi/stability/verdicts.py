"""One sentence with its figures for each page, formed from the rows alone."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from causticmpi.compare.tables import number
from causticmpi.stability.records import Page, Sweep, Value
from causticmpi.stability.row import Kind, Row


def verdict(page: Page, rows: Sequence[Row]) -> str:
    """What the page found, but for `unbiasedness`."""
    readers: dict[str, Callable[[Page, Sequence[Row]], str]] = {
        "rivals": _rivals, "setting": _setting, "exact": _exact, "floor": _floor, "bounded": _bounded, "lies": _lies,
    }  # fmt: skip
    return readers[page.reads](page, rows)


def failures(rows: Sequence[Row]) -> list[str]:
    """Every cell where a method fails, named once: by its worst verdict, and by how many seeds if several fail."""
    by_cell: dict[str, list[Row]] = {}
    for row in rows:
        if row.kind is not Kind.FINE:
            by_cell.setdefault(_cell(row), []).append(row)
    return [f"{cell}: {max(own, key=lambda row: row.kind).verdict.words}{_times(own)}" for cell, own in by_cell.items()]


def _cell(row: Row) -> str:
    return f"{row.label} at {shown(row.value)}"


def _times(rows: Sequence[Row]) -> str:
    return f" ({len(rows)} seeds)" if len(rows) > 1 else ""


def _named(rows: Sequence[Row]) -> str:
    """The cells of some rows, each once."""
    by_cell: dict[str, list[Row]] = {}
    for row in rows:
        by_cell.setdefault(_cell(row), []).append(row)
    return ", ".join(cell + _times(own) for cell, own in by_cell.items())


def unbiasedness(rows: Sequence[Row]) -> str:
    """How the z-tests went."""
    claimed = [row for row in rows if not row.biased]
    tested = [row for row in claimed if row.tested]
    if not tested:
        return ""
    finite = [row for row in tested if row.kind is not Kind.WARNED and math.isfinite(row.whole)]
    largest = max((abs(row.whole) for row in finite), default=math.inf)
    resolution = float(np.median([row.resolution for row in tested]))
    said = f"Unbiased within noise in {sum(not row.off for row in tested)} of {len(tested)} tested cells"
    said += f" (largest |z| of a picture's mean {largest:.1f}, median resolution {100 * resolution:.2g} %)"
    blind = [row for row in claimed if row.kind is Kind.BLIND]
    for words, some in (
        ("WRONG in", [row for row in tested if row.kind is Kind.WRONG]),
        ("wrong, as is warned, in", [row for row in tested if row.kind is Kind.WARNED]),
        ("too few hits to judge", blind),
    ):
        said += f"; {words} {_named(some)}" if some else ""
    untested = len(claimed) - len(tested) - len(blind)
    return said + (f"; {untested} not tested." if untested else ".")


def shown(value: Value) -> str:
    """A value for people: a scene file by its name."""
    if isinstance(value, list):
        return "x".join(map(str, value))
    if isinstance(value, str) and value.endswith(".yaml"):
        return Path(value).stem
    return f"{value:g}" if isinstance(value, float) else str(value)


def _at(sweep: Sweep | None, row: Row) -> str:
    """`name = value`."""
    return f"{sweep.name if sweep else 'value'} {shown(row.value)}"


def _by_label(rows: Sequence[Row], label: str) -> list[Row]:
    return [row for row in rows if row.label == label and row.trusted and math.isfinite(row.relmse) and row.relmse > 0]


def _rivals(page: Page, rows: Sequence[Row]) -> str:
    """Along the sweep: where each contender beats the baseline, and by how much."""
    said = []
    base = {shown(row.value): row for row in rows if row.label == page.baseline}
    for contender in page.contenders:
        if contender.label == page.baseline:
            continue
        pairs = [
            (row, base[shown(row.value)].relmse / row.relmse)
            for row in _by_label(rows, contender.label)
            if shown(row.value) in base and base[shown(row.value)].trusted and row.trusted
        ]
        pairs = [(row, gain) for row, gain in pairs if math.isfinite(gain) and gain > 0]
        if not pairs:
            continue
        best, worst = max(pairs, key=lambda pair: pair[1]), min(pairs, key=lambda pair: pair[1])
        said.append(
            f"{contender.label} is x {number(best[1])} as efficient as {page.baseline} at {_at(page.sweep, best[0])} "
            f"and x {number(worst[1])} at {_at(page.sweep, worst[0])}"
        )
    for contender in page.contenders:
        lost = [shown(row.value) for row in rows if row.label == contender.label and not row.trusted]
        if lost:
            said.append(f"{contender.label} meets the light too rarely to be judged at {', '.join(lost)}")
    return _sentence(said)


def _setting(page: Page, rows: Sequence[Row]) -> str:
    """The best value of a setting for each contender, and what the value one gets without asking costs."""
    said = []
    start = page.sweep.start if page.sweep else None
    for contender in page.contenders:
        own = _by_label(rows, contender.label)
        if not own:
            continue
        best, worst = min(own, key=lambda row: row.relmse), max(own, key=lambda row: row.relmse)
        text = f"{contender.label}: least error at {_at(page.sweep, best)} (relMSE {number(best.relmse)})"
        default = next((row for row in own if start is not None and row.value == start), None)
        if default is not None and default is not best:
            text += f", the default {shown(default.value)} has x {number(default.relmse / best.relmse)} of it"
        elif default is not None:
            text += ", which is the default"
        said.append(text + f", the worst is {shown(worst.value)} with x {number(worst.relmse / best.relmse)}")
    return _sentence(said)


def _exact(page: Page, rows: Sequence[Row]) -> str:
    """Where the known answer is met, and the first value at which it is not."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label]
        good = [row for row in own if row.kind is Kind.FINE]
        bad = [row for row in own if row.kind is not Kind.FINE]
        worst = max((abs(row.difference) for row in good), default=math.nan)
        text = f"{contender.label} meets the exact answer at {len(good)} of {len(own)} values"
        text += f" (off by at most {100 * worst:.2g} %)" if good else ""
        text += f", fails at {', '.join(shown(row.value) for row in bad)}" if bad else ""
        said.append(text)
    return _sentence(said)


def _floor(page: Page, rows: Sequence[Row]) -> str:
    """Bias of the biased contenders: the error that no time removes."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label and row.biased and math.isfinite(row.bias)]
        if not own:
            continue
        least, most = min(own, key=lambda row: row.bias), max(own, key=lambda row: row.bias)
        said.append(
            f"{contender.label} (biased) cannot get below relMSE {number(max(0.0, least.bias), 2)} at "
            f"{_at(page.sweep, least)} and {number(most.bias, 2)} at {_at(page.sweep, most)}; its mean is off by "
            f"{100 * most.difference:+.2g} % there"
        )
    return _sentence(said) or "No biased method is among the contenders."


def _bounded(page: Page, rows: Sequence[Row]) -> str:
    """What a sample costs at the first and the last value, the slowest pass, the memory."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label and row.passes]
        if not own:
            continue
        slowest = max(own, key=lambda row: row.slowest)
        said.append(
            f"{contender.label} traces {number(own[0].rays)} rays per sample at {_at(page.sweep, own[0])} and "
            f"{number(own[-1].rays)} at {_at(page.sweep, own[-1])}, its slowest pass takes "
            f"{number(slowest.slowest, 2)} times the mean one"
        )
    memory = [row.memory_mb for row in rows if row.passes]
    said += [f"no process has more than {max(memory):.0f} MB"] if memory else []
    return _sentence(said)


def _lies(page: Page, rows: Sequence[Row]) -> str:
    """Refused, or unbiased at which price."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label]
        honest = next((row for row in own if page.sweep and row.value == page.sweep.start), None)
        refusals = [shown(row.value) for row in own if row.kind is Kind.REFUSED]
        lied = [row for row in own if row is not honest and math.isfinite(row.relmse)]
        text = f"{contender.label} refuses {', '.join(refusals)}" if refusals else f"{contender.label} refuses nothing"
        if honest is not None and lied and honest.relmse > 0:
            worst = max(lied, key=lambda row: row.relmse)
            text += (
                f" and takes {len(lied)} lies, at worst for x {number(worst.relmse / honest.relmse)} the error of an "
                f"honest forecast ({shown(worst.value)})"
            )
        said.append(text)
    return _sentence(said)


def _sentence(parts: Sequence[str]) -> str:
    if not parts:
        return ""
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "." if not text[0].islower() else text + "."
