"""Particles from the lights, one after the other: the walk of virtual lights, and of those that guides learn from.

There are two walks, with the same random numbers. `particle_waves` takes a thousand particles along at once, for
forecast photons, photon maps and light paths, of which there are many; it would run half empty on the few hundred paths
of a pass's virtual lights, and guides want to know what each path has come to before the next begins.

Their flux is not scaled at refraction (only radiance carried back along an eye path is; see `bsdf.scatter_specular`).
"""

from typing import Any, NamedTuple

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import intersect
from causticmpi.kernels.eye_path import facing
from causticmpi.kernels.jit import inline
from causticmpi.kernels.traced_scene import hit_point, is_specular
from causticmpi.kernels.vec import BLACK, INFINITY, ONE, PI, ZERO

EMIT_POINT, EMIT_DIRECTION, EMIT_CHOICE = 0, 1, 2
"""Dimensions of a particle's own key."""
CHOICE, DIRECTION = 0, 1
"""Dimensions of its vertex keys."""
PARTICLE_FLUX = PI
"""Flux of a particle over the radiance / density of its emission."""


class Vertex(NamedTuple):
    """Where a particle meets a non-specular surface.

    primitive: -1 if it is gone, and the rest without meaning; material; p, n (on the side it arrived at), offset
    [scene units]; back: unit direction to where it came from; flux: what arrived [W]; events: specular ones just before
    """

    primitive: Any
    material: Any
    p: Any
    n: Any
    offset: Any
    back: Any
    flux: Any
    events: Any


@inline
def walk_to_surface(scene, rays, origin, direction, flux, key):
    """Fly on, through any number of specular events, to the next non-specular surface.

    Returns primitive (-1: gone), p, n (front), offset, direction, flux, specular events on the way, rays traced.
    """
    events = 0
    traced = 1
    primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
    p, n, offset = origin, direction, ZERO
    while primitive >= 0:
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        material = scene.material[primitive]
        if not is_specular(scene.kind[material]):
            break
        u, survive = rng.uniform2(key, events)
        if events >= bsdf.ROULETTE_START:
            if survive >= bsdf.SURVIVAL:
                primitive = -1
                break
            flux = vec.scale(flux, ONE / bsdf.SURVIVAL)
        direction, weight, _, _, _ = bsdf.scatter_specular(scene, material, n, direction, u)
        flux = vec.mul(flux, weight)
        if vec.max3(flux) <= ZERO:
            primitive = -1
            break
        origin = vec.along(p, n, offset if vec.dot(direction, n) > ZERO else -offset)
        events += 1
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        traced += 1
    return primitive, p, n, offset, direction, flux, events, traced


@inline
def scatter_particle(scene, material, n, wi, flux, key, u, v):
    """Diffuse or glossy bounce with roulette by the reflected fraction: direction and flux (black: absorbed)."""
    choice, survive = rng.uniform2(key, CHOICE)
    direction, weight = bsdf.sample_weight(scene, material, n, wi, choice, u, v)
    survival = min(bsdf.SURVIVAL, vec.max3(weight))
    if survive >= survival:
        return direction, vec.BLACK
    return direction, vec.scale(vec.mul(flux, weight), ONE / survival)


@inline
def scatter_uniforms(key, bounce):
    """The two uniforms that choose the direction in which particle `key` leaves its vertex number `bounce`."""
    return rng.uniform2(rng.subkey(key, bounce), DIRECTION)


@inline
def next_vertex(scene, rays, origin, direction, flux, key, bounce, u, v):
    """One step of the walk of particle `key`: fly to the next vertex, scatter there.

    u, v: see `scatter_uniforms`. Returns the vertex; origin, direction and flux of the particle that leaves it, black
    if it was absorbed or is gone; rays traced.
    """
    step = rng.subkey(key, bounce)
    primitive, p, n, offset, direction, flux, events, traced = walk_to_surface(
        scene, rays, origin, direction, flux, rng.subkey(step, 1)
    )
    n = facing(n, direction)
    back = vec.neg(direction)
    material = scene.material[max(primitive, 0)]
    vertex = Vertex(primitive, material, p, n, offset, back, flux, events)
    flux = BLACK
    if primitive >= 0:
        direction, flux = scatter_particle(scene, material, n, back, vertex.flux, step, u, v)
    return vertex, vec.along(p, n, offset), direction, flux, traced
