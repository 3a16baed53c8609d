"""From what contenders did in a cell to judgements: error at equal time, agreement with the truth, what has failed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from causticmpi.compare.metrics import TRIMMED_SHARE
from causticmpi.compare.statistics import FEW_HITS, agreement
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.render.foresight import TOO_FAR
from causticmpi.stability.cell import Measured
from causticmpi.stability.records import Page, Value
from causticmpi.stability.row import FINE, Kind, Row, Verdict

ALPHA = 1e-4
"""Significance of a cell's test, all its means together: a report of some 500 cells has a false alarm in 1 of 20."""
SIGHT = 100
"""Hits on a light behind specular surfaces that a path tracer needs before its error can be believed."""
SHARE_OF_LIGHT = 0.3
"""Of the light's radiance in a pixel that one such hit brings: albedo and Fresnel losses."""
SMOOTHING = 3
"""Pixels: side of the square over which signed errors are averaged."""
LOSS = 1.05
"""A contender whose error is this many times the baseline's has lost to it."""


def expected_hits(measured: Measured, caustic: float) -> float:
    """Expected hits on lights behind specular surfaces in all paths of a tracer that finds them by chance."""
    return measured.samples * caustic / (SHARE_OF_LIGHT * measured.brightest)


def misses(measured: Measured, caustic: float) -> bool:
    """Whether it found less than half of the caustics to be expected: their light came too rarely to be met at all."""
    return measured.caustic < caustic / 2


def sees(measured: Measured, caustic: float) -> bool:
    """Whether its mean can be trusted to know the caustics whose mean radiance is `caustic`."""
    return not measured.by_chance or caustic <= 0 or expected_hits(measured, caustic) >= SIGHT


def counted_hits(measured: Measured, caustic: float) -> float:
    """Rare hits behind its mean: those its passes show, or those to be expected where it meets the light by chance.

    So does a forecast that misses most of the caustics: it has none where they come from.
    """
    by_chance = measured.by_chance or misses(measured, caustic)
    return min(measured.hits, expected_hits(measured, caustic)) if by_chance and caustic > 0 else measured.hits


def _blind(found: float) -> Verdict:
    return Verdict(Kind.BLIND, f"blind: too few hits to judge ({found:.2g})")


def seen_caustic(measured: Sequence[Measured]) -> float:
    """Mean luminance of L_c as the unbiased methods that look for caustics see it, else as the others do."""
    unbiased = [m for m in measured if not m.biased]
    return max((m.caustic for m in unbiased if not m.by_chance), default=0.0) or max(
        (m.caustic for m in unbiased), default=0.0
    )


def judge(
    page: Page, value: Value, x: float, found: Sequence[Measured], rivals: Sequence[Measured], caustic: float
) -> list[Row]:
    """The rows of one cell. caustic: mean luminance of L_c to be expected."""
    unbiased = [m for m in (*found, *rivals) if not m.biased]
    sighted = [m for m in unbiased if sees(m, caustic) and not (page.constant_caustics and misses(m, caustic))]
    rivals = sorted((r for r in rivals if r in sighted), key=lambda r: counted_hits(r, caustic) < FEW_HITS)
    picture = _mean_picture(rivals or sighted or unbiased)
    rows = []
    for m in found:
        rival = next((r for r in rivals if r.label != m.label), None)
        rows.append(_row(page, value, x, m, picture, rival, caustic))
    return with_losses(rows, page.baseline)


def _mean_picture(measured: Sequence[Measured]) -> np.ndarray:
    """(H, W, 3): what errors are relative to. Of rivals where there are some, who have no share in the errors judged.

    Their own errors are the weights: the picture of the least error may owe that to a glint that it has not met.
    """
    weights = [1 / max(float((m.variance / (m.rgb**2 + RELMSE_FLOOR)).mean()), 1e-30) for m in measured]
    return np.average([m.rgb for m in measured], axis=0, weights=weights)


def _row(
    page: Page, value: Value, x: float, m: Measured, picture: np.ndarray, rival: Measured | None, caustic: float
) -> Row:
    """picture: what errors are relative to; rival: whom it is held against, unless the page knows the radiance."""
    weight = 1 / (picture**2 + RELMSE_FLOOR)
    errors = (m.variance * weight).mean(axis=-1)
    left = page.equal_time - m.preprocess
    relmse = float(errors.mean()) * m.seconds / left if left > m.pass_seconds else math.inf
    bias, signed = math.nan, None
    if m.biased and rival is not None:
        signed = uniform_filter(((m.rgb - rival.rgb) * np.sqrt(weight)).mean(axis=-1), SMOOTHING, mode="nearest")
        bias = float((((m.rgb - rival.rgb) ** 2 - m.variance - rival.variance) * weight).mean())
    test, against = _Test(), ""
    if page.truth.exact is not None:
        rival, against = None, f"{page.truth.exact:g}"
        test = _test(m.blocks, np.full((2, m.blocks.shape[1]), page.truth.exact))
    elif rival is not None:
        test, against = _test(m.blocks, rival.blocks), rival.label
    return Row(
        value=value, x=x, label=m.label, biased=m.biased, seed=m.seed,
        relmse=relmse + max(0.0, bias if m.biased else 0.0), bias=bias,
        share=float(errors.max() / max(errors.sum(), 1e-300)), fireflies=_fireflies(errors),
        p=test.p, whole=test.whole, difference=test.difference, resolution=test.resolution,
        passes=m.passes, pass_seconds=m.pass_seconds, preprocess=m.preprocess,
        rays=m.rays / m.samples, slowest=m.slowest, memory_mb=m.memory_mb, caustic=m.caustic,
        verdict=_verdict(page, m, test, rival, caustic), against=against, rgb=m.rgb.astype(np.float32), signed=signed,
        warnings=m.warnings, again=m.again,
    )  # fmt: skip


def _fireflies(errors: np.ndarray) -> float:
    """The mean error of (H, W) over that without the worst pixels."""
    kept = np.sort(errors, axis=None)[: -max(1, round(TRIMMED_SHARE * errors.size))]
    return float(errors.mean() / max(kept.mean(), 1e-300)) if len(kept) else math.nan


@dataclass(frozen=True)
class _Test:
    """Of a mean against the truth. p_above: of what is too bright alone; the rest as in `Row`; nan: not tested."""

    p: float = math.nan
    p_above: float = math.nan
    difference: float = math.nan
    whole: float = math.nan
    resolution: float = math.nan


def _verdict(page: Page, m: Measured, test: _Test, rival: Measured | None, caustic: float) -> Verdict:
    """What failed. rival: whom it was held against, None: a known radiance, or nobody."""
    if m.nonfinite:
        return Verdict(Kind.NONFINITE, f"{m.nonfinite} non-finite samples")
    if page.truth.exact == 0 and test.difference > 0:
        return Verdict(Kind.LEAKS, f"leaks {test.difference:.1g}")
    if test.p < ALPHA and m.biased:
        return Verdict(Kind.BIASED, "biased, as it says")
    if test.p < ALPHA <= test.p_above and (few := counted_hits(m, caustic)) < FEW_HITS:
        return _blind(few)
    if test.p_above < ALPHA and rival is not None and (few := counted_hits(rival, caustic)) < FEW_HITS:
        return Verdict(Kind.UNTESTED, f"not tested: {rival.label} has too few hits ({few:.2g})")
    if test.p < ALPHA:
        warned = any(TOO_FAR in warning for warning in m.warnings)
        return Verdict(Kind.WARNED, "wrong, as is warned") if warned else Verdict(Kind.WRONG, "WRONG")
    if page.constant_caustics and misses(m, caustic):
        return Verdict(Kind.MISSES, f"misses {100 * (1 - m.caustic / caustic):.0f} % of the caustics")
    if not sees(m, caustic):
        return _blind(expected_hits(m, caustic))
    if not math.isfinite(test.p) and page.truth.rivals:
        return Verdict(Kind.UNTESTED, "not tested: no rival sees enough")
    if m.preprocess >= page.equal_time:
        return Verdict(Kind.LATE, f"preprocess exceeds {page.equal_time:g} s")
    return FINE


def _test(found: np.ndarray, truth: np.ndarray) -> _Test:
    """Of the means of squares, (batches, k) each, and of the whole picture's."""
    tested = agreement(*(np.column_stack([blocks, blocks.mean(axis=1)]) for blocks in (found, truth)))
    a, b = found.mean(axis=1), truth.mean(axis=1)
    deviation = math.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))
    difference = float(a.mean() - b.mean())
    scale = abs(float(b.mean())) or 1.0  # where nothing should be seen: against radiance 1
    if deviation > 0:
        whole = difference / deviation
    else:
        whole = 0.0 if difference == 0 else math.inf
    return _Test(tested.p, tested.p_above, difference / scale, whole, deviation / scale)


def with_losses(rows: Sequence[Row], baseline: str | None) -> list[Row]:
    """The rows of one cell, those that are fine but for a larger error than the baseline's named so."""
    base = next((row for row in rows if row.label == baseline and row.kind is Kind.FINE), None)
    return [*rows] if base is None else [_with_loss(row, base) for row in rows]


def _with_loss(row: Row, base: Row) -> Row:
    if row is base or row.kind is not Kind.FINE or not row.relmse > LOSS * base.relmse:
        return row
    words = f"loses to {base.label}: error x {row.relmse / base.relmse:.2g}"
    return replace(row, verdict=Verdict(Kind.LOSES, words))
