"""Do two sets of independent passes have the same mean? t-tests of many quantities at once, Sidak-corrected.

Pixels of a pass share its virtual lights, so all variances are taken over passes, never over neighbouring pixels.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

ALPHA = 1e-3
"""Significance of a whole test, all its quantities together: one in a thousand correct renderers would fail it."""


@dataclass(frozen=True)
class Verdict:
    """p: Sidak-corrected over `tests` quantities; z: the largest deviation in standard errors."""

    p: float
    z: float
    tests: int

    def __str__(self) -> str:
        return f"p = {self.p:.3g}, largest |z| = {self.z:.2f} of {self.tests}"


def sidak(p: float, tests: int) -> float:
    """Probability that the smallest of `tests` independent p-values is at most p [Sidak 1967]."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))


def block_means(films: np.ndarray, side: int) -> np.ndarray:
    """Means over side x side pixels: (passes, height, width, channels) -> (passes, blocks * channels) float64."""
    passes, height, width, channels = films.shape
    blocks = films.astype(np.float64).reshape(passes, height // side, side, width // side, side, channels)
    return blocks.mean(axis=(2, 4)).reshape(passes, -1)


def grouped(values: np.ndarray, group: int) -> np.ndarray:
    """Means of runs of `group` passes: nearer to a normal distribution where single passes have heavy tails."""
    return values[: len(values) // group * group].reshape(-1, group, *values.shape[1:]).mean(axis=1)


def relative_error(values: np.ndarray) -> float:
    """Standard error of the overall mean of (passes, …) over that mean."""
    means = values.reshape(len(values), -1).mean(axis=1, dtype=np.float64)
    return float(means.std(ddof=1) / np.sqrt(len(means)) / means.mean())


def largest_share(values: np.ndarray) -> float:
    """The largest share that a single one of (passes, columns) has in the sum of its column: where it is not small, one
    pass is all the evidence, its variance is unknown, and a t-test says nothing."""
    return float((values.max(axis=0) / values.sum(axis=0)).max())


def compare(a: np.ndarray, b: np.ndarray) -> Verdict:
    """Welch's t-test of every column of two (passes, columns) arrays, which may differ in passes."""
    va, vb = a.var(axis=0, ddof=1) / len(a), b.var(axis=0, ddof=1) / len(b)
    freedom = (va + vb) ** 2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    return _verdict(a.mean(axis=0) - b.mean(axis=0), va + vb, freedom)


def compare_with_truth(values: np.ndarray, truth: float) -> Verdict:
    """t-test of every column of (passes, columns) against a known value."""
    variance = values.var(axis=0, ddof=1) / len(values)
    return _verdict(values.mean(axis=0) - truth, variance, np.full(variance.shape, len(values) - 1.0))


def _verdict(difference: np.ndarray, variance: np.ndarray, freedom: np.ndarray) -> Verdict:
    # Where nothing varies (a black wall), means must be equal.
    exact = np.where(difference == 0, 0.0, np.inf)
    z = np.where(variance > 0, np.abs(difference) / np.sqrt(np.where(variance > 0, variance, 1)), exact)
    p = 2 * stats.t.sf(z, np.maximum(freedom, 1))
    return Verdict(sidak(float(p.min()), p.size), float(z.max()), p.size)


def assert_equal_means(a: np.ndarray, b: np.ndarray, what: str) -> Verdict:
    """Fail unless `compare` finds no difference at ALPHA."""
    verdict = compare(a, b)
    assert verdict.p > ALPHA, f"{what}: means differ, {verdict}"
    return verdict
