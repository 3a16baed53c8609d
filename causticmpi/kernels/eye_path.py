"""What every estimator does at the eye: follow the specular chain to the first non-specular surface."""

import numpy as np

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import (
    DIR,
    LANES,
    RAY16,
    TFAR,
    intersect,
    intersect_packet,
    lane_direction,
    lane_hit,
    lane_origin,
)
from causticmpi.kernels.jit import inline
from causticmpi.kernels.traced_scene import ask_for_surface, has_specular, hit_point, is_specular
from causticmpi.kernels.vec import INFINITY, ONE, ZERO


@inline
def choose_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u):
    """One specular event of an eye path: new origin, direction and throughput (the eta^2 of radiance included, and over
    the probability of the event); whether it reflects, and the probability of that."""
    material = scene.material[primitive]
    direction, weight, eta, refracted, chance = bsdf.scatter_specular(scene, material, n, direction, u)
    throughput = vec.scale(vec.mul(throughput, weight), eta * eta)
    side = offset if vec.dot(direction, n) > ZERO else -offset
    return vec.along(p, n, side), direction, throughput, not refracted, chance


@inline
def scatter_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u):
    """What `choose_along_eye_path` chooses: new origin, direction and throughput."""
    origin, out, weight, _, _ = choose_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u)
    return origin, out, weight


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


FAR = 1 << 14
"""From so many triangles on, the rows of `surface` that a packet has hit are asked for before they are needed: half a
MiB and more lies far away. It takes 6 % off the caustics of the pool (33,000), and adds 2 % to the ring's (12,000)."""


@inline
def follow_chains(scene, rays, primitive, distance, throughput, key):
    """`follow_chain` for the lanes of the packet in `rays`, side by side.

    primitive (16,) int64, -1 for none, distance (16,) float32: what the packet's rays have hit; throughput (16, 3); key
    (16,) uint64. On return the packet has the last ray of each chain, and all of these say what became of it.
    Returns rays traced.
    """
    traced = 0
    bounce = 0
    while True:
        going = 0
        if scene.triangle_count >= FAR:
            for i in range(LANES):
                ask_for_surface(scene, primitive[i])
        for i in range(LANES):
            rays[RAY16 + 16 * TFAR + i] = -ONE
            if primitive[i] < 0 or not has_specular(scene, primitive[i]):
                continue
            origin, direction = lane_origin(rays, i), lane_direction(rays, i)
            p, n, offset = hit_point(scene, primitive[i], origin, direction, distance[i])
            u, survive = rng.uniform2(key[i], bounce)
            w = vec.row(throughput, i)
            hit = primitive[i]
            primitive[i] = -1
            if bounce >= bsdf.ROULETTE_START:
                if survive >= bsdf.SURVIVAL:
                    continue
                w = vec.scale(w, ONE / bsdf.SURVIVAL)
            p, direction, w = scatter_along_eye_path(scene, hit, n, p, offset, direction, w, u)
            if vec.max3(w) <= ZERO:
                continue
            for c in range(3):
                rays[RAY16 + 16 * c + i] = p[c]
                rays[RAY16 + 16 * (DIR + c) + i] = direction[c]
                throughput[i, c] = w[c]
            rays[RAY16 + 16 * TFAR + i] = INFINITY
            going += 1
        if going == 0:
            return traced
        intersect_packet(scene.handle, rays)
        for i in range(LANES):
            hit, t = lane_hit(scene.triangle_count, rays, i)
            if hit >= 0:
                primitive[i], distance[i] = hit, t
        traced += going
        bounce += 1


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
