"""Where a cluster's caustic light comes from: its aggregated directions, and how much photons near by disagree."""

import numpy as np

from causticmpi.kernels.jit import kernel
from causticmpi.kernels.kdtree import MAX_DEPTH, nearest

COLUMNS, ROWS = 32, 32
"""Bins of the whole sphere: azimuth about z, height; equal solid angles."""
PROBES = 32
"""Photons asked per cluster."""
COMPANIONS = 8
"""A cone is as wide as it takes to hold this many other photons of the same gather."""
NARROWEST, WIDEST = np.radians(0.25), np.radians(30.0)


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


@kernel
def _companion_cosines(x, y, z, axis, direction, start, radius2, distance, row, stack, plane, best, found):
    """Cosine to the COMPANIONS-th closest direction among the neighbours of PROBES photons of each cluster.

    found (m, PROBES) float32: 2 where there are too few neighbours.
    """
    for cluster in range(start.shape[0] - 1):
        low, high = start[cluster], start[cluster + 1]
        for probe in range(PROBES):
            found[cluster, probe] = 2
            if high - low <= COMPANIONS:
                continue
            i = low + (high - low) * probe // PROBES
            k = nearest(
                x, y, z, axis, low, high, (x[i], y[i], z[i]), radius2, row.shape[0], distance, row, stack, plane
            )
            for r in range(COMPANIONS):
                best[r] = -2
            for a in range(k):
                j = row[a]
                if j == i:
                    continue
                cosine = (
                    direction[i, 0] * direction[j, 0]
                    + direction[i, 1] * direction[j, 1]
                    + direction[i, 2] * direction[j, 2]
                )
                r = COMPANIONS
                while r > 0 and best[r - 1] < cosine:
                    if r < COMPANIONS:
                        best[r] = best[r - 1]
                    r -= 1
                if r < COMPANIONS:
                    best[r] = cosine
            if best[COMPANIONS - 1] >= -1:
                found[cluster, probe] = best[COMPANIONS - 1]


def cone_cosines(
    coordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
    axis: np.ndarray,
    direction: np.ndarray,
    start: np.ndarray,
    radius: float,
    neighbours: int,
) -> np.ndarray:
    """Cosine of the half angle of the cones of each cluster (m,) float32; arguments as in `ForecastMaps`."""
    found = np.zeros((len(start) - 1, PROBES), np.float32)
    _companion_cosines(
        *coordinates,
        axis,
        direction,
        start,
        np.float32(radius * radius),
        np.zeros(neighbours, np.float32),
        np.zeros(neighbours, np.int64),
        np.zeros(2 * MAX_DEPTH, np.int32),
        np.zeros(MAX_DEPTH, np.float32),
        np.zeros(COMPANIONS, np.float32),
        found,
    )
    angle = np.where(found > 1.5, np.nan, np.arccos(np.clip(found, -1, 1)))
    known = np.isfinite(angle).any(axis=1)
    width = np.full(len(angle), WIDEST)
    width[known] = np.nanmedian(angle[known], axis=1)
    return np.cos(np.clip(width, NARROWEST, WIDEST)).astype(np.float32)
