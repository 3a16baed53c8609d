"""One pass of IWS+CF with mixture sampling, our rival to the paper's two tables (`forecast.sampling: mixture`).

At every non-specular vertex one set of rays serves the compensation and the caustics alike: each ray has the density of
the whole mixture (caustic_mixture), a hit on D is compensation, a hit on S a caustic. The first vertex has one BRDF
ray, one coarse, and S by the photons of its anchor or, where photons are thin, one by those of its cell; deeper ones
have one BRDF or coarse ray by chance, and DEEP_RAYS by photons. Where light tracing draws the caustics of the first
vertex, only the compensation is left of all this.
"""

import math

import numpy as np

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators import mixture_rays as rays
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.caustic_forecast import splitting
from causticmpi.estimators.vertices import get, put
from causticmpi.kernels import vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.vec import ZERO
from causticmpi.preprocess.cells import cell_of
from causticmpi.preprocess.forecast import cluster_of

DEEP_RAYS = 2
"""Rays of a deeper vertex by the photons of its anchor or cell."""
DEEP_PHOTONS = 32
"""Photons of its anchor that steer it, those of rare chains first: they come from far away in memory, and with more of
them the noise is the same."""


@inline
def _foresee_tile(maps, work):
    """Find cluster and anchor of the first vertices of a tile: lanes close to one before them share its cluster."""
    packet, near = work.packet, work.forecast
    reach2 = np.float32(0.25) * np.float32(maps.radius) * np.float32(maps.radius)
    for i in range(LANES):
        near.cluster[i] = -1
    for i in range(LANES):
        if work.lane[i, 3] == ZERO or work.lane[i, 4] > ZERO or near.cluster[i] >= 0:
            continue
        p = (packet[ws.POINT + i], packet[ws.POINT + 16 + i], packet[ws.POINT + 32 + i])
        n = (packet[ws.NORMAL + i], packet[ws.NORMAL + 16 + i], packet[ws.NORMAL + 32 + i])
        cluster = np.int64(cluster_of(maps, p, n, near.codeword_distance))
        for j in range(i, LANES):
            if work.lane[j, 3] == ZERO or work.lane[j, 4] > ZERO or near.cluster[j] >= 0:
                continue
            q = (packet[ws.POINT + j], packet[ws.POINT + 16 + j], packet[ws.POINT + 32 + j])
            m = (packet[ws.NORMAL + j], packet[ws.NORMAL + 16 + j], packet[ws.NORMAL + 32 + j])
            d = vec.sub(q, p)
            if vec.dot(d, d) <= reach2 and vec.dot(n, m) > np.float32(0.9):
                near.cluster[j] = cluster
                near.anchor[j] = cm.photons_near(maps, cluster, q, m)
                cm.ask_for_photons(maps, near.anchor[j], cm.columns_of(maps))


@inline
def _find_photons(scene, maps, near, i, at, columns):
    """The photons that steer vertex i: the first `columns` of its anchor, if one of them counts there, else those of
    its cell. Returns whether there are any."""
    if near.anchor[i] >= 0 and cm.weigh_anchor(scene, maps, near, i, at, columns):
        return True
    near.anchor[i], cell = -1, cell_of(maps, at.p, at.n)
    return cell >= 0 and cm.weigh_cell(scene, maps, near, i, cell, at)


@inline
def _send_first(scene, work, maps):
    """The rays of the first vertices of a tile whose caustics light tracing does not draw: one by BRDF, one by coarse
    directions, and S by cones around photons or, where these are thin, one by a cell."""
    near = work.forecast
    rays.begin(work)
    glossy = False
    for i in range(LANES):
        if work.lane[i, 3] == ZERO or work.lane[i, 4] > ZERO:
            continue
        at = get(work.now, i)
        steered = np.int64(_find_photons(scene, maps, near, i, at, cm.columns_of(maps)))
        if near.anchor[i] >= 0:
            steered = splitting(maps, maps.rank[near.cluster[i]], 0)
        glossy |= rays.take_up(scene, work, i, 2 + steered)
    most = rays.most_rays(work)
    for j in range(most):
        rays.draw(work, j)
        if j == 0:
            rays.by_brdf(scene, work, glossy)
        elif j == 1:
            rays.by_cluster(maps, work)
        else:
            rays.by_cones(work, j, 2)
        rays.send(scene, maps, work, j, 2, glossy)


@inline
def _send_deep(scene, work, maps, count):
    """The rays of `count` deeper vertices: one goes by BRDF or coarse directions, by the toss of a coin; DEEP_RAYS more
    by photons, if there are any."""
    near = work.forecast
    columns = min(DEEP_PHOTONS, cm.columns_of(maps))
    rays.begin(work)
    glossy = False
    for i in range(count):
        at = get(work.now, i)
        near.cluster[i] = cluster_of(maps, at.p, at.n, near.codeword_distance)
        near.anchor[i] = cm.photons_near(maps, near.cluster[i], at.p, at.n)
        cm.ask_for_photons(maps, near.anchor[i], columns)
    for i in range(count):
        at = get(work.now, i)
        steered = DEEP_RAYS if _find_photons(scene, maps, near, i, at, columns) else 0
        glossy |= rays.take_up(scene, work, i, 1 + steered)
    most = rays.most_rays(work)
    for j in range(most):
        rays.draw(work, j)
        if j == 0:
            rays.toss(work)
            rays.by_brdf(scene, work, glossy)
            rays.by_coin(maps, work)
        else:
            rays.by_cones(work, j, 1)
        rays.send(scene, maps, work, j, 1, glossy)


@kernel
def trace_iws_mixture(
    scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, most_peak, splats, sides, film
):
    """One sample of L_d and L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps with at least one codeword; bound: b [units^-2];
    most_peak: largest `bsdf.peak` of the scene; splats: light tracing draws what it owns; sides: see `see_tile`. Adds
    to `film`. Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    for first in range(0, pixels.shape[0], LANES):
        used, seen = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, splats, sides)
        traced += seen
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            drawn = 0
            for i in range(LANES):
                if work.lane[i, 3] > ZERO:
                    put(work.now, i, fr.first_vertex(work, i))
                    drawn += work.lane[i, 4] > ZERO
            if drawn < used:
                _foresee_tile(maps, work)
                _send_first(scene, work, maps)
            for i in range(LANES):
                if work.lane[i, 3] > ZERO and work.lane[i, 4] > ZERO:
                    fr.compensate(scene, work, i, get(work.now, i), compensation_reach)
        waiting, sent = 0, used
        while sent > 0:
            waiting, sent, queries, missing = fr.trace(scene, work, waiting, bound)
            traced += queries
            lost += missing
            for i in range(sent):
                traced += fr.gather_few(scene, work, lights, count, few, get(work.now, i), bound)
            if sent > 0:
                _send_deep(scene, work, maps, sent)
        fr.deposit(work, pixels, first, film)
    return traced, lost
