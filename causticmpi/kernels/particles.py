"""Particles from the lights: the walk shared by virtual lights, forecast photons and photon maps.

Their flux is not scaled at refraction (only radiance carried back along an eye path is; see `bsdf.scatter_specular`).
"""

from causticmpi.kernels import bsdf, rng, vec, warp
from causticmpi.kernels.embree import intersect
from causticmpi.kernels.jit import inline
from causticmpi.kernels.traced_scene import hit_point, is_specular, light_point, pick_light
from causticmpi.kernels.vec import INFINITY, ONE, PI, ZERO

EMIT_POINT, EMIT_DIRECTION = 0, 1
"""Dimensions of a particle's own key."""
CHOICE, DIRECTION = 0, 1
"""Dimensions of its vertex keys."""


@inline
def emit(scene, u, v, w):
    """A point on the lights, in proportion to power: light, point, front normal, offset, and radiance / density
    [W/sr]."""
    light, u = pick_light(scene, u)
    p, n, offset = light_point(scene, light, w, v)
    return light, p, n, offset, vec.scale(vec.row(scene.light_radiance, light), ONE / scene.light_pdf[light])


@inline
def emission_direction(n, u, v):
    """Direction with a density of cos/pi about the normal: the flux of the particle is then pi * radiance / density."""
    return vec.to_world(warp.cosine_hemisphere(u, v), n)


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
        direction, weight, _, _ = bsdf.scatter_specular(scene, material, n, direction, u)
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


PARTICLE_FLUX = PI
"""Flux of a particle over the radiance / density of its emission."""
