"""What every estimator does at the eye: follow the specular chain to the first non-specular surface."""

import numpy as np

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import intersect
from causticmpi.kernels.jit import inline
from causticmpi.kernels.traced_scene import hit_point, is_specular
from causticmpi.kernels.vec import INFINITY, ONE, ZERO


@inline
def scatter_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u):
    """One specular event of an eye path: new origin, direction and throughput (the eta^2 of radiance included)."""
    material = scene.material[primitive]
    direction, weight, eta, refracted = bsdf.scatter_specular(scene, material, n, direction, u)
    throughput = vec.scale(vec.mul(throughput, weight), eta * eta)
    side = offset if vec.dot(direction, n) > ZERO else -offset
    return vec.along(p, n, side), direction, throughput


@inline
def follow_chain(scene, rays, origin, direction, primitive, t, throughput, key):
    """Follow specular events from a hit until a non-specular surface, a miss or the roulette ends the chain.

    primitive, t: the hit that (origin, direction) made; -1 stays -1.
    Returns primitive (-1: nothing more comes), p, n, offset, direction, throughput, rays traced.
    Light trapped in lossless glass ends by roulette after `bsdf.ROULETTE_START` events, so there is no cut-off.
    """
    traced = 0
    bounce = 0
    p = origin
    n = direction
    offset = ZERO
    while primitive >= 0:
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        if not is_specular(scene.kind[scene.material[primitive]]):
            break
        u, survive = rng.uniform2(key, bounce)
        if bounce >= bsdf.ROULETTE_START:
            if survive >= bsdf.SURVIVAL:
                primitive = np.int64(-1)
                break
            throughput = vec.scale(throughput, ONE / bsdf.SURVIVAL)
        origin, direction, throughput = scatter_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u)
        if vec.max3(throughput) <= ZERO:
            primitive = np.int64(-1)
            break
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        traced += 1
        bounce += 1
    return primitive, p, n, offset, direction, throughput, traced


@inline
def emitted(scene, primitive, n, direction):
    """Radiance the surface emits against `direction`; only the front shines."""
    light = scene.light[primitive]
    if light < 0 or vec.dot(n, direction) >= ZERO:
        return vec.BLACK
    return vec.row(scene.light_radiance, light)


@inline
def facing(n, direction):
    """The normal turned against the arriving direction."""
    return vec.neg(n) if vec.dot(n, direction) > ZERO else n
