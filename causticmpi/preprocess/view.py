"""What the eye sees: points behind random film positions, which stand for the picture where a preprocess asks what
matters to it."""

import numpy as np

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import facing, follow_chain
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.kernels.vec import INFINITY, WHITE, ZERO

VIEWS = 4096
"""Points that stand for the picture."""
OUTERMOST = 5.0
"""Percent of the points, at either end of each axis, that do not count for the extent: a gap between two houses that
shows the horizon says nothing about the street."""


def see_views(scene: TracedScene, camera: np.ndarray, width: int, height: int, seed: int) -> np.ndarray:
    """Non-specular points behind random film positions (VIEWS, 9): place off its surface [scene units], normal, and
    throughput to the eye, albedo included; a position that sees nothing has throughput 0. camera: see kernels.camera.
    """
    views = np.zeros((VIEWS, 9), np.float32)
    _see_views(scene, camera, ray_buffer(), width, height, seed, views)
    return views


def extent_in_view(views: np.ndarray) -> float:
    """Diagonal [scene units] of the box that holds what the eye sees, but for the outermost; 0 if it sees nothing."""
    seen = views[views[:, 6:].max(axis=1) > 0, :3]
    if len(seen) == 0:
        return 0.0
    low, high = np.percentile(seen.astype(np.float64), [OUTERMOST, 100 - OUTERMOST], axis=0)
    return float(np.linalg.norm(high - low))


@kernel
def _see_views(scene, camera, rays, width, height, seed, views):
    for i in range(views.shape[0]):
        key = rng.make_key(seed, rng.GUIDE, 0, i)
        u, v = rng.uniform2(key, 0)
        origin, direction = primary_ray(camera, u * np.float32(width), v * np.float32(height))
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        primitive, p, n, offset, direction, throughput, _ = follow_chain(
            scene, rays, origin, direction, primitive, t, WHITE, rng.subkey(key, 1)
        )
        for c in range(3):
            views[i, 6 + c] = ZERO
        if primitive < 0:
            continue
        n = facing(n, direction)
        p = vec.along(p, n, offset)
        light = vec.mul(throughput, bsdf.albedo(scene, scene.material[primitive]))
        for c in range(3):
            views[i, c], views[i, 3 + c], views[i, 6 + c] = p[c], n[c], light[c]
