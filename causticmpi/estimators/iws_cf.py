"""One pass of IWS+CF as in the paper: caustic directions from tables, two of them or one of their rivals.

At every non-specular vertex p of an eye path:
  A  L_d: the virtual lights, all of them at the first vertex, an unbiased few at deeper ones;
  B  L_d: one BRDF ray, the compensation; what it hits on D counts with 1 - w and carries its full radiance;
  C  L_c: S directions from each sampler of the forecast (caustic_forecast); what they hit on S leads to a D vertex
     that carries its full radiance.
Outside the ranked clusters one BRDF ray serves B and C: a hit on D is B's, a hit on S is C's.
Vertices that carry their full radiance are treated alike, one diffuse depth deeper, so there is no depth cut-off;
roulette ends the paths.
"""

import math

import numpy as np

from causticmpi.estimators import caustic_forecast as cf
from causticmpi.estimators import directional_tables as dt
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators.vertices import get, put
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.vec import INFINITY, ONE, ZERO
from causticmpi.preprocess.forecast import cluster_of


@inline
def _send_rays(scene, work, maps, compensation_reach, caustics, i):
    """The rays of vertex i, for B and C."""
    at = get(work.now, i)
    samples, cluster = 0, 0
    if caustics and maps.codebook.shape[1] > 0:
        cluster = cluster_of(maps, at.p, at.n, work.forecast.codeword_distance)
        samples = cf.splitting(maps, maps.rank[cluster], at.depth)
    if samples == 0 and (caustics or at.depth > 0):
        _send_one_for_both(scene, work, i, at)
    else:
        fr.compensate(scene, work, i, at, compensation_reach)
    if samples > 0:
        _forecast(scene, work, maps, cluster, samples, i, at)


@inline
def _send_one_for_both(scene, work, i, at):
    """B and C by one BRDF ray."""
    key = rng.subkey(at.key, fr.SAMPLE)
    choice, survive = rng.uniform2(key, fr.CHOICE)
    u, v = rng.uniform2(key, fr.DIRECTION)
    direction, weight = bsdf.sample_weight(scene, at.material, at.n, at.wo, choice, u, v)
    if vec.dot(at.n, direction) > ZERO:
        fr.send(work, i, 0, direction, vec.mul(at.throughput, weight), INFINITY, survive, key, fr.ANYTHING)


@inline
def _forecast(scene, work, maps, cluster, samples, i, at):
    """C: S = samples directions from each sampler of the forecast; what they hit on D counts nothing, for it is B's."""
    share = ONE / np.float32(samples)
    near = work.forecast
    k = cf.gather(maps, near, cluster, at.p)
    occupied, total1, other = cf.prepare(scene, maps, near, k, at.n, at.wo, at.material)
    for j in range(cf.parts(near) * samples):
        key = rng.subkey(at.key, fr.SAMPLE + 1 + j)
        choice, survive = rng.uniform2(key, fr.CHOICE)
        u, v = rng.uniform2(key, fr.DIRECTION)
        direction, density = cf.draw(
            scene, maps, near, j // samples, occupied, total1, other, at.n, at.wo, at.material, choice, u, v
        )
        if density <= ZERO:
            continue
        f = bsdf.evaluate(scene, at.material, at.n, at.wo, direction)
        weight = vec.scale(f, max(ZERO, vec.dot(at.n, direction)) * share / density)
        fr.send(work, i, 1 + j, direction, vec.mul(at.throughput, weight), INFINITY, survive, key, fr.ON_SPECULAR)
    dt.clear_tables(near, occupied)


@kernel
def trace_iws_cf(
    scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, most_peak, caustics, sides, film
):
    """One sample of L_d and, with `caustics`, of L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps, without codewords where there is no forecast;
    bound: b [units^-2]; most_peak: largest `bsdf.peak` of the scene; sides: see `see_tile`. Adds to `film`.
    Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, False, sides)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            for i in range(LANES):
                if work.lane[i, 3] > ZERO:
                    put(work.now, i, fr.first_vertex(work, i))
                    _send_rays(scene, work, maps, compensation_reach, caustics, i)
        waiting, sent = 0, used
        while sent > 0:
            waiting, sent, rays, missing = fr.trace(scene, work, waiting, bound)
            traced += rays
            lost += missing
            for i in range(sent):
                traced += fr.gather_few(scene, work, lights, count, few, get(work.now, i), bound)
                _send_rays(scene, work, maps, compensation_reach, caustics, i)
        fr.deposit(work, pixels, first, film)
    return traced, lost
