"""Caustic directions from a mixture under the balance heuristic: samplers, each beside its pdf (solid angle).

  fine    cones around the directions of the photons of the nearest anchor, turned to what they are at the vertex;
  cell    the same of a few photons of the cell of a grid, beyond the reach of anchors;
  coarse  the aggregated directions of the whole cluster, a table made in the preprocess: O(1), and silent nowhere;
  brdf    `bsdf.sample`, which reaches every direction: with a share of it the estimate is unbiased whatever the
          photons are.
The paper's bins are wider than many lights look through a lens; a cone is as wide as its photon and those near by
disagree.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import HALF, INV_TWO_PI, ONE, TWO, ZERO
from causticmpi.kernels.warp import pick, turn, turns
from causticmpi.preprocess.anchors import anchor_of
from causticmpi.preprocess.cells import KEPT
from causticmpi.preprocess.directions import COLUMNS, ROWS
from causticmpi.preprocess.parallax import HEIGHT, POWER, turned_photon


class MixtureWork(NamedTuple):
    """Workspace, most of it by lane: a vertex that sends its rays.

    cluster, anchor, cell (16,): where it is, anchor and cell -1 where none steers it; total (16,): sum of the weights
    of its anchor's photons; columns (16,): cones that steer it, a multiple of 16; x, y, z, height, density (16, >= n):
    of these cones the axis, 1 - cosine of the half angle, and how dense their sampler is inside [1 / sr]; cdf
    (16, >= n): running sum of the weights of its anchor's photons; lane: rows of `mixture_rays`; codeword_distance
    (m,): search.
    """

    cluster: Any
    anchor: Any
    cell: Any
    total: Any
    columns: Any
    x: Any
    y: Any
    z: Any
    height: Any
    density: Any
    cdf: Any
    lane: Any
    codeword_distance: Any


@inline
def photons_near(maps, cluster, p, n):
    """The anchor whose photons steer at p with normal n, in a cluster; -1 for none, as outside the ranked clusters."""
    return anchor_of(maps, p, n) if maps.rank[cluster] <= maps.max_rank else np.int64(-1)


@inline
def _turn(photons, count, step, work, lane):
    """Cones of a vertex: photons (ROWS, >= count) of a place as seen a step from it."""
    x, y, z, height = work.x[lane], work.y[lane], work.z[lane], work.height[lane]
    for i in range(count):
        x[i], y[i], z[i] = turned_photon(photons, i, step)
        height[i] = photons[HEIGHT, i]


@inline
def _known(maps, work, lane):
    """How many photons of its anchor steer a lane."""
    return min(np.int64(maps.anchor_count[work.anchor[lane]]), work.columns[lane])


@inline
def weigh_anchor(scene, maps, work, lane, at, columns):
    """Turn the first `columns` photons of a lane's anchor, a multiple of 16, to its vertex, weigh them by power, BRDF
    and cosine there. Returns the sum of their weights, `total`, 0 where none counts."""
    work.columns[lane] = columns
    anchor, count = work.anchor[lane], _known(maps, work, lane)
    photons = maps.anchor_photon[anchor]
    _turn(photons, columns, vec.sub(at.p, vec.row(maps.anchor, anchor)), work, lane)
    x, y, z, weight, cdf = work.x[lane], work.y[lane], work.z[lane], work.density[lane], work.cdf[lane]
    power, height, n = photons[POWER], photons[HEIGHT], at.n
    for i in range(columns):
        weight[i] = max(ZERO, n[0] * x[i] + n[1] * y[i] + n[2] * z[i]) * power[i]
    if scene.kind[at.material] != DIFFUSE:
        for i in range(count):
            if weight[i] > ZERO:
                weight[i] *= vec.luminance(bsdf.evaluate(scene, at.material, n, at.wo, (x[i], y[i], z[i])))
    total = ZERO
    for i in range(count):
        total += weight[i]
        cdf[i] = total
    work.total[lane] = total
    share = INV_TWO_PI / total if total > ZERO else ZERO
    for i in range(columns):
        weight[i] = weight[i] * share / height[i] if height[i] > ZERO else ZERO
    return total


@inline
def turn_cell(maps, work, lane, p):
    """Turn the photons of a lane's cell, all alike, to its vertex at p."""
    cell = work.cell[lane]
    work.columns[lane] = KEPT
    _turn(maps.cell_photon[cell], KEPT, vec.sub(p, vec.row(maps.cell, cell)), work, lane)
    height, density = work.height[lane], work.density[lane]
    for i in range(KEPT):
        density[i] = INV_TWO_PI / np.float32(KEPT) / height[i]


@inline
def in_cone(axis, height, u, v):
    """Uniform direction in a cone; height: 1 - cosine of its half angle, for near 1 the cosine is too coarse in
    float32."""
    height *= u
    sine = math.sqrt(height * (TWO - height))
    c, s = turn(v)
    return vec.to_world((sine * c, sine * s, ONE - height), axis)


@inline
def anchor_cone(maps, work, lane, choice):
    """A photon of a lane's anchor chosen by weight, `total` > 0: direction, height of its cone and density in it."""
    i = pick(work.cdf[lane, : _known(maps, work, lane)], choice * work.total[lane])
    return (work.x[lane, i], work.y[lane, i], work.z[lane, i]), work.height[lane, i], work.density[lane, i]


@inline
def cell_cone(work, lane, choice):
    """One of the photons of a lane's cell: direction, height of its cone and density in it."""
    i = np.int64(choice * np.float32(KEPT))
    return (work.x[lane, i], work.y[lane, i], work.z[lane, i]), work.height[lane, i], work.density[lane, i]


@inline
def cones_pdf(work, lane, direction):
    """Density of a uniform direction in the cone that `anchor_cone` or `cell_cone` chooses."""
    x, y, z, height, inside = work.x[lane], work.y[lane], work.z[lane], work.height[lane], work.density[lane]
    density = ZERO
    for i in range(work.columns[lane]):
        a, b, c = x[i] - direction[0], y[i] - direction[1], z[i] - direction[2]
        # By the chord, 2 (1 - cosine): a comparison of cosines would lose samples of narrow cones to rounding.
        density += inside[i] if a * a + b * b + c * c <= TWO * height[i] else ZERO
    return density


@inline
def coarse_bin(direction):
    """Bin of a unit direction: azimuth and height about the world's z axis, equal solid angles."""
    column: Any = min(np.int32(COLUMNS - 1), np.int32(turns(direction[0], direction[1]) * np.float32(COLUMNS)))
    row: Any = max(np.int32(0), min(np.int32(ROWS - 1), np.int32((direction[2] + ONE) * (HALF * np.float32(ROWS)))))
    return row * np.int32(COLUMNS) + column


@inline
def in_coarse_bin(chosen, u, v):
    """Uniform direction of a bin (int32), `pick`ed from the cluster's. It may lie below the horizon."""
    row = chosen // np.int32(COLUMNS)
    z = (np.float32(row) + u) * (TWO / np.float32(ROWS)) - ONE
    c, s = turn((np.float32(chosen - row * np.int32(COLUMNS)) + v) * np.float32(1 / COLUMNS))
    r = math.sqrt(max(ZERO, ONE - z * z))
    return r * c, r * s, z


@inline
def coarse_density(maps, cluster, i):
    """Density of the directions of a cluster in bin i."""
    before = maps.coarse[cluster, i - 1] if i > 0 else ZERO
    return (maps.coarse[cluster, i] - before) * (np.float32(COLUMNS * ROWS) * HALF * INV_TWO_PI)
