"""The scene as kernels see it: a named tuple of arrays, and what a hit on it means."""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import vec, warp
from causticmpi.kernels.jit import inline, prefetch
from causticmpi.kernels.material_kinds import LIGHT_BIT, MIRROR
from causticmpi.kernels.vec import ALMOST_ONE, ZERO


class TracedScene(NamedTuple):
    """Arrays for kernels.

    handle          address of the Embree scene
    triangle_count  primitives below it are triangles, from it on spheres
    surface         (P, 8) float32: unit normal and largest coordinate of a triangle; centre and radius of a sphere;
    material, light, kind of material and shape as integers, all in one cache line
    material        (P,) int32; light (P,) int32: row of the light arrays or -1; both columns of `surface`
    primitive_kind  (P,) int8: kind of material, and LIGHT_BIT for lights: small enough to stay in the cache
    kind            (M,) int32; reflectance, specular (M, 3), exponent, ior (M,) float32: see SceneData
    light_corner, light_edge1, light_edge2  (L, 3) float32: triangle of a light; a sphere light has its centre and
    edges 0 light_surface   (L, 4) float32: first columns of the light's `surface` row
    light_radiance  (L, 3) float32; light_cdf (L,) float32: choice by power; light_pdf (L,) float32: units^-2 (area)
    light_row       (L, 16) float32: corner, edge1, edge2, normal, pdf and radiance of a light in one cache line
    """

    handle: int
    triangle_count: int
    surface: Any
    material: Any
    light: Any
    primitive_kind: Any
    kind: Any
    reflectance: Any
    specular: Any
    exponent: Any
    ior: Any
    light_corner: Any
    light_edge1: Any
    light_edge2: Any
    light_surface: Any
    light_radiance: Any
    light_cdf: Any
    light_pdf: Any
    light_row: Any


OFFSET = np.float32(2.0**-19)
"""Rays start this fraction of the largest coordinate off the surface: some 16 units in the last place of float32, above
the rounding of Embree's own plane equation, so that a ray never hits the surface it leaves, at any scene scale."""


@inline
def hit_point(scene, primitive, origin, direction, t):
    """Point, geometric unit normal (front side) and offset length of a hit [scene units]."""
    p = vec.along(origin, direction, t)
    s = scene.surface[primitive]
    if primitive < scene.triangle_count:
        n = (s[0], s[1], s[2])
        reach = s[3]
    else:
        centre = (s[0], s[1], s[2])
        n = vec.normalize(vec.sub(p, centre))
        p = vec.along(centre, n, s[3])  # back onto the sphere: t alone is too coarse
        reach = max(abs(s[0]), max(abs(s[1]), abs(s[2]))) + s[3]
    # The rounding of p = o + t d grows with the origin's coordinates as well.
    reach = max(reach, max(abs(origin[0]), max(abs(origin[1]), abs(origin[2]))))
    return p, n, OFFSET * reach


@inline
def is_sphere(scene, light):
    """Whether a light is a sphere: it has no edges."""
    e1 = vec.row(scene.light_edge1, light)
    return e1[0] == ZERO and e1[1] == ZERO and e1[2] == ZERO


@inline
def light_point(scene, light, u, v):
    """Uniform point on light `light`: point, front normal, offset length. Density of the light: `scene.light_pdf`,
    the choice of the light included (area measure)."""
    s = scene.light_surface[light]
    corner = vec.row(scene.light_corner, light)
    if is_sphere(scene, light):
        n = warp.uniform_sphere(u, v)
        reach = max(abs(s[0]), max(abs(s[1]), abs(s[2]))) + s[3]
        return vec.along(corner, n, s[3]), n, OFFSET * reach
    a, b = warp.triangle_barycentrics(u, v)
    p = vec.along(vec.along(corner, vec.row(scene.light_edge1, light), a), vec.row(scene.light_edge2, light), b)
    return p, (s[0], s[1], s[2]), OFFSET * s[3]


@inline
def pick_light(scene, u):
    """Light chosen in proportion to power, and u rescaled to [0, 1) for another use."""
    light = warp.pick(scene.light_cdf, u)
    before = scene.light_cdf[light - 1] if light > 0 else ZERO
    return light, min((u - before) / (scene.light_cdf[light] - before), ALMOST_ONE)


@inline
def is_specular(kind):
    return kind >= MIRROR


@inline
def ask_for_surface(scene, primitive):
    """Have the row of `surface` of a primitive, -1 for none, brought near: it is far away in a large mesh."""
    prefetch(scene.surface.ctypes.data + 32 * max(np.int64(0), np.int64(primitive)))


@inline
def has_specular(scene, primitive):
    """Whether a primitive is specular, by the smallest of all tables that tell."""
    return is_specular(scene.primitive_kind[primitive] & ~LIGHT_BIT)
