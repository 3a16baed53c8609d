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
from causticmpi.estimators.vertices import get, put
from causticmpi.kernels import vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.vec import ZERO


@kernel
def trace_iws_pm(
    scene, camera, work, pixels, seed, pass_index, lights, count, photons, few, bound, most_peak, sides, film
):
    """One sample of L_d and the density estimate of L_c for every row of `pixels` (n, 4), n a multiple of 16.

    work: around a `density_work`; lights, count: virtual lights of the pass; bound: b [units^-2]; most_peak: largest
    `bsdf.peak` of the scene; sides: see `see_tile`. Adds to `film`. Returns as `trace_iws_cf`.
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    most = np.float32(photons.radius)
    for first in range(0, pixels.shape[0], LANES):
        used, rays = fr.see_tile(scene, camera, work, pixels, first, seed, pass_index, False, sides)
        traced += rays
        if used > 0:
            traced += fr.gather_lights(scene, work, lights, count, bound)
            de.estimate_tile(scene, photons, work.forecast, work.packet, work.lane, work.lane_material)
            for i in range(LANES):
                if work.lane[i, 3] == ZERO:
                    continue
                caustic = vec.mul(vec.row(work.lane, i), vec.row(work.forecast.radiance, i))
                fr.add_light(work, i, fr.CAUSTIC, caustic)
                put(work.now, i, fr.first_vertex(work, i))
                fr.compensate(scene, work, i, get(work.now, i), compensation_reach)
        waiting, sent = 0, used
        while sent > 0:
            waiting, sent, rays, missing = fr.trace(scene, work, waiting, bound)
            traced += rays
            lost += missing
            for i in range(sent):
                at = get(work.now, i)
                traced += fr.gather_few(scene, work, lights, count, few, at, bound)
                caustic, _ = de.estimate(scene, photons, work.forecast, at.p, at.n, at.wo, at.material, most)
                fr.add_light(work, at.lane, at.layer, vec.mul(at.throughput, caustic))
                fr.compensate(scene, work, i, at, compensation_reach)
        fr.deposit(work, pixels, first, film)
    return traced, lost
