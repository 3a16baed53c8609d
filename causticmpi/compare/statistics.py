"""Confidence intervals over seeds, slopes in log-log charts, and a t-test of many means at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
FEW_HITS = 400
"""Rare bright hits that a picture needs before a mean that is too low is worth a t-test: 25 in each of 16 squares, for
one that got a fourth of its hits is dark and seems sure of it."""
SKEWED = 4.0
"""Standard errors of a normal sample's third moment from which batches count as skewed."""
DECADE = 10.0
"""Passes over those from which on a slope is fitted."""
FEWEST_POINTS = 4
"""Of a curve that tells a slope or a floor."""


@dataclass(frozen=True)
class Interval:
    """mean +- half (95 %, Student's t) of `count` values; half is nan for a single one."""

    mean: float
    half: float
    count: int


def interval(values: list[float] | np.ndarray) -> Interval:
    """Mean and confidence interval of independent values; nan without any."""
    from scipy import stats

    x = np.asarray(values, np.float64)
    if len(x) == 0:
        return Interval(float("nan"), float("nan"), 0)
    if len(x) == 1:
        return Interval(float(x[0]), float("nan"), 1)
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))
    return Interval(float(x.mean()), float(half), len(x))


def slope(curve: np.ndarray) -> float:
    """Least-squares slope of log error against log passes over the last decade of a curve's passes, (n, 2).

    nan with fewer than FEWEST_POINTS positive errors there, or where they span less than a factor of three.
    """
    n, e = curve.T
    if len(n) == 0:
        return float("nan")
    kept = (n >= n.max() / DECADE * (1 - 1e-9)) & (e > 0) & np.isfinite(e)
    if kept.sum() < FEWEST_POINTS or n[kept].max() < 3 * n[kept].min():
        return float("nan")
    return float(np.polyfit(np.log(n[kept]), np.log(e[kept]), 1)[0])


def sidak(p: float, tests: int) -> float:
    """Probability that the least of `tests` independent p-values is at most p [Sidak 1967]."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))


def mean_curve(curves: Sequence[np.ndarray]) -> np.ndarray:
    """(k, 2) x and mean error of several curves, (n, 2) each and ascending in x, where all of them have values.

    Between its points x * error is interpolated, which hardly varies along a curve of slope -1.
    """
    if len(curves) == 1:
        return curves[0]
    low, high = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    if low >= high:
        return np.zeros((0, 2))
    x = np.geomspace(low, high, max(len(c) for c in curves))
    scaled = [np.interp(np.log(x), np.log(c[:, 0]), c[:, 0] * c[:, 1]) for c in curves]
    return np.stack([x, np.mean(scaled, axis=0) / x], axis=1)


def floor(curve: np.ndarray) -> float:
    """The error f that remains after many passes: fit of f + a / x to a mean curve, (n, 2), relative deviations least.

    nan with fewer than FEWEST_POINTS positive errors.
    """
    x, e = curve[curve[:, 1] > 0].T
    if len(x) < FEWEST_POINTS:
        return float("nan")
    (found, _), *_ = np.linalg.lstsq(np.stack([1 / e, 1 / (x * e)], axis=1), np.ones(len(x)), rcond=None)
    return float(found)


def jackknife(curves: Sequence[np.ndarray], fit: Callable[[np.ndarray], float]) -> Interval:
    """`fit` of the mean curve, with the interval of leaving out one curve after the other.

    A slope of the mean, not the mean of slopes, which would be too flat: where few passes leave rare bright samples
    out, most curves are low.
    """
    from scipy import stats

    value, n = fit(mean_curve(curves)), len(curves)
    if n < 2:
        return Interval(value, float("nan"), n)
    without = np.array([fit(mean_curve([*curves[:i], *curves[i + 1 :]])) for i in range(n)])
    deviation = np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2))
    return Interval(value, float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1) * deviation), n)


@dataclass(frozen=True)
class Agreement:
    """Welch's t-tests of `tests` means at once. p: Sidak-corrected least; z: largest deviation in standard errors;
    difference: of the overall means, relative; p_above: as p, of those means of the first alone that are too large."""

    p: float
    z: float
    tests: int
    difference: float
    p_above: float = 1.0


def agreement(a: np.ndarray, b: np.ndarray) -> Agreement:
    """Do the columns of (m, k) and (n, k) independent values have equal means? Raises ValueError for m or n < 2."""
    from scipy import stats

    if len(a) < 2 or len(b) < 2:
        raise ValueError("a variance needs two values")
    va, vb = a.var(axis=0, ddof=1) / len(a), b.var(axis=0, ddof=1) / len(b)
    freedom = (va + vb) ** 2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    difference, variance = a.mean(axis=0) - b.mean(axis=0), va + vb
    exact = np.where(difference == 0, 0.0, np.inf)  # where nothing varies, means must be equal
    z = np.where(variance > 0, np.abs(difference) / np.sqrt(np.where(variance > 0, variance, 1.0)), exact)
    p = 2 * stats.t.sf(z, np.maximum(freedom, 1.0))
    relative = float(difference.mean() / max(abs(b.mean()), 1e-300))
    above = float(np.where(difference > 0, p, 1.0).min())
    return Agreement(sidak(float(p.min()), p.size), float(z.max()), int(p.size), relative, sidak(above, p.size))


def fewest_hits(values: np.ndarray) -> float:
    """How many rare bright hits make the spread of (m, k) independent values, at least; inf without spread.

    The sum of h for each of a Poisson number n of hits has the variance n h^2 and the third moment n h^3, so that over
    all columns together n = m (sum of variances)^3 / (sum of third moments)^2; hits of unlike strengths count as the
    few that carry the variance. With few hits t-tests are void: columns that got none are dark and seem sure of it.
    Where the values show no skew, it is the number of hits from which on they would not: m^2 / 96 where one column has
    all the variance, and k^2 times as many where k columns share it. So 16 values cannot tell three hits in one column
    from a million. Columns of one hit's colours are no columns of their own. Raises ValueError for m < 3.
    """
    second, third, noise = _moments(values)
    return len(values) * second**3 / max(third, noise) ** 2 if noise > 0 else float("inf")


def _moments(values: np.ndarray) -> tuple[float, float, float]:
    """Sums over columns of the variances and of the third moments of (m, k) values; the least third sum that counts."""
    m = len(values)
    if m < 3:
        raise ValueError("a third moment needs three values")
    deviation = values - values.mean(axis=0)
    second = (deviation**2).sum(axis=0) / (m - 1)
    third = float((deviation**3).sum()) * m / ((m - 1) * (m - 2))
    return float(second.sum()), third, SKEWED * float(np.sqrt(6 / m * (second**3).sum()))


def block_means(picture: np.ndarray, side: int) -> np.ndarray:
    """Means over side x side pixels of (H, W, C), flat; blocks at the right and lower border may be smaller."""
    height, width, _ = picture.shape
    rows, columns = np.arange(0, height, side), np.arange(0, width, side)
    sums = np.add.reduceat(np.add.reduceat(picture.astype(np.float64), rows, axis=0), columns, axis=1)
    tall, wide = np.diff([*rows, height]), np.diff([*columns, width])
    means: np.ndarray = (sums / (tall[:, None] * wide[None, :])[..., None]).ravel()
    return means
