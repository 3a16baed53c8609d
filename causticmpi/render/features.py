"""What the eye sees first, for the layers `albedo`, `normal` and `depth`."""

import numpy as np

from causticmpi.kernels import bsdf
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect
from causticmpi.kernels.eye_path import facing
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.traced_scene import hit_point
from causticmpi.kernels.vec import HALF, INFINITY


@kernel
def first_hits(scene, camera, rays, pixels, features):
    """Fill features (slots, 7) float32 at the pixel centres: albedo RGB, normal towards the eye, distance from the eye
    [scene units] (infinite where nothing is seen)."""
    for i in range(pixels.shape[0]):
        slot = pixels[i, 3]
        if pixels[i, 0] < 0:
            continue
        origin, direction = primary_ray(camera, np.float32(pixels[i, 0]) + HALF, np.float32(pixels[i, 1]) + HALF)
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        features[slot, 6] = t
        if primitive < 0:
            continue
        _, n, _ = hit_point(scene, primitive, origin, direction, t)
        n = facing(n, direction)
        albedo = bsdf.albedo(scene, scene.material[primitive])
        for c in range(3):
            features[slot, c] = albedo[c]
            features[slot, 3 + c] = n[c]
