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
from causticmpi.estimators import weak_singularities as ws
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
    p, offset, n, wo, throughput, material, depth, layer, key = fr.pop(work, top)
    top -= 1
    own, caustic = BLACK, BLACK
    traced, lost = 0, 0
    if depth > 0:
        start, _ = rng.uniform2(key, fr.FEW)
        light, shadows = ws.gather_few(scene, work.packet, lights, count, few, p, n, offset, wo, material, bound, start)
        own = vec.mul(throughput, light)
        traced += shadows
    samples, occupied = 0, 0
    total1, other = ZERO, ZERO
    if maps.codebook.shape[1] > 0 and caustics:
        cluster = cluster_of(maps, p, n, work.forecast.codeword_distance)
        samples = cf.splitting(maps, maps.rank[cluster], depth)
        if samples > 0:
            k = cf.gather(maps, work.forecast, cluster, p)
            occupied, total1, other = cf.prepare(scene, maps, work.forecast, k, n, wo, material)
    steered = samples > 0
    share = ONE / np.float32(max(samples, 1))
    for j in range(1 + cf.parts(work.forecast) * samples):
        ray_key = rng.subkey(key, fr.SAMPLE + j)
        reach = INFINITY
        choice, survive = rng.uniform2(ray_key, fr.CHOICE)
        u, v = rng.uniform2(ray_key, fr.DIRECTION)
        if j == 0:
            direction, weight = bsdf.sample_weight(scene, material, n, wo, choice, u, v)
            cosine = vec.dot(n, direction)
            if cosine <= ZERO:
                continue
            if steered:  # the ray is the compensation alone: beyond this distance G s <= b for any surface
                f = bsdf.evaluate(scene, material, n, wo, direction)
                reach = math.sqrt(cosine * ws.sharpness(f)) * compensation_reach
        else:
            direction, density = cf.draw(
                scene,
                maps,
                work.forecast,
                (j - 1) // samples,
                occupied,
                total1,
                other,
                n,
                wo,
                material,
                choice,
                u,
                v,
            )
            if density <= ZERO:
                continue
            f = bsdf.evaluate(scene, material, n, wo, direction)
            weight = vec.scale(f, max(ZERO, vec.dot(n, direction)) * share / density)
        weight = vec.mul(throughput, weight)
        if vec.max3(weight) <= ZERO:
            continue
        primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, p, direction, reach)
        traced += 1
        if primitive < 0:
            continue
        on_specular = is_specular(scene.kind[scene.material[primitive]])
        if on_specular:
            if (j == 0 and steered) or not (caustics or depth > 0):
                continue
        elif j > 0:
            continue
        top, hit_layer, light, more, missing = fr.land(
            scene, work, top, p, n, wo, material, depth, layer, direction, weight, primitive, t, bound, survive, ray_key
        )
        traced += more
        lost += missing
        if hit_layer == layer:
            own = vec.add(own, light)
        else:
            caustic = vec.add(caustic, light)
    dt.clear_tables(work.forecast, occupied)
    return top, layer, own, caustic, traced, lost


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
