"""One pass of IWS+CF with mixture sampling, our rival to the paper's two tables (`forecast.sampling: mixture`).

At every non-specular vertex one set of rays serves the compensation and the caustics alike: each ray has the density of
the whole mixture (caustic_mixture), a hit on D is compensation, a hit on S a caustic. The first vertex has S fine, one
coarse and one BRDF ray; deeper vertices have one ray, coarse or BRDF by the toss of a coin, so paths do not branch
there.
Photons are gathered once for the vertices of a tile that lie close together: a forecast is only a pdf.
"""

import numpy as np

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.caustic_forecast import splitting
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES, intersect
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.vec import BLACK, HALF, INFINITY, ONE, TWO, ZERO
from causticmpi.preprocess.forecast import cluster_of

ALMOST_ONE = np.float32(0.99999994)


@inline
def _gather_for_tile(maps, work):
    """Gather photons for the first vertices of a tile: lanes close to a lane served before share its photons."""
    packet, near = work.packet, work.forecast
    reach2 = np.float32(0.25) * np.float32(maps.radius) * np.float32(maps.radius)
    groups = 0
    for i in range(LANES):
        near.group[i] = -1
    for i in range(LANES):
        if work.lane[i, 3] == ZERO or near.group[i] >= 0:
            continue
        p = (packet[ws.POINT + i], packet[ws.POINT + 16 + i], packet[ws.POINT + 32 + i])
        n = (packet[ws.NORMAL + i], packet[ws.NORMAL + 16 + i], packet[ws.NORMAL + 32 + i])
        cm.gather_group(maps, near, groups, p, n)
        for j in range(i, LANES):
            if work.lane[j, 3] == ZERO or near.group[j] >= 0:
                continue
            q = (packet[ws.POINT + j], packet[ws.POINT + 16 + j], packet[ws.POINT + 32 + j])
            m = (packet[ws.NORMAL + j], packet[ws.NORMAL + 16 + j], packet[ws.NORMAL + 32 + j])
            d = vec.sub(q, p)
            if vec.dot(d, d) <= reach2 and vec.dot(n, m) > np.float32(0.9):
                near.group[j] = groups
        groups += 1


@inline
def _expand(scene, work, lights, count, maps, few, bound, top, lane):
    """Take the vertex on top of the stack, estimate its radiance, push the vertices that carry light to it.

    Returns the new top, the layer of the vertex, what it adds to that layer and what to L_c; rays traced, and vertices
    lost to a full stack.
    """
    p, offset, n, wo, throughput, material, depth, layer, key = fr.pop(work, top)
    top -= 1
    own, caustic = BLACK, BLACK
    traced, lost = 0, 0
    near = work.forecast
    if depth == 0:
        group = near.group[lane]
        cluster = near.cluster[group]
        fine_total = cm.weigh_fine(scene, near, group, n, wo, material)
        fine = splitting(maps, maps.rank[cluster], 0) if fine_total > ZERO else 0
        rays, share = fine + 2, ONE
    else:
        start, _ = rng.uniform2(key, fr.FEW)
        light, shadows = ws.gather_few(scene, work.packet, lights, count, few, p, n, offset, wo, material, bound, start)
        own = vec.mul(throughput, light)
        traced += shadows
        group = np.int64(0)
        cluster = np.int64(cluster_of(maps, p, n, near.codeword_distance))
        fine_total, fine = ZERO, 0
        rays, share = 1, HALF
    for j in range(rays):
        ray_key = rng.subkey(key, fr.SAMPLE + j)
        choice, survive = rng.uniform2(ray_key, fr.CHOICE)
        u, v = rng.uniform2(ray_key, fr.DIRECTION)
        coarse = j == 1
        if depth > 0:
            coarse = choice < HALF
            choice = min(ALMOST_ONE, (choice if coarse else choice - HALF) * TWO)
        if coarse:
            direction = cm.sample_coarse(maps, cluster, choice, u, v)
        elif j == 0:
            direction = bsdf.sample(scene, material, n, wo, choice, u, v)
        else:
            direction = cm.sample_fine(near, group, fine_total, choice, u, v)
        cosine = vec.dot(n, direction)
        if cosine <= ZERO:
            continue
        # Balance heuristic: the sum of what all samplers would do, times how often each is asked [Veach 1997, (9.8)].
        density = share * (bsdf.pdf(scene, material, n, wo, direction) + cm.coarse_pdf(maps, cluster, direction))
        if fine > 0:
            density += np.float32(fine) * cm.fine_pdf(near, group, fine_total, direction)
        weight = vec.scale(bsdf.evaluate(scene, material, n, wo, direction), cosine / density)
        weight = vec.mul(throughput, weight)
        if vec.max3(weight) <= ZERO:
            continue
        primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, p, direction, INFINITY)
        traced += 1
        if primitive < 0:
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
    return top, layer, own, caustic, traced, lost


@kernel
def trace_iws_mixture(scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, film):
    """One sample of L_d and L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps with at least one codeword; bound: b [units^-2]. Adds
    to `film`. Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            _gather_for_tile(maps, work)
        for i in range(LANES):
            if pixels[first + i, 0] < 0:
                continue
            diffusive, caustic = vec.row(work.le, i), BLACK
            top = fr.push_lane(work, i)
            while top > 0:
                top, layer, own, extra, rays, missing = _expand(scene, work, lights, count, maps, few, bound, top, i)
                traced += rays
                lost += missing
                caustic = vec.add(caustic, extra)
                if layer == fr.DIFFUSIVE:
                    diffusive = vec.add(diffusive, own)
                else:
                    caustic = vec.add(caustic, own)
            add_sample(film, pixels[first + i, 3], diffusive, caustic)
    return traced, lost
