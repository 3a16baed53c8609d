"""Forecast photons: caustic points, stored wherever a particle met S and then D, at any depth of its path [CF sec.
3.2].

So L D S D (secondary caustics, the spot on the green wall) is forecast too. None is stored at specular vertices.
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import particles, rng, vec
from causticmpi.kernels.aim import NATURAL, emission
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.kernels.vec import ZERO


class CausticPoints(NamedTuple):
    """position (n, 3), normal (n, 3) on the lit side, direction (n, 3) back to the specular surface, power (n, 3): the
    flux of the whole lights, not yet divided by the number of particles emitted. float32."""

    position: Any
    normal: Any
    direction: Any
    power: Any


@kernel
def _shoot(scene, rays, seed, first, last, aim, points, stored):
    """Particles first … last-1, emitted by `aim`; stops when `points` is full.

    Returns (stored, next particle, rays traced).
    """
    traced = 0
    particle = first
    while particle < last and stored < points.power.shape[0]:
        key = rng.make_key(seed, rng.PHOTON, 0, particle)
        u, v = rng.uniform2(key, particles.EMIT_POINT)
        w, choice = rng.uniform2(key, 2)
        p, n, offset, power = particles.emission_point(scene, u, v, w)
        u, v = rng.uniform2(key, particles.EMIT_DIRECTION)
        direction, weight = emission(aim, p, n, choice, u, v)
        flux = vec.scale(power, weight)
        origin = vec.along(p, n, offset)
        bounce = 0
        while vec.max3(flux) > ZERO:
            u, v = particles.scatter_uniforms(key, bounce)
            at, origin, direction, flux, more = particles.next_vertex(
                scene, rays, origin, direction, flux, key, bounce, u, v
            )
            traced += more
            if at.primitive >= 0 and at.events > 0 and stored < points.power.shape[0]:
                for c in range(3):
                    points.position[stored, c] = at.p[c]
                    points.normal[stored, c] = at.n[c]
                    points.direction[stored, c] = at.back[c]
                    points.power[stored, c] = at.flux[c]
                stored += 1
            bounce += 1
        particle += 1
    return stored, particle, traced


MOST_PARTICLES_PER_PHOTON = 400
"""The shooting gives up after this many particles per caustic point asked for: then few reach a specular surface."""


def shoot_photons(
    scene: TracedScene, rays: np.ndarray, seed: int, count: int, aim: np.ndarray = NATURAL
) -> tuple[CausticPoints, int, int]:
    """Shoot until `count` caustic points are found, or nearly nothing reaches a specular surface.

    aim (7,) float32: see kernels.aim; whatever it is, the points' power over the particles emitted is unbiased.
    Returns the points found, the particles emitted and the rays traced.
    """
    points = CausticPoints(*(np.zeros((count, 3), np.float32) for _ in range(4)))
    stored = emitted = traced = 0
    limit = MOST_PARTICLES_PER_PHOTON * count
    while stored < count and emitted < limit:
        batch = min(limit - emitted, 1 << 20)
        stored, emitted, rays_traced = _shoot(scene, rays, seed, emitted, emitted + batch, aim, points, stored)
        traced += rays_traced
    return CausticPoints(*(a[:stored] for a in points)), emitted, traced
