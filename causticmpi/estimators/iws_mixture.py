"""One pass of IWS+CF with mixture sampling, our rival to the paper's two tables (`forecast.sampling: mixture`).

At every non-specular vertex one set of rays serves the compensation and the caustics alike: each ray has the density of
the whole mixture (caustic_mixture), a hit on D is compensation, a hit on S a caustic. The first vertex has S fine rays
or, where photons are thin, one from its cell, one coarse and one BRDF ray; deeper vertices have one coarse or
BRDF ray by chance and DEEP_RAYS from their cell. Where light tracing draws the caustics of the first
vertex, only the compensation is left of all this.
The photons of the nearest anchor steer a vertex (preprocess.anchors): a forecast is only a pdf.
"""

import math

import numpy as np

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.caustic_forecast import splitting
from causticmpi.estimators.vertices import get, put
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.vec import ALMOST_ONE, HALF, INFINITY, TWO, ZERO
from causticmpi.preprocess.cells import cell_of
from causticmpi.preprocess.forecast import cluster_of

DEEP_RAYS = 2
"""Rays of a deeper vertex by the directions of its cell."""


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
                near.anchor[j] = cm.photons_near(maps, cluster, q)


@inline
def _send(scene, work, i, j, at, direction, density, survive, key):
    """Ray j of vertex i by a mixture whose samplers, times how often each is asked, have this density in sum: the
    balance heuristic [Veach 1997, (9.8)]."""
    f = bsdf.evaluate(scene, at.material, at.n, at.wo, direction)
    weight = vec.mul(at.throughput, vec.scale(f, vec.dot(at.n, direction) / density))
    fr.send(work, i, j, direction, weight, INFINITY, survive, key, fr.ANYTHING)


@inline
def _send_deep(scene, work, maps, i):
    """The rays of deeper vertex i: one goes by BRDF or coarse directions, by the toss of a coin; DEEP_RAYS more by
    those of its cell, if there is one."""
    at = get(work.now, i)
    cluster = np.int64(cluster_of(maps, at.p, at.n, work.forecast.codeword_distance))
    cell = cell_of(maps, at.p, at.n)
    steered = DEEP_RAYS if cell >= 0 else 0
    for j in range(1 + steered):
        ray_key = rng.subkey(at.key, fr.SAMPLE + j)
        choice, survive = rng.uniform2(ray_key, fr.CHOICE)
        u, v = rng.uniform2(ray_key, fr.DIRECTION)
        if j > 0:
            direction = cm.sample_cell(maps, cell, choice, u, v)
        elif choice < HALF:
            direction = bsdf.sample(scene, at.material, at.n, at.wo, TWO * choice, u, v)
        else:
            direction = cm.sample_coarse(maps, cluster, min(ALMOST_ONE, TWO * (choice - HALF)), u, v)
        if vec.dot(at.n, direction) <= ZERO:
            continue
        brdf = bsdf.pdf(scene, at.material, at.n, at.wo, direction)
        density = HALF * (brdf + cm.coarse_pdf(maps, cluster, direction))
        if steered > 0:
            density += np.float32(steered) * cm.cell_pdf(maps, cell, direction)
        _send(scene, work, i, j, at, direction, density, survive, ray_key)


@inline
def _send_first(scene, work, maps, i):
    """The rays of first vertex i."""
    at = get(work.now, i)
    near = work.forecast
    cluster, anchor = near.cluster[i], near.anchor[i]
    fine_total = cm.weigh_fine(scene, maps, near, anchor, at.n, at.wo, at.material) if anchor >= 0 else ZERO
    fine = splitting(maps, maps.rank[cluster], 0) if fine_total > ZERO else 0
    cell = cell_of(maps, at.p, at.n) if fine == 0 else np.int64(-1)
    steered = fine if fine > 0 else np.int64(cell >= 0)
    for j in range(steered + 2):
        ray_key = rng.subkey(at.key, fr.SAMPLE + j)
        choice, survive = rng.uniform2(ray_key, fr.CHOICE)
        u, v = rng.uniform2(ray_key, fr.DIRECTION)
        if j == 0:
            direction = bsdf.sample(scene, at.material, at.n, at.wo, choice, u, v)
        elif j == 1:
            direction = cm.sample_coarse(maps, cluster, choice, u, v)
        elif fine > 0:
            stratum = (np.float32(j - 2) + choice) / np.float32(fine)
            direction = cm.sample_fine(maps, near, cluster, anchor, fine_total, min(ALMOST_ONE, stratum), u, v)
        else:
            direction = cm.sample_cell(maps, cell, choice, u, v)
        if vec.dot(at.n, direction) <= ZERO:
            continue
        brdf = bsdf.pdf(scene, at.material, at.n, at.wo, direction)
        density = brdf + cm.coarse_pdf(maps, cluster, direction)
        if fine > 0:
            density += np.float32(fine) * cm.fine_pdf(maps, near, cluster, anchor, fine_total, direction)
        elif cell >= 0:
            density += cm.cell_pdf(maps, cell, direction)
        _send(scene, work, i, j, at, direction, density, survive, ray_key)


@kernel
def trace_iws_mixture(
    scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, most_peak, splats, lamps, film
):
    """One sample of L_d and L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps with at least one codeword; bound: b [units^-2];
    most_peak: largest `bsdf.peak` of the scene; splats: light tracing draws what it owns; lamps: see `see_tile`. Adds
    to `film`. Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, splats, lamps)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            _foresee_tile(maps, work)
            for i in range(LANES):
                if work.lane[i, 3] == ZERO:
                    continue
                put(work.now, i, fr.first_vertex(work, i))
                if work.lane[i, 4] > ZERO:
                    fr.compensate(scene, work, i, get(work.now, i), compensation_reach)
                else:
                    _send_first(scene, work, maps, i)
        waiting, sent = 0, used
        while sent > 0:
            waiting, sent, rays, missing = fr.trace(scene, work, waiting, bound)
            traced += rays
            lost += missing
            for i in range(sent):
                traced += fr.gather_few(scene, work, lights, count, few, get(work.now, i), bound)
                _send_deep(scene, work, maps, i)
        fr.deposit(work, pixels, first, film)
    return traced, lost
