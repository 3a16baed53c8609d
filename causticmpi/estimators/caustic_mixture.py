"""Caustic directions from a mixture under the balance heuristic: samplers, each beside its pdf (solid angle).

  fine    narrow cones around the directions of the photons gathered near by;
  cell    cones around a few directions of the cell of a grid: O(1), at vertices too many or too deep to gather at;
  coarse  the aggregated directions of the whole cluster, a table made in the preprocess: O(1), and silent nowhere;
  brdf    `bsdf.sample`, which reaches every direction: with a share of it the estimate is unbiased whatever the
          photons are.
The paper's bins are wider than many lights look through a lens; cones are as wide as photons near by disagree.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.embree import LANES, aligned_words
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import HALF, INV_TWO_PI, ONE, TWO, ZERO
from causticmpi.kernels.warp import pick, turn, turns
from causticmpi.preprocess.anchors import anchor_of
from causticmpi.preprocess.cells import KEPT
from causticmpi.preprocess.directions import COLUMNS, ROWS
from causticmpi.preprocess.forecast import ForecastMaps

LANE_ROWS = 31
"""Of `MixtureWork.lane`, told in `mixture_rays`."""


class MixtureWork(NamedTuple):
    """Workspace, most of it by lane: a vertex that sends its rays.

    cluster, anchor, cell (16,): where it is, anchor and cell -1 where none steers it; total (16,): sum of the weights
    of its anchor's photons; weight, cdf (16, >= n): these, and their running sum; lane: rows of `mixture_rays`;
    codeword_distance (m,): search.
    """

    cluster: Any
    anchor: Any
    cell: Any
    total: Any
    weight: Any
    cdf: Any
    lane: Any
    codeword_distance: Any


def mixture_work(maps: ForecastMaps) -> MixtureWork:
    """Workspace that fits the maps."""
    photons = maps.anchor_photon.shape[2]
    return MixtureWork(
        cluster=np.zeros(LANES, np.int64),
        anchor=np.zeros(LANES, np.int64),
        cell=np.zeros(LANES, np.int64),
        total=np.zeros(LANES, np.float32),
        weight=np.zeros((LANES, photons), np.float32),
        cdf=np.zeros((LANES, photons), np.float32),
        lane=aligned_words(LANES * LANE_ROWS),
        codeword_distance=np.zeros(maps.codebook.shape[1], np.float32),
    )


@inline
def photons_near(maps, cluster, p):
    """The anchor whose photons steer at p, in a cluster; -1 for none, as outside the ranked clusters."""
    return anchor_of(maps, cluster, p) if maps.rank[cluster] <= maps.max_rank else np.int64(-1)


@inline
def weigh_fine(scene, maps, work, lane, anchor, n, wo, material):
    """Weigh an anchor's photons by power, BRDF and cosine at a vertex. Returns their sum, 0 where none counts."""
    count = maps.anchor_count[anchor]
    photons, weight, cdf = maps.anchor_photon[anchor], work.weight[lane], work.cdf[lane]
    x, y, z, power = photons[0], photons[1], photons[2], photons[3]
    for i in range(photons.shape[1]):
        weight[i] = max(ZERO, n[0] * x[i] + n[1] * y[i] + n[2] * z[i]) * power[i]
    if scene.kind[material] != DIFFUSE:
        for i in range(count):
            if weight[i] > ZERO:
                weight[i] *= vec.luminance(bsdf.evaluate(scene, material, n, wo, (x[i], y[i], z[i])))
    total = ZERO
    for i in range(count):
        total += weight[i]
        cdf[i] = total
    return total


@inline
def in_cone(axis, height, u, v):
    """Uniform direction in a cone; height: 1 - cosine of its half angle, for near 1 the cosine is too coarse in
    float32."""
    height *= u
    sine = math.sqrt(height * (TWO - height))
    c, s = turn(v)
    return vec.to_world((sine * c, sine * s, ONE - height), axis)


@inline
def fine_cone(maps, work, lane, cluster, anchor, total, choice):
    """A photon chosen by weight, total > 0: direction and height of its cone."""
    i = pick(work.cdf[lane, : maps.anchor_count[anchor]], choice * total)
    axis = (maps.anchor_photon[anchor, 0, i], maps.anchor_photon[anchor, 1, i], maps.anchor_photon[anchor, 2, i])
    return axis, ONE - maps.cone[cluster]


@inline
def sample_fine(maps, work, lane, cluster, anchor, total, choice, u, v):
    """Uniform direction in the cone around a photon chosen by weight; total > 0. It may lie below the horizon."""
    axis, height = fine_cone(maps, work, lane, cluster, anchor, total, choice)
    return in_cone(axis, height, u, v)


@inline
def fine_pdf(maps, work, lane, cluster, anchor, total, direction):
    """Density of `sample_fine`."""
    if total <= ZERO:
        return ZERO
    height = ONE - maps.cone[cluster]
    photons, weight = maps.anchor_photon[anchor], work.weight[lane]
    x, y, z = photons[0], photons[1], photons[2]
    inside = ZERO
    for i in range(photons.shape[1]):
        a, b, c = x[i] - direction[0], y[i] - direction[1], z[i] - direction[2]
        # By the chord, 2 (1 - cosine): a comparison of cosines would lose samples of narrow cones to rounding.
        inside += weight[i] if a * a + b * b + c * c <= TWO * height else ZERO
    return inside / total * INV_TWO_PI / height


@inline
def coarse_bin(direction):
    """Bin of a unit direction: azimuth and height about the world's z axis, equal solid angles."""
    column: Any = min(np.int32(COLUMNS - 1), np.int32(turns(direction[0], direction[1]) * np.float32(COLUMNS)))
    row: Any = max(np.int32(0), min(np.int32(ROWS - 1), np.int32((direction[2] + ONE) * (HALF * np.float32(ROWS)))))
    return row * np.int32(COLUMNS) + column


@inline
def in_coarse_bin(chosen, u, v):
    """Uniform direction of a bin (int32)."""
    row = chosen // np.int32(COLUMNS)
    z = (np.float32(row) + u) * (TWO / np.float32(ROWS)) - ONE
    c, s = turn((np.float32(chosen - row * np.int32(COLUMNS)) + v) * np.float32(1 / COLUMNS))
    r = math.sqrt(max(ZERO, ONE - z * z))
    return r * c, r * s, z


@inline
def sample_coarse(maps, cluster, choice, u, v):
    """Direction from all caustic points of a cluster, uniform within its bin. It may lie below the horizon."""
    return in_coarse_bin(np.int32(pick(maps.coarse[cluster], choice)), u, v)


@inline
def coarse_pdf(maps, cluster, direction):
    """Density of `sample_coarse`."""
    return coarse_density(maps, cluster, np.int64(coarse_bin(direction)))


@inline
def coarse_density(maps, cluster, i):
    """Density of `sample_coarse` in bin i."""
    before = maps.coarse[cluster, i - 1] if i > 0 else ZERO
    return (maps.coarse[cluster, i] - before) * (np.float32(COLUMNS * ROWS) * HALF * INV_TWO_PI)


@inline
def cell_cone(maps, cell, choice):
    """One of a cell's directions, all alike: direction and height of its cone."""
    i = np.int64(choice * np.float32(KEPT))
    axis = (maps.cell_direction[cell, 0, i], maps.cell_direction[cell, 1, i], maps.cell_direction[cell, 2, i])
    return axis, ONE - maps.cell_cone[cell]


@inline
def sample_cell(maps, cell, choice, u, v):
    """Uniform direction in the cone around one of a cell's directions. It may lie below the horizon."""
    axis, height = cell_cone(maps, cell, choice)
    return in_cone(axis, height, u, v)


@inline
def cell_pdf(maps, cell, direction):
    """Density of `sample_cell`."""
    height = ONE - maps.cell_cone[cell]
    x, y, z = maps.cell_direction[cell, 0], maps.cell_direction[cell, 1], maps.cell_direction[cell, 2]
    inside = ZERO
    for i in range(KEPT):
        a, b, c = x[i] - direction[0], y[i] - direction[1], z[i] - direction[2]
        inside += ONE if a * a + b * b + c * c <= TWO * height else ZERO
    return inside * (INV_TWO_PI / np.float32(KEPT)) / height
