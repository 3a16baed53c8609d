"""Where a cluster's caustic light comes from: its aggregated directions."""

import numpy as np

COLUMNS, ROWS = 32, 32
"""Bins of the whole sphere: azimuth about z, height; equal solid angles."""


def coarse_tables(direction: np.ndarray, power: np.ndarray, cluster: np.ndarray, count: int) -> np.ndarray:
    """Running sums (count, COLUMNS * ROWS) float32, from >= 0 to 1, of the power of each cluster's points by direction.

    direction (n, 3) unit, power (n,), cluster (n,). A cluster without power gets the uniform distribution.
    """
    bins = COLUMNS * ROWS
    azimuth = np.mod(np.arctan2(direction[:, 1], direction[:, 0]), 2 * np.pi)
    column = np.minimum((azimuth * (COLUMNS / (2 * np.pi))).astype(np.int64), COLUMNS - 1)
    row = np.clip(((direction[:, 2].astype(np.float64) + 1) * (0.5 * ROWS)).astype(np.int64), 0, ROWS - 1)
    place = cluster.astype(np.int64) * bins + row * COLUMNS + column
    table = np.bincount(place, weights=power, minlength=count * bins).reshape(count, bins)
    total = table.sum(axis=1, keepdims=True)
    lit = total[:, 0] > 0
    table[lit] /= total[lit]
    table[~lit] = 1 / bins
    cdf = np.cumsum(table, axis=1).astype(np.float32)
    # Rounding must not leave a gap behind the last bin in use.
    last = bins - 1 - np.argmax(table[:, ::-1] > 0, axis=1)
    cdf[np.arange(bins) >= last[:, None]] = 1
    return cdf
