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
    """The cells of some rows, each once, a method's together: `pt at 0.1, 0.02; cf at 0.02 (3 seeds)`."""
    by_label: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        by_label.setdefault(row.label, {}).setdefault(shown(row.value), []).append(row)
    return ", ".join(
        f"{label} at {' '.join(value + _times(own) for value, own in by_value.items())}"
        for label, by_value in by_label.items()
    )


def unbiasedness(rows: Sequence[Row]) -> str:
    """How the tests of means went."""
    claimed = [row for row in rows if not row.biased]
    tested = [row for row in claimed if row.tested]
    if not tested:
        return ""
    right = [row for row in tested if not row.off]
    largest = max((abs(row.whole) for row in right if math.isfinite(row.whole)), default=math.nan)
    resolution = float(np.median([row.resolution for row in tested]))
    said = f"Unbiased within noise in {len(right)} of {len(tested)} tested cells"
    if right:
        said += f" (largest |z| of a mean {largest:.1f}, median resolution {100 * resolution:.2g} %)"
    named = {
        "WRONG": [row for row in tested if row.kind is Kind.WRONG],
        "leaks": [row for row in tested if row.kind is Kind.LEAKS],
        "wrong, as is warned": [row for row in tested if row.kind is Kind.WARNED],
        "too few hits to judge": [row for row in claimed if row.kind is Kind.BLIND],
        "most of the caustics missed": [row for row in claimed if row.kind is Kind.MISSES],
        "wrong at first, so measured again": [row for row in claimed if row.again],
    }
    said += "".join(f"; {words}: {_named(some)}" for words, some in named.items() if some)
    untested = sum(not row.tested and row.kind is not Kind.BLIND for row in claimed)
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
    """Along the sweep: how much more efficient than the baseline each contender is, where most and where least."""
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
        text = f"{contender.label} x {number(best[1])} at {shown(best[0].value)}"
        said.append(text if best is worst else text + f", x {number(worst[1])} at {shown(worst[0].value)}")
    name = page.sweep.name if page.sweep else "value"
    if not said:
        return f"No efficiency over that of {page.baseline}, which has too few hits."
    return f"Efficiency over that of {page.baseline}, best and worst {name}: {_sentence(said)}"


def _setting(page: Page, rows: Sequence[Row]) -> str:
    """The best value of a setting for each contender, and what the value one gets without asking costs."""
    said = []
    start = page.sweep.start if page.sweep else None
    for contender in page.contenders:
        own = _by_label(rows, contender.label)
        if not own:
            continue
        best, worst = min(own, key=lambda row: row.relmse), max(own, key=lambda row: row.relmse)
        text = f"{contender.label}: least error at {shown(best.value)}"
        default = next((row for row in own if start is not None and row.value == start), None)
        if default is not None and default is not best:
            text += f", the default {shown(default.value)} has x {number(default.relmse / best.relmse)} of it"
        elif default is not None:
            text += ", the default"
        said.append(text + f", the worst is {shown(worst.value)} with x {number(worst.relmse / best.relmse)}")
    return _sentence(said)


def _exact(page: Page, rows: Sequence[Row]) -> str:
    """How near the known answer is met, and where it is not; contenders that fare alike together."""
    said: dict[str, list[str]] = {}
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label]
        good = [row for row in own if row.kind is Kind.FINE]
        bad = [row for row in own if row.kind is not Kind.FINE]
        text = f"exact at {len(good)} of {len(own)} values"
        text += f", fail at {' '.join(shown(row.value) for row in bad)}" if bad else ""
        worst = max((abs(row.difference) for row in good), default=math.nan)
        off = f" (off by at most {100 * worst:.2g} %)" if good and page.truth.exact else ""
        said.setdefault(text, []).append(contender.label + off)
    return _sentence([f"{', '.join(names)}: {text}" for text, names in said.items()])


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
            f"{_at(page.sweep, least)} and {number(most.bias, 2)} at {shown(most.value)}, where its mean is off by "
            f"{100 * most.difference:+.2g} %"
        )
    return _sentence(said) or "No biased method is among the contenders."


def _bounded(page: Page, rows: Sequence[Row]) -> str:
    """What a sample costs at the first and the last value, the slowest pass, the memory."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label and row.passes]
        if own:
            slowest = max(row.slowest for row in own)
            said.append(
                f"{contender.label} {number(own[0].rays)} to {number(own[-1].rays)}, slowest pass x "
                f"{number(slowest, 2)} of the mean one"
            )
    measured = [row for row in rows if row.passes]
    if not measured:
        return ""
    memory = max(row.memory_mb for row in measured)
    ends = f"{_at(page.sweep, measured[0])} to {shown(measured[-1].value)}"
    return f"Rays per sample, {ends}: {_sentence([*said, f'no process has more than {memory:.0f} MB'])}"


def _lies(page: Page, rows: Sequence[Row]) -> str:
    """Refused, or unbiased at which price."""
    said = []
    for contender in page.contenders:
        own = [row for row in rows if row.label == contender.label]
        honest = next((row for row in own if page.sweep and row.value == page.sweep.start), None)
        refusals = [shown(row.value) for row in own if row.kind is Kind.REFUSED]
        lied = [row for row in own if row is not honest and math.isfinite(row.relmse)]
        text = f"{contender.label}: refuses {' and '.join(refusals) or 'nothing'}"
        if honest is not None and lied and honest.relmse > 0:
            worst = max(lied, key=lambda row: row.relmse)
            text += (
                f", takes {len(lied)} others, at worst for x {number(worst.relmse / honest.relmse)} the honest error"
            )
            text += f" ({shown(worst.value)})"
        said.append(text)
    return _sentence(said)


def _sentence(parts: Sequence[str]) -> str:
    if not parts:
        return ""
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "." if not text[0].islower() else text + "."
