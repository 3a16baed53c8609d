"""One table of directions without empty bins, the paper's rivals to its two tables; the sampler beside its pdf.

What table 1 holds (directional_tables) is filled up with a share FILL of the probability, so that no direction is out
of reach; a bin of table 1 that weighs less than the fill counts as empty:
  constant   all bins alike [Jensen 1995, "Importance driven path tracing using the photon map"]
  cosine     by representative cosine and BRDF with a floor, as the paper tried [CF sec. 3.2]
  smooth     all bins alike, after table 1 has been spread by a Gaussian on the sphere of directions
"""

import numpy as np

from causticmpi.estimators import directional_tables as dt
from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import ONE, ZERO

FILL = np.float32(0.1)
"""Probability of the fill wherever table 1 holds anything."""
_ODDS = FILL / (ONE - FILL)
SPREAD = 1.0
"""Standard deviation of the Gaussian in widths of a bin, the square root of its solid angle."""


def smoothing(columns: int, rows: int) -> np.ndarray:
    """(rows, rows, 2 columns) float32: share that a photon in the middle of a bin gives to each bin.

    [a, b, columns + d] goes from row a to row b, d columns on, for -columns < d < columns. All shares of a bin add up
    to 1: what would fall below the horizon stays above it.
    """
    z = (np.arange(rows) + 0.5) / rows
    r = np.sqrt(1 - z * z)
    azimuth = 2 * np.pi * np.arange(-columns, columns) / columns
    cosine = r[:, None, None] * r[None, :, None] * np.cos(azimuth) + z[:, None, None] * z[None, :, None]
    angle = np.arccos(np.clip(cosine, -1, 1))
    width = SPREAD * np.sqrt(2 * np.pi / (columns * rows))
    share = np.exp(-0.5 * (angle / width) ** 2)
    share /= share[:, :, :columns].sum(axis=(1, 2), keepdims=True)
    return share.astype(np.float32)


@inline
def _sum_rows(maps, work):
    """Running totals of `work.fill` by row; returns the whole."""
    total = ZERO
    for r in range(maps.rows):
        row = ZERO
        for c in range(maps.columns):
            row += work.fill[r * maps.columns + c]
        work.row_sum[r] = row
        total += row
    return total


@inline
def fill_constant(maps, work, total1):
    """Fill `work.fill` from table 1 and the constant. Returns the sum, > 0."""
    bins = maps.columns * maps.rows
    fill = total1 * _ODDS / np.float32(bins) if total1 > ZERO else ONE
    for i in range(bins):
        work.fill[i] = max(work.weight[i], fill)
    return _sum_rows(maps, work)


@inline
def fill_cosine(scene, maps, work, occupied, total1, n, wo, material):
    """Fill `work.fill` from table 1 and the representative cosine and BRDF of all bins. Returns the sum, > 0."""
    dt.fill_table2(scene, maps, work, occupied, n, wo, material)
    whole = ZERO
    for i in range(maps.columns * maps.rows):
        work.fill[i] = dt.representative(scene, maps, work, material, i)
        whole += work.fill[i]
    factor = total1 * _ODDS / whole if total1 > ZERO else ONE
    for i in range(maps.columns * maps.rows):
        work.fill[i] = max(work.weight[i], work.fill[i] * factor)
    return _sum_rows(maps, work)


@inline
def fill_smooth(maps, work, occupied, total1):
    """Fill `work.fill` from table 1, spread, and a constant in every bin. Returns the sum, > 0."""
    bins = maps.columns * maps.rows
    fill = total1 * _ODDS / np.float32(bins) if total1 > ZERO else ONE
    for i in range(bins):
        work.fill[i] = fill
    for o in range(occupied):
        source = work.bins[o]
        row = source // maps.columns
        column = source - row * maps.columns
        weight = work.weight[source]
        for r in range(maps.rows):
            for c in range(maps.columns):
                work.fill[r * maps.columns + c] += weight * work.smoothing[row, r, maps.columns + c - column]
    return _sum_rows(maps, work)


@inline
def sample_filled(maps, work, total, u, v, w):
    """Direction in the frame of the normal with `filled_pdf`, and its bin's probability."""
    target = u * total
    row, last = 0, maps.rows - 1
    while row < last and target >= work.row_sum[row]:
        target -= work.row_sum[row]
        row += 1
    chosen, last = row * maps.columns, (row + 1) * maps.columns - 1
    while chosen < last and target >= work.fill[chosen]:
        target -= work.fill[chosen]
        chosen += 1
    return dt.direction_in_bin(maps, chosen, v, w), work.fill[chosen] / total


@inline
def filled_pdf(maps, work, total, local):
    """Density of `sample_filled` (solid angle), > 0 all over the hemisphere."""
    if local[2] <= ZERO:
        return ZERO
    return work.fill[dt.bin_of(maps, local)] / total * dt.bin_density(maps)
