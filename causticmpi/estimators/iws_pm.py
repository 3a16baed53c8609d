"""One pass of IWS+PM, the paper's rival: L_d by weak singularities, L_c by a photon map, biased [CF sec. 3.1].

At every non-specular vertex p of an eye path:
  A  L_d: the virtual lights, all of them at the first vertex, an unbiased few at deeper ones;
  B  L_d: one BRDF ray, the compensation; what it hits on D counts with 1 - w and carries its full radiance, L_c from
     the photon map included. What it hits on S counts nothing: it is C's;
  C  L_c: the density estimate (density_estimate).
A is unbiased and so is B, but for the L_c it brings home; C is not, whatever the number of passes.
"""

import math

import numpy as np

from causticmpi.estimators import density_estimate as de
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators import weak_singularities as ws
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES, intersect
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import BLACK, ZERO


@inline
def _expand(scene, work, lights, count, photons, few, bound, compensation_reach, top):
    """Take the vertex on top of the stack, estimate its radiance, push the one that its compensation ray hits.

    L_d and, but for the first vertex, L_c. Returns the new top, the radiance and rays traced. A vertex has one ray: the
    stack never holds more than one.
    """
    p, offset, n, wo, throughput, material, depth, layer, key = fr.pop(work, top)
    top -= 1
    radiance = BLACK
    traced = 0
    if depth > 0:
        start, _ = rng.uniform2(key, fr.FEW)
        light, traced = ws.gather_few(scene, work.packet, lights, count, few, p, n, offset, wo, material, bound, start)
        most = np.float32(photons.radius)
        caustic, _ = de.estimate(scene, photons, work.forecast, p, n, wo, material, most)
        radiance = vec.mul(throughput, vec.add(light, caustic))
    ray_key = rng.subkey(key, fr.SAMPLE)
    choice, survive = rng.uniform2(ray_key, fr.CHOICE)
    u, v = rng.uniform2(ray_key, fr.DIRECTION)
    direction, weight = bsdf.sample_weight(scene, material, n, wo, choice, u, v)
    weight = vec.mul(throughput, weight)
    cosine = vec.dot(n, direction)
    if cosine <= ZERO or vec.max3(weight) <= ZERO:
        return top, radiance, traced
    # Beyond this distance G s <= b for any surface: nothing to compensate.
    reach = math.sqrt(cosine * ws.sharpness(bsdf.evaluate(scene, material, n, wo, direction))) * compensation_reach
    primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, p, direction, reach)
    traced += 1
    if primitive < 0 or is_specular(scene.kind[scene.material[primitive]]):
        return top, radiance, traced
    top, _, light, more, _ = fr.land(
        scene, work, top, p, n, wo, material, depth, layer, direction, weight, primitive, t, bound, survive, ray_key
    )
    return top, vec.add(radiance, light), traced + more


@kernel
def trace_iws_pm(scene, camera, work, pixels, seed, pass_index, lights, count, photons, few, bound, most_peak, film):
    """One sample of L_d and the density estimate of L_c for every row of `pixels` (n, 4), n a multiple of 16.

    work: around a `density_work`; lights, count: virtual lights of the pass; bound: b [units^-2]; most_peak: largest
    `bsdf.peak` of the scene. Adds to `film`. Returns rays traced.
    """
    traced = 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, False)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            de.estimate_tile(scene, photons, work.forecast, work.packet, work.lane, work.lane_material)
        for i in range(LANES):
            if pixels[first + i, 0] < 0:
                continue
            diffusive, caustic = vec.row(work.le, i), BLACK
            top = fr.push_lane(work, i)
            if top > 0:
                caustic = vec.mul(vec.row(work.lane, i), vec.row(work.forecast.radiance, i))
            while top > 0:
                top, radiance, rays = _expand(scene, work, lights, count, photons, few, bound, compensation_reach, top)
                traced += rays
                diffusive = vec.add(diffusive, radiance)
            add_sample(film, pixels[first + i, 3], diffusive, caustic)
    return traced
