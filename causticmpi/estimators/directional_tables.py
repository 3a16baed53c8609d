"""The paper's two tables of directions, each sampler beside its pdf [CF sec. 3.2].

The hemisphere above p, in the frame of its normal, is cut into columns x rows bins of equal solid angle (azimuth,
cosine).
Table 1 holds the bins that gathered photons fall into, weighted by photon power, BRDF and cosine. Table 2 holds all
other bins, weighted by a representative cosine and BRDF with a floor, so that no direction is out of reach. The
domains are disjoint: each table is sampled on its own and the estimates are added.
The workspace `work` is any with the fields `row`, `weight`, `bins`, `cdf`, `fill` and `row_sum` of ForecastWork.
"""

import math

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import HALF, INV_PI, ONE, TWO_PI, ZERO
from causticmpi.kernels.warp import turn, turns

FLOOR = np.float32(0.05)
"""Table 2 counts at least this share of the albedo as if it were Lambertian: the edge of a lobe inside a bin whose
centre is dark stays within reach."""
LEAST = np.float32(2.0**-12)
"""An occupied bin of table 1 weighs at least this share of all: the uniforms have steps of 2^-24, and a bin less likely
than that would never be drawn although table 2 leaves it out."""


@inline
def bin_of(maps, local):
    """Bin of a unit direction in the frame of the normal, above the horizon."""
    column = min(maps.columns - 1, np.int64(turns(local[0], local[1]) * np.float32(maps.columns)))
    row = min(maps.rows - 1, np.int64(local[2] * np.float32(maps.rows)))
    return row * maps.columns + column


@inline
def direction_in_bin(maps, index, u, v):
    """Uniform direction of a bin, in the frame of the normal."""
    row = index // maps.columns
    column = index - row * maps.columns
    cosine = (np.float32(row) + u) / np.float32(maps.rows)
    c, s = turn((np.float32(column) + v) / np.float32(maps.columns))
    sine = math.sqrt(max(ZERO, ONE - cosine * cosine))
    return sine * c, sine * s, cosine


@inline
def bin_density(maps):
    """1 / solid angle of a bin [1/sr]."""
    return np.float32(maps.columns * maps.rows) / TWO_PI


@inline
def fill_table1(scene, maps, work, k, n, wo, material):
    """Weigh the bins of k gathered photons, each with LEAST of all at least.

    Returns (occupied bins, their sum); the sum is 0 where none counts.
    """
    occupied = 0
    for i in range(k):
        photon = work.row[i]
        wi = vec.row(maps.direction, photon)
        cosine = vec.dot(n, wi)
        if cosine <= ZERO:
            continue
        w = maps.power[photon] * cosine * vec.luminance(bsdf.evaluate(scene, material, n, wo, wi))
        if not w > ZERO:
            continue
        index = bin_of(maps, vec.to_local(wi, n))
        if work.weight[index] == ZERO:
            work.bins[occupied] = index
            occupied += 1
        work.weight[index] += w
    least = ZERO
    for i in range(occupied):
        least += work.weight[work.bins[i]] * LEAST
    total = ZERO
    for i in range(occupied):
        index = work.bins[i]
        work.weight[index] = max(work.weight[index], least)
        total += work.weight[index]
        work.cdf[i] = total
    return occupied, total


@inline
def fill_table2(scene, maps, work, occupied, n, wo, material):
    """Weigh the bins that table 1 leaves empty. Returns their sum.

    Lambert needs no BRDF: all bins of a row weigh the same, and only the occupied ones are looked at.
    """
    total = ZERO
    lambert = scene.kind[material] == DIFFUSE
    floor = FLOOR * vec.luminance(bsdf.albedo(scene, material)) * INV_PI
    if lambert:
        for r in range(maps.rows):
            work.row_sum[r] = np.float32(maps.columns)
        for i in range(occupied):
            work.row_sum[work.bins[i] // maps.columns] -= ONE
    for r in range(maps.rows):
        cosine = (np.float32(r) + HALF) / np.float32(maps.rows)
        if lambert:
            work.row_sum[r] *= cosine  # of a count, which is exact: a full row weighs 0
        else:
            work.row_sum[r] = ZERO
            for c in range(maps.columns):
                index = r * maps.columns + c
                wi = vec.to_world(direction_in_bin(maps, index, HALF, HALF), n)
                work.fill[index] = cosine * (vec.luminance(bsdf.evaluate(scene, material, n, wo, wi)) + floor)
                work.row_sum[r] += ZERO if work.weight[index] > ZERO else work.fill[index]
        total += work.row_sum[r]
    return total


@inline
def clear_tables(work, occupied):
    """Make the workspace ready for the next gather."""
    for i in range(occupied):
        work.weight[work.bins[i]] = ZERO


@inline
def sample_table1(maps, work, occupied, total, u, v, w):
    """Direction in the frame of the normal with `table1_pdf`, and its bin's probability; total > 0."""
    target = u * total
    low, high = 0, occupied - 1
    while low < high:
        middle = (low + high) >> 1
        if target < work.cdf[middle]:
            high = middle
        else:
            low = middle + 1
    chosen = work.bins[low]
    return direction_in_bin(maps, chosen, v, w), work.weight[chosen] / total


@inline
def table1_pdf(maps, work, total, local):
    """Density of `sample_table1` (solid angle); 0 in empty bins."""
    if local[2] <= ZERO or total <= ZERO:
        return ZERO
    return work.weight[bin_of(maps, local)] / total * bin_density(maps)


@inline
def representative(scene, maps, work, material, index):
    """Weight of a bin of table 2: cosine, for gloss times BRDF and floor, of the bin's centre."""
    if scene.kind[material] == DIFFUSE:
        return (np.float32(index // maps.columns) + HALF) / np.float32(maps.rows)
    return work.fill[index]


@inline
def sample_table2(scene, maps, work, material, total, u, v, w):
    """Direction in the frame of the normal with `table2_pdf`, and its bin's probability; total > 0."""
    target = u * total
    row, last = 0, 0
    for r in range(maps.rows):
        if work.row_sum[r] > ZERO:
            last = r
    while row < last and target >= work.row_sum[row]:
        target -= work.row_sum[row]
        row += 1
    chosen = -1
    for c in range(maps.columns):
        index = row * maps.columns + c
        if work.weight[index] > ZERO:
            continue
        chosen = index
        weight = representative(scene, maps, work, material, index)
        if target < weight:
            break
        target -= weight
    return direction_in_bin(maps, chosen, v, w), representative(scene, maps, work, material, chosen) / total


@inline
def table2_pdf(scene, maps, work, material, total, local):
    """Density of `sample_table2` (solid angle); 0 in the bins of table 1."""
    if local[2] <= ZERO:
        return ZERO
    index = bin_of(maps, local)
    if work.weight[index] > ZERO:
        return ZERO
    return representative(scene, maps, work, material, index) / total * bin_density(maps)
