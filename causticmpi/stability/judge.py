"""From what contenders did in a cell to judgements: error at equal time, agreement with the truth, what has failed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from causticmpi.compare.statistics import agreement
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.render.foresight import TOO_FAR
from causticmpi.stability.cell import Measured
from causticmpi.stability.records import Page, Value

ALPHA = 1e-4
"""Significance of a cell's test, all its means together: a report of some 500 cells has a false alarm in 1 of 20."""
SIGHT = 100
"""Hits on a light behind specular surfaces that a path tracer needs before its mean is worth a t-test."""
SHARE_OF_LIGHT = 0.3
"""Of the light's radiance in a pixel that one such hit brings: albedo and Fresnel losses."""
BY_CHANCE = ("pt", "pt-brute")
"""Methods that meet a light behind specular surfaces by chance alone."""
SMOOTHING = 3
"""Pixels: side of the square over which signed errors are averaged."""
LOSS = 1.05
"""A contender whose error is this many times the baseline's has lost to it."""


@dataclass(frozen=True)
class Row:
    """One contender in one cell. value: of the parameter; x: its place in the chart, nan for one without a number.

    relmse: at the page's equal time, the bias of biased methods included; share: of the squared error that the worst
    pixel holds; bias: squared, relative, nan for unbiased ones; p, z: of the test against the truth (nan: not tested);
    whole: z of the picture's mean; difference: relative, of the means; resolution: standard error of that difference;
    rays: per sample; caustic: mean luminance of L_c; signed (H, W): smoothed relative error of biased ones; warnings:
    given beforehand; verdict: what failed, empty if nothing did.
    """

    value: Value
    x: float
    label: str
    biased: bool
    relmse: float = math.nan
    share: float = math.nan
    bias: float = math.nan
    p: float = math.nan
    z: float = math.nan
    whole: float = math.nan
    difference: float = math.nan
    resolution: float = math.nan
    passes: int = 0
    pass_seconds: float = math.nan
    preprocess: float = math.nan
    rays: float = math.nan
    slowest: float = math.nan
    memory_mb: float = math.nan
    caustic: float = math.nan
    verdict: str = ""
    against: str = ""
    warnings: tuple[str, ...] = ()
    rgb: np.ndarray | None = None
    signed: np.ndarray | None = None

    @property
    def trusted(self) -> bool:
        """Whether its error is to be believed: not where the light came too rarely to be met."""
        return not self.verdict.startswith(("blind", "misses"))

    @property
    def tested(self) -> bool:
        """Whether its mean was held against the truth."""
        return math.isfinite(self.p)


def refused(value: Value, x: float, label: str, why: str) -> Row:
    """A cell that has no picture."""
    return Row(value, x, label, False, verdict=why)


def hits(measured: Measured, caustic: float) -> float:
    """Expected hits on lights behind specular surfaces in all paths of a tracer that finds them by chance."""
    return measured.samples * caustic / (SHARE_OF_LIGHT * measured.brightest)


def misses(measured: Measured, caustic: float) -> bool:
    """Whether it found less than half of the caustics to be expected: their light came too rarely to be met at all."""
    return measured.caustic < caustic / 2


def sees(measured: Measured, caustic: float) -> bool:
    """Whether its mean can be trusted to know the caustics whose mean radiance is `caustic`."""
    return measured.method not in BY_CHANCE or caustic <= 0 or hits(measured, caustic) >= SIGHT


def seen_caustic(measured: Sequence[Measured]) -> float:
    """Mean luminance of L_c as the unbiased methods that look for caustics see it, else as the others do."""
    unbiased = [m for m in measured if not m.biased]
    return max((m.caustic for m in unbiased if m.method not in BY_CHANCE), default=0.0) or max(
        (m.caustic for m in unbiased), default=0.0
    )


def judge(
    page: Page, value: Value, x: float, found: Sequence[Measured], rivals: Sequence[Measured], caustic: float
) -> list[Row]:
    """The rows of one cell. caustic: mean luminance of L_c to be expected."""
    unbiased = [m for m in (*found, *rivals) if not m.biased]
    sighted = [m for m in unbiased if sees(m, caustic) and not (page.constant_caustics and misses(m, caustic))]
    best = min(sighted or unbiased, key=lambda m: float((m.variance / (m.rgb**2 + RELMSE_FLOOR)).mean()))
    rows = []
    for m in found:
        rival = next((r for r in rivals if r in sighted and r.label != m.label), None)
        rows.append(_row(page, value, x, m, best.rgb, rival, caustic))
    base = next((row for row in rows if row.label == page.baseline), None)
    return [_with_loss(row, base) for row in rows]


def _row(
    page: Page, value: Value, x: float, m: Measured, picture: np.ndarray, rival: Measured | None, caustic: float
) -> Row:
    weight = 1 / (picture**2 + RELMSE_FLOOR)
    own = (m.variance * weight).mean(axis=-1)
    left = page.equal_time - m.preprocess
    bias, signed = math.nan, None
    if m.biased and rival is not None:
        signed = uniform_filter(((m.rgb - rival.rgb) * np.sqrt(weight)).mean(axis=-1), SMOOTHING, mode="nearest")
        bias = float((((m.rgb - rival.rgb) ** 2 - m.variance - rival.variance) * weight).mean())
    relmse = float(own.mean()) * m.seconds / left if left > m.pass_seconds else math.inf
    p = z = whole = difference = resolution = math.nan
    against, verdict = "", ""
    if page.truth.exact is not None:
        against = f"{page.truth.exact:g}"
        truth = np.full((2, m.blocks.shape[1]), page.truth.exact)
        p, z, difference, whole, resolution = _against(m.blocks, truth)
    elif rival is not None:
        against = rival.label
        p, z, difference, whole, resolution = _against(m.blocks, rival.blocks)
    if m.nonfinite:
        verdict = f"{m.nonfinite} non-finite samples"
    elif page.truth.exact == 0 and difference > 0:
        verdict = f"leaks {difference:.1g}"
    elif p < ALPHA and not m.biased:
        verdict = "wrong, as is warned" if any(TOO_FAR in warning for warning in m.warnings) else "WRONG"
    elif p < ALPHA:
        verdict = "biased, as it says"
    elif page.constant_caustics and misses(m, caustic):
        verdict = f"misses {100 * (1 - m.caustic / caustic):.0f} % of the caustics"
    elif not sees(m, caustic):
        verdict = f"blind: {hits(m, caustic):.2g} hits expected"
    elif not math.isfinite(p) and page.truth.rivals:
        verdict = "not tested: no rival sees enough"
    elif left <= 0:
        verdict = f"preprocess exceeds {page.equal_time:g} s"
    return Row(
        value=value, x=x, label=m.label, biased=m.biased, relmse=relmse + max(0.0, bias if m.biased else 0.0),
        share=float(own.max() / max(own.sum(), 1e-300)), bias=bias, p=p, z=z, whole=whole, difference=difference,
        resolution=resolution, passes=m.passes, pass_seconds=m.pass_seconds, preprocess=m.preprocess,
        rays=m.rays / m.samples, slowest=m.slowest, memory_mb=m.memory_mb, caustic=m.caustic, verdict=verdict,
        against=against, rgb=m.rgb.astype(np.float32), signed=signed, warnings=m.warnings,
    )  # fmt: skip


def _against(found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float, float, float]:
    """p, largest z, relative difference of the means, its z, its resolution."""
    verdict = agreement(*(np.column_stack([blocks, blocks.mean(axis=1)]) for blocks in (found, truth)))
    a, b = found.mean(axis=1), truth.mean(axis=1)
    deviation = math.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))
    difference = float(a.mean() - b.mean())
    scale = abs(float(b.mean())) or 1.0  # where nothing should be seen: against radiance 1
    if deviation > 0:
        whole = difference / deviation
    else:
        whole = 0.0 if difference == 0 else math.inf
    return verdict.p, verdict.z, difference / scale, whole, deviation / scale


def _with_loss(row: Row, base: Row | None) -> Row:
    if base is None or base.verdict or row.label == base.label or row.verdict or not row.relmse > LOSS * base.relmse:
        return row
    return replace(row, verdict=f"loses to {base.label}: error x {row.relmse / base.relmse:.2g}")
