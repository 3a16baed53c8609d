"""Caustic directions from a mixture under the balance heuristic: samplers, each beside its pdf (solid angle).

  fine    cones around the directions of the photons of the nearest anchor, turned to what they are at the vertex;
  cell    the same of a few photons of the cell of a grid, beyond the reach of anchors;
  coarse  the aggregated directions of the whole cluster, a table made in the preprocess: O(1), and silent nowhere;
  brdf    `bsdf.sample`, which reaches every direction: with a share of it the estimate is unbiased whatever the
          photons are.
The paper's bins are wider than many lights look through a lens; a cone is as wide as its photon and those near by
disagree, and has no rim: chance alone would find what lies beyond.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import HALF, INV_TWO_PI, ONE, TWO, ZERO
from causticmpi.kernels.warp import pick, turn, turns
from causticmpi.preprocess.anchors import anchor_of
from causticmpi.preprocess.cells import KEPT
from causticmpi.preprocess.directions import COLUMNS, ROWS
from causticmpi.preprocess.packed_photons import BLOCK, ask_for, height_of, place_of, power_of, turned_packed
from causticmpi.preprocess.parallax import ROWS as PHOTON_ROWS

X, Y, Z, HEIGHT, WEIGHT, STRENGTH, CONES = (LANES * row for row in range(7))
"""Rows of 16 cones as word offsets in `MixtureWork.cone`, where blocks of CONES words follow each other as those of
packed photons do."""


class MixtureWork(NamedTuple):
    """Workspace, most of it by lane: a vertex that sends its rays.

    cluster, anchor (16,): where it is, anchor -1 where none steers it; count, columns, total (16,):
    photons that steer it, with those without power behind them a multiple of 16, and the sum of their weights; cone
    (16, CONES * blocks): of these cones the axis, 1 - cosine of the half angle, weight, and how strong they are in the
    density, times share (16,) [1 / sr]; cdf (16, >= n): running sum of these weights; lane: rows of `mixture_rays`;
    codeword_distance (m,): search.
    """

    cluster: Any
    anchor: Any
    count: Any
    columns: Any
    total: Any
    share: Any
    cone: Any
    cdf: Any
    lane: Any
    codeword_distance: Any


@inline
def photons_near(maps, cluster, p, n):
    """The anchor whose photons steer at p with normal n, in a cluster; -1 for none, as outside the ranked clusters."""
    return anchor_of(maps, p, n) if maps.rank[cluster] <= maps.max_rank else np.int64(-1)


@inline
def ask_for_photons(maps, anchor, columns):
    """Have the first `columns` photons of an anchor, -1 for none, brought near, to be weighed later."""
    if anchor >= 0:
        ask_for(maps.anchor_photon, anchor, columns)


@inline
def columns_of(maps):
    """Photons that every anchor has room for, a multiple of 16."""
    return maps.anchor_photon.shape[1] // PHOTON_ROWS


@inline
def _turn(photons, columns, step, n, cone):
    """Cones of a vertex with normal n: `columns` packed photons of a place, a multiple of 16, as seen a step from it,
    weighed by power and cosine."""
    for block in range(columns // LANES):
        first, own = BLOCK * block, CONES * block
        for i in range(LANES):  # all in one: loops as short as its parts are unrolled, and are not vector code then
            x, y, z = turned_packed(photons, first + i, step)
            height = height_of(photons, first + i)
            # Photons that are none have no direction but NaN: of it and ZERO, in this order, `max` takes ZERO.
            weight = max(ZERO, n[0] * x + n[1] * y + n[2] * z) * power_of(photons, first + i)
            cone[own + X + i], cone[own + Y + i], cone[own + Z + i] = x, y, z
            cone[own + HEIGHT + i], cone[own + WEIGHT + i] = height, weight
            cone[own + STRENGTH + i] = weight * height * (ONE + HALF * height)


@inline
def _axis(cone, at):
    return cone[at + X], cone[at + Y], cone[at + Z]


@inline
def _weigh(scene, photons, count, columns, step, at, work, lane):
    """The first `count` of `columns` photons of a place, a multiple of 16, steer a lane: turned to its vertex, a step
    from there, weighed by power, BRDF and cosine. Returns whether one of them counts."""
    cone, cdf = work.cone[lane], work.cdf[lane]
    _turn(photons, columns, step, at.n, cone)
    if scene.kind[at.material] != DIFFUSE:
        for i in range(count):
            own = place_of(i, CONES)
            if cone[own + WEIGHT] > ZERO:
                f = vec.luminance(bsdf.evaluate(scene, at.material, at.n, at.wo, _axis(cone, own)))
                cone[own + WEIGHT] *= f
                cone[own + STRENGTH] *= f
    total = ZERO
    for i in range(count):
        total += cone[place_of(i, CONES) + WEIGHT]
        cdf[i] = total
    work.count[lane], work.columns[lane], work.total[lane] = count, columns, total
    work.share[lane] = INV_TWO_PI / total if total > ZERO else ZERO
    return total > ZERO


@inline
def weigh_anchor(scene, maps, work, lane, at, columns):
    """The first `columns` photons of a lane's anchor, a multiple of 16, steer it. Returns whether one counts there."""
    anchor = work.anchor[lane]
    count = min(np.int64(maps.anchor_count[anchor]), columns)
    step = vec.sub(at.p, vec.row(maps.anchor, anchor))
    return _weigh(scene, maps.anchor_photon[anchor], count, columns, step, at, work, lane)


@inline
def weigh_cell(scene, maps, work, lane, cell, at):
    """The photons of a cell steer a lane. Returns whether one counts there."""
    step = vec.sub(at.p, vec.row(maps.cell, cell))
    return _weigh(scene, maps.cell_photon[cell], KEPT, KEPT, step, at, work, lane)


@inline
def in_cone(axis, height, u, v):
    """Direction around a cone: half of them or a little more lie inside, the others ever thinner farther out. height:
    1 - cosine of its half angle, for near 1 the cosine is too coarse in float32.

    Its density falls with t, 1 - cosine of the way from the axis, as (height + t)^-2: Student's t, of two degrees of
    freedom, over the plane. Where the photons err, their light is met by chance no more seldom than they err.
    """
    u *= TWO / (TWO + height)
    height = min(TWO, height * u / (ONE - u))
    sine = math.sqrt(height * (TWO - height))
    c, s = turn(v)
    return vec.to_world((sine * c, sine * s, ONE - height), axis)


@inline
def choose_cone(work, lane, choice):
    """A photon that steers a lane, chosen by weight, `total` > 0: direction and height of its cone."""
    i = pick(work.cdf[lane, : work.count[lane]], choice * work.total[lane])
    cone, at = work.cone[lane], place_of(i, CONES)
    return _axis(cone, at), cone[at + HEIGHT]


@inline
def cones_pdf(work, lane, direction):
    """Density of the direction `in_cone` of the cone that `choose_cone` chooses."""
    cone, density = work.cone[lane], ZERO
    for block in range(work.columns[lane] // LANES):
        own = CONES * block
        for i in range(LANES):
            a, b, c = vec.sub(_axis(cone, own + i), direction)
            # By the chord, of squared length 2 t: the difference of a cosine to 1 is all rounding for narrow cones.
            reach = cone[own + HEIGHT + i] + HALF * (a * a + b * b + c * c)
            strength = cone[own + STRENGTH + i]
            density += strength / (reach * reach) if strength > ZERO else ZERO  # photons that are none have no axis
    return density * work.share[lane]


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
