"""Pinhole camera: an array (4, 3) made by `causticmpi.scene.tracing.camera_array`."""

from causticmpi.kernels import vec
from causticmpi.kernels.jit import inline


@inline
def primary_ray(camera, x, y):
    """Origin and unit direction through the film position (x, y) in pixels, (0, 0) the top left corner."""
    d = vec.along(vec.row(camera, 1), vec.row(camera, 2), x)
    return vec.row(camera, 0), vec.normalize(vec.along(d, vec.row(camera, 3), y))
