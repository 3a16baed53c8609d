"""Pinhole camera: an array (4, 3) made by `causticmpi.scene.tracing.camera_array`."""

import numpy as np

from causticmpi.kernels import rng, vec
from causticmpi.kernels.embree import DIR, LANES, RAY16, TFAR, intersect_neighbours
from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import INFINITY, ONE, ZERO


@inline
def primary_ray(camera, x, y):
    """Origin and unit direction through the film position (x, y) in pixels, (0, 0) the top left corner."""
    d = vec.along(vec.row(camera, 1), vec.row(camera, 2), x)
    return vec.row(camera, 0), vec.normalize(vec.along(d, vec.row(camera, 3), y))


@inline
def film_position(camera, d):
    """Film position (x, y) in pixels of a point d away from the eye, the inverse of `primary_ray`, and depth, d along
    the optical axis [scene units]. The position means nothing for a depth of 0 or less."""
    right, down = vec.row(camera, 2), vec.row(camera, 3)
    step2 = vec.dot(right, right)
    depth = vec.dot(d, vec.cross(right, down)) / step2
    at = vec.sub(vec.scale(d, ONE / depth), vec.row(camera, 1))
    return vec.dot(at, right) / step2, vec.dot(at, down) / step2, depth


@inline
def see_packet(scene, camera, rays, pixels, first, seed, pass_index):
    """Trace the eye rays of 16 rows of `pixels`, a sample somewhere in each, as one packet. Returns the rays traced.

    Hits are read by `embree.lane_hit`, directions by `embree.lane_direction`.
    """
    used = 0
    for i in range(LANES):
        sees = pixels[first + i, 0] >= 0
        key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[first + i, 2])
        u, v = rng.uniform2(key, 0)
        origin, direction = primary_ray(
            camera, np.float32(pixels[first + i, 0]) + u, np.float32(pixels[first + i, 1]) + v
        )
        for c in range(3):
            rays[RAY16 + 16 * c + i] = origin[c]
            rays[RAY16 + 16 * (DIR + c) + i] = direction[c]
        rays[RAY16 + 16 * 3 + i] = ZERO
        rays[RAY16 + 16 * TFAR + i] = INFINITY if sees else -ONE
        used += sees
    intersect_neighbours(scene.handle, scene.triangle_count, rays)
    return used
