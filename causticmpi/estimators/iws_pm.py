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
from causticmpi.kernels import vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.vec import BLACK


@inline
def _expand(scene, work, lights, count, photons, few, bound, compensation_reach, top):
    """Take the vertex on top of the stack, estimate its radiance, push the one that its compensation ray hits.

    L_d and, but for the first vertex, L_c. Returns the new top, the radiance and rays traced. A vertex has one ray: the
    stack never holds more than one.
    """
    at = fr.pop(work, top)
    radiance = BLACK
    traced = 0
    if at.depth > 0:
        light, traced = fr.gather_few(scene, work, lights, count, few, at, bound)
        most = np.float32(photons.radius)
        caustic, _ = de.estimate(scene, photons, work.forecast, at.p, at.n, at.wo, at.material, most)
        radiance = vec.mul(at.throughput, vec.add(light, caustic))
    top, light, more, _ = fr.compensate(scene, work, top - 1, at, bound, compensation_reach)
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
