"""Chi-square tests of samplers against their pdf, over cells of the sphere.

Significance is stated for a whole file of tests: `SIGNIFICANCE` is the chance that a right implementation would fail
any of them, and each single p-value is held against its Sidak share of it. Seeds are fixed: the outcome never flickers.
"""

import numpy as np
from scipy import stats

SIGNIFICANCE = 0.01
"""Chance of a false alarm in a whole file of tests, had the seeds not been fixed."""
SAMPLES = 1 << 20
LEAST_EXPECTED = 8.0
"""Cells that expect fewer samples are pooled."""


def sidak(comparisons: int) -> float:
    """Level of each of `comparisons` independent tests that together keep to SIGNIFICANCE."""
    return -np.expm1(np.log1p(-SIGNIFICANCE) / comparisons)


def p_value(counts: np.ndarray, expected: np.ndarray) -> float:
    """Chance of counts at least so far from `expected`; 0 where a cell of no probability was hit."""
    counts, expected = counts.ravel().astype(np.float64), expected.ravel().astype(np.float64)
    if counts[expected <= 0].any():
        return 0.0
    order = np.argsort(expected, kind="stable")
    counts, expected = counts[order], expected[order]
    pooled = int(np.searchsorted(np.cumsum(expected), LEAST_EXPECTED)) + 1
    pooled = max(pooled, int(np.searchsorted(expected, LEAST_EXPECTED)))
    pooled = min(pooled, len(expected))
    counts = np.concatenate([[counts[:pooled].sum()], counts[pooled:]])
    expected = np.concatenate([[expected[:pooled].sum()], expected[pooled:]])
    statistic = ((counts - expected) ** 2 / expected).sum()
    return float(stats.chi2.sf(statistic, len(expected) - 1))


def uniform_p_value(values: np.ndarray, cells: int = 256) -> float:
    """Chi-square of values in [0, 1) against the uniform distribution."""
    counts = np.bincount((values.astype(np.float64) * cells).astype(np.int64), minlength=cells)
    return p_value(counts, np.full(cells, len(values) / cells))


def pair_p_value(a: np.ndarray, b: np.ndarray, cells: int = 32) -> float:
    """Chi-square of pairs in the unit square against the uniform distribution."""
    index = (a.astype(np.float64) * cells).astype(np.int64) * cells + (b.astype(np.float64) * cells).astype(np.int64)
    return p_value(np.bincount(index, minlength=cells * cells), np.full(cells * cells, len(a) / cells**2))


def perpendicular(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that complete `axis` to a frame."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    tangent = np.cross(axis, helper)
    tangent /= np.linalg.norm(tangent)
    return tangent, np.cross(axis, tangent)


class SphereCells:
    """Cells in azimuth and height about an axis. heights: edges of cos(theta) from -1 to 1, ascending."""

    def __init__(self, axis: np.ndarray, heights: np.ndarray, columns: int = 16) -> None:
        self.axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        self.frame = np.stack([*perpendicular(self.axis), self.axis])
        self.heights = np.asarray(heights, np.float64)
        self.columns = columns

    def counts(self, directions: np.ndarray) -> np.ndarray:
        """Histogram (rows, columns) of unit directions (n, 3)."""
        x, y, z = self.frame @ directions.astype(np.float64).T
        column = np.minimum((np.arctan2(y, x) / (2 * np.pi) % 1 * self.columns).astype(int), self.columns - 1)
        row = np.clip(np.searchsorted(self.heights, z, side="right") - 1, 0, len(self.heights) - 2)
        cells = (len(self.heights) - 1) * self.columns
        return np.bincount(row * self.columns + column, minlength=cells).reshape(-1, self.columns)

    def quadrature(self, points: int) -> tuple[np.ndarray, np.ndarray]:
        """Directions (rows * columns * points^2, 3) by the midpoint rule in each cell, and their solid angles."""
        fine = (np.arange(points) + 0.5) / points
        low, width = self.heights[:-1], np.diff(self.heights)
        z = np.clip((low[:, None] + width[:, None] * fine).ravel(), -1, 1)
        phi = 2 * np.pi * (np.arange(self.columns)[:, None] + fine).ravel() / self.columns
        r = np.sqrt(1 - z**2)
        local = np.stack(
            [r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), np.broadcast_to(z[:, None], (len(z), len(phi)))]
        )
        area = np.repeat(width / points, points)[:, None] * np.full(len(phi), 2 * np.pi / len(phi))
        return np.einsum("ki,krc->rci", self.frame, local).reshape(-1, 3), area.ravel()

    def integrate(self, density: np.ndarray, points: int) -> np.ndarray:
        """Integral over each cell of a density given at the directions of `quadrature(points)`."""
        _, area = self.quadrature(points)
        rows = len(self.heights) - 1
        return (density.astype(np.float64) * area).reshape(rows, points, self.columns, points).sum(axis=(1, 3))


def heights_about_lobe(exponent: float) -> np.ndarray:
    """Edges of cos(theta) that give a lobe cos^exponent, and the rest of the sphere, cells of fair probability."""
    shares = np.concatenate([2.0 ** -np.arange(24.0, 4, -1), np.linspace(0, 1, 17)[1:]])
    quantiles = shares ** (1 / (exponent + 1))
    # No edge at 0: there the rounding of float32 would decide which cell a direction in the horizon belongs to.
    return np.unique(np.concatenate([np.linspace(-1, -0.01, 8), np.linspace(-0.01, quantiles[0], 6), quantiles]))
