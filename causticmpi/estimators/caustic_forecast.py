"""Caustic Forecasting (CF): photons near a point steer the directions of its caustic samples [CF sec. 3.2].

The ways to sample them that have a table of directions, all unbiased:
  two         the paper's: table 1 where photons are, table 2 everywhere else, S samples of each (directional_tables)
  mis         S samples of table 1 and S of the BRDF under the balance heuristic [Veach 1997, sec. 9.2.2]
  one, one-cosine, one-smooth   S samples of one filled table (filled_table)
`mixture`, which needs no table, has kernels of its own (iws_mixture).
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.estimators import directional_tables as dt
from causticmpi.estimators import filled_table as ft
from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.jit import inline
from causticmpi.kernels.kdtree import MAX_DEPTH, nearest
from causticmpi.kernels.vec import ZERO
from causticmpi.preprocess.forecast import ForecastMaps

TWO, MIS, ONE_CONSTANT, ONE_COSINE, ONE_SMOOTH = range(5)
SAMPLINGS = {"two": TWO, "mis": MIS, "one": ONE_CONSTANT, "one-cosine": ONE_COSINE, "one-smooth": ONE_SMOOTH}
"""Values of `forecast.sampling` that have a table."""


class ForecastWork(NamedTuple):
    """Workspace of one gather and its tables.

    sampling: of SAMPLINGS; smoothing: the spread of `one-smooth` (see filled_table), empty for the others
    codeword_distance (m,); distance, row (n,): neighbours; stack, plane: tree walk
    weight (bins,): table 1 by bin, 0 where empty; bins (n,): its occupied bins; cdf (n,): their running sum
    fill (bins,): weights of table 2 before the occupied bins are taken out, or all of a filled table;
    row_sum (rows,): what is left of each row
    """

    sampling: int
    smoothing: Any
    codeword_distance: Any
    distance: Any
    row: Any
    stack: Any
    plane: Any
    weight: Any
    bins: Any
    cdf: Any
    fill: Any
    row_sum: Any


def forecast_work(maps: ForecastMaps, sampling: str = "two") -> ForecastWork:
    """Workspace that fits the maps; sampling: a key of SAMPLINGS."""
    n, bins = maps.neighbours, maps.columns * maps.rows
    smooth = sampling == "one-smooth"
    return ForecastWork(
        sampling=SAMPLINGS[sampling],
        smoothing=ft.smoothing(maps.columns, maps.rows) if smooth else np.zeros((0, 0, 0), np.float32),
        codeword_distance=np.zeros(maps.codebook.shape[1], np.float32),
        distance=np.zeros(n, np.float32),
        row=np.zeros(n, np.int64),
        stack=np.zeros(2 * MAX_DEPTH, np.int32),
        plane=np.zeros(MAX_DEPTH, np.float32),
        weight=np.zeros(bins, np.float32),
        bins=np.zeros(n, np.int64),
        cdf=np.zeros(n, np.float32),
        fill=np.zeros(bins, np.float32),
        row_sum=np.zeros(maps.rows, np.float32),
    )


@inline
def gather(maps, work, cluster, p):
    """The at most n nearest forecast photons of a cluster within the search radius, in `work.row`. Returns their
    number.

    work: any workspace with `distance`, `row`, `stack` and `plane`.
    """
    radius = np.float32(maps.radius)
    return nearest(
        maps.x,
        maps.y,
        maps.z,
        maps.axis,
        maps.start[cluster],
        maps.start[cluster + 1],
        p,
        radius * radius,
        maps.neighbours,
        work.distance,
        work.row,
        work.stack,
        work.plane,
    )


@inline
def prepare(scene, maps, work, k, n, wo, material):
    """Fill what `work.sampling` needs from k gathered photons. Returns (occupied bins, sum of table 1, other sum).

    The other sum is that of table 2, or of the filled table; 0 for `mis`, which has no second table.
    """
    occupied, total1 = dt.fill_table1(scene, maps, work, k, n, wo, material)
    other = ZERO
    if work.sampling == TWO:
        other = dt.fill_table2(scene, maps, work, occupied, n, wo, material)
    elif work.sampling == ONE_CONSTANT:
        other = ft.fill_constant(maps, work, total1)
    elif work.sampling == ONE_COSINE:
        other = ft.fill_cosine(scene, maps, work, occupied, total1, n, wo, material)
    elif work.sampling == ONE_SMOOTH:
        other = ft.fill_smooth(maps, work, occupied, total1)
    return occupied, total1, other


@inline
def parts(work):
    """How many samplers are asked S times each."""
    return 2 if work.sampling <= MIS else 1


@inline
def draw(scene, maps, work, part, occupied, total1, other, n, wo, material, choice, u, v):
    """Direction of sampler `part` and the density its sample is divided by (solid angle); 0: there is none.

    Tables of disjoint domains, or one table: the sampler's own density. `mis`: the sum of both samplers', each of which
    is asked equally often, so f cos / density of all samples add up to the balance heuristic.
    """
    if work.sampling == MIS:
        return _draw_mis(scene, maps, work, part, occupied, total1, n, wo, material, choice, u, v)
    if work.sampling != TWO:
        local, probability = ft.sample_filled(maps, work, other, choice, u, v)
    elif part == 0:
        if total1 <= ZERO:
            return n, ZERO
        local, probability = dt.sample_table1(maps, work, occupied, total1, choice, u, v)
    else:
        if other <= ZERO:
            return n, ZERO
        local, probability = dt.sample_table2(scene, maps, work, material, other, choice, u, v)
    return vec.to_world(local, n), probability * dt.bin_density(maps)


@inline
def _draw_mis(scene, maps, work, part, occupied, total1, n, wo, material, choice, u, v):
    if part == 0:
        if total1 <= ZERO:
            return n, ZERO
        local, _ = dt.sample_table1(maps, work, occupied, total1, choice, u, v)
        direction = vec.to_world(local, n)
    else:
        direction = bsdf.sample(scene, material, n, wo, choice, u, v)
        local = vec.to_local(direction, n)
    return direction, bsdf.pdf(scene, material, n, wo, direction) + dt.table1_pdf(maps, work, total1, local)


@inline
def splitting(maps, rank, depth):
    """Samples S of each sampler: halved every second rank, one from the second diffuse vertex on.

    0 where forecasting does not pay: beyond max_rank, which shrinks by two with each diffuse vertex. It depends on the
    place and the depth alone, never on the samples themselves.
    """
    if rank + 2 * depth > maps.max_rank:
        return 0
    if depth > 0:
        return 1
    return max(1, maps.splitting >> (rank >> 1))
