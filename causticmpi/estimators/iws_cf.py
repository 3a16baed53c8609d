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
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES, intersect
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import BLACK, INFINITY, ONE, ZERO
from causticmpi.preprocess.forecast import cluster_of


@inline
def _expand(scene, work, lights, count, maps, few, bound, compensation_reach, caustics, top):
    """Take the vertex on top of the stack, estimate its radiance, push the vertices that carry light to it.

    Returns the new top, the layer of the vertex, what it adds to that layer and what to L_c; rays traced, and vertices
    lost to a full stack.
    """
    at = fr.pop(work, top)
    top -= 1
    own, caustic = BLACK, BLACK
    traced, samples, cluster = 0, 0, 0
    if at.depth > 0:
        light, traced = fr.gather_few(scene, work, lights, count, few, at, bound)
        own = vec.mul(at.throughput, light)
    if caustics and maps.codebook.shape[1] > 0:
        cluster = cluster_of(maps, at.p, at.n, work.forecast.codeword_distance)
        samples = cf.splitting(maps, maps.rank[cluster], at.depth)
    if samples == 0 and (caustics or at.depth > 0):
        top, hit_layer, light, more, lost = _send_one_for_both(scene, work, top, at, bound)
    else:
        hit_layer = at.layer
        top, light, more, lost = fr.compensate(scene, work, top, at, bound, compensation_reach)
    traced += more
    if hit_layer == at.layer:
        own = vec.add(own, light)
    else:
        caustic = light
    if samples > 0:
        top, own, caustic, more, missing = _forecast(scene, work, maps, cluster, samples, bound, top, at, own, caustic)
        traced += more
        lost += missing
    return top, at.layer, own, caustic, traced, lost


@inline
def _send_one_for_both(scene, work, top, at, bound):
    """B and C by one BRDF ray. Returns as `full_radiance.land`."""
    key = rng.subkey(at.key, fr.SAMPLE)
    choice, survive = rng.uniform2(key, fr.CHOICE)
    u, v = rng.uniform2(key, fr.DIRECTION)
    direction, weight = bsdf.sample_weight(scene, at.material, at.n, at.wo, choice, u, v)
    weight = vec.mul(at.throughput, weight)
    if vec.dot(at.n, direction) <= ZERO or vec.max3(weight) <= ZERO:
        return top, at.layer, BLACK, 0, 0
    primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, at.p, direction, INFINITY)
    if primitive < 0:
        return top, at.layer, BLACK, 1, 0
    top, layer, light, traced, lost = fr.land(
        scene, work, top, at, direction, weight, primitive, t, bound, survive, key
    )
    return top, layer, light, 1 + traced, lost


@inline
def _forecast(scene, work, maps, cluster, samples, bound, top, at, own, caustic):
    """C: S = samples directions from each sampler of the forecast; what they hit on D counts nothing, for it is B's.

    own, caustic: light of the vertex so far, in its own layer and in L_c. Returns the new top, both with what is added;
    rays traced, and vertices lost to a full stack.
    """
    traced, lost = 0, 0
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
        weight = vec.mul(at.throughput, weight)
        if vec.max3(weight) <= ZERO:
            continue
        primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, at.p, direction, INFINITY)
        traced += 1
        if primitive < 0 or not is_specular(scene.kind[scene.material[primitive]]):
            continue
        top, hit_layer, light, more, missing = fr.land(
            scene, work, top, at, direction, weight, primitive, t, bound, survive, key
        )
        traced += more
        lost += missing
        if hit_layer == at.layer:
            own = vec.add(own, light)
        else:
            caustic = vec.add(caustic, light)
    dt.clear_tables(near, occupied)
    return top, own, caustic, traced, lost


@kernel
def trace_iws_cf(
    scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, most_peak, caustics, film
):
    """One sample of L_d and, with `caustics`, of L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps, without codewords where there is no forecast;
    bound: b [units^-2]; most_peak: largest `bsdf.peak` of the scene. Adds to `film`.
    Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, False)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
        for i in range(LANES):
            if pixels[first + i, 0] < 0:
                continue
            diffusive, caustic = vec.row(work.le, i), BLACK
            top = fr.push_lane(work, i)
            while top > 0:
                top, layer, own, extra, rays, missing = _expand(
                    scene, work, lights, count, maps, few, bound, compensation_reach, caustics, top
                )
                traced += rays
                lost += missing
                caustic = vec.add(caustic, extra)
                if layer == fr.DIFFUSIVE:
                    diffusive = vec.add(diffusive, own)
                else:
                    caustic = vec.add(caustic, own)
            add_sample(film, pixels[first + i, 3], diffusive, caustic)
    return traced, lost
