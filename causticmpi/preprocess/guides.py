"""Learned emission: which directions from the lights matter to the picture, for virtual lights and for light tracing.

A guide only says where to look more often (kernels.emission). What is learned is the root of the mean squared
contribution to a random pixel, which is what the least variance over the picture asks for.
"""

from typing import NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, emission, particles, rng, vec
from causticmpi.kernels.camera import film_position
from causticmpi.kernels.embree import ray_buffer, visible
from causticmpi.kernels.emission import EmissionGuide, emission_guide, natural_emission
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.traced_scene import TracedScene, pick_light
from causticmpi.kernels.vec import INV_PI, ZERO

CELLS = 16
"""Cells of a guide in each direction of the square."""
GROUPS = 64
"""At most so many groups of lights."""
PARTICLES_PER_CELL = 256
RAYS_PER_PIXEL = 2.5
"""Rays of light tracing in a pass: a fraction of what the eye paths of a pixel take."""
NATURAL = 0.3
"""Share of natural emission in a guide: no weight exceeds 1 / NATURAL."""


class Guides(NamedTuple):
    """Emission of virtual lights and of light tracing; light paths of a pass for every pixel, 0 where the eye sees
    no caustic directly."""

    virtual_lights: EmissionGuide
    light_tracing: EmissionGuide
    paths_per_pixel: float


def no_guides() -> Guides:
    """Natural emission, and nothing to trace light for."""
    return Guides(natural_emission(), natural_emission(), 0.0)


@kernel
def _shoot(scene, camera, rays, guide, width, height, seed, first, last, bound, views, squares):
    """Squared contributions of particles first … last-1 by the cell of the square they left in.

    views: see `view.see_views`; squares (2, groups, cells, cells) float64: of their virtual lights to one of the views,
    of the caustics they draw on the film [arbitrary units]; by the cell before the guide moved it. Returns particles
    that drew, surfaces met, and rays traced.
    """
    drew, met, traced = 0, 0, 0
    groups, cells = squares.shape[1], squares.shape[2]
    for particle in range(first, last):
        key = rng.make_key(seed, rng.GUIDE, 1, particle)
        u, v = rng.uniform2(key, 0)
        w, _ = rng.uniform2(key, 1)
        s, t = rng.uniform2(key, 2)
        light, _ = pick_light(scene, u)
        group = emission.group_of(light, scene, groups)
        p, n, offset, _, direction, flux = emission.emit(scene, guide, u, v, w, s, t)
        view = views[particle % views.shape[0]]
        to = (view[0], view[1], view[2])
        m = (view[3], view[4], view[5])
        lit, drawn = ZERO, ZERO
        origin = vec.along(p, n, offset)
        bounce = 0
        while vec.max3(flux) > ZERO:
            u, v = particles.scatter_uniforms(key, bounce)
            at, origin, direction, flux, more = particles.next_vertex(
                scene, rays, origin, direction, flux, key, bounce, u, v
            )
            traced += more
            bounce += 1
            if at.primitive < 0:
                break
            met += 1
            reflected = vec.luminance(vec.mul(at.flux, bsdf.albedo(scene, at.material))) * INV_PI
            d = vec.sub(to, origin)
            near = vec.dot(d, d)
            cp, cq = vec.dot(at.n, d), -vec.dot(m, d)
            if cp > ZERO and cq > ZERO and near > ZERO:
                geometry = min(bound, cp * cq / (near * near))
                if visible(scene.handle, rays, origin, to):
                    lit += reflected * geometry * vec.luminance((view[6], view[7], view[8]))
                traced += 1
            if at.events > 0:
                d = vec.sub(at.p, vec.row(camera, 0))
                cosine = -vec.dot(at.n, d)
                x, y, depth = film_position(camera, d)
                if cosine > ZERO and depth > ZERO and ZERO <= x < width and ZERO <= y < height:
                    traced += 1
                    if visible(scene.handle, rays, origin, vec.row(camera, 0)):
                        drawn += reflected * cosine / (depth * depth * depth)
        i, j = min(cells - 1, int(s * cells)), min(cells - 1, int(t * cells))
        squares[0, group, i, j] += np.float64(lit) * np.float64(lit)
        squares[1, group, i, j] += np.float64(drawn) * np.float64(drawn)
        if drawn > ZERO:
            drew += 1
    return drew, met, traced


def learn_guides(
    scene: TracedScene, camera: np.ndarray, width: int, height: int, seed: int, bound: float, views: np.ndarray
) -> Guides:
    """Shoot particles by natural emission, learn from them, and keep a guide where fresh particles show that it pays.

    camera: see kernels.camera; bound: b [units^-2]; views: see `view.see_views`. What pays is judged by squared
    contribution times cost: of virtual lights their number, of light paths their rays.
    """
    groups = min(len(scene.light_cdf), GROUPS)
    count = groups * CELLS * CELLS * PARTICLES_PER_CELL
    rays = ray_buffer()

    def shoot(guide: EmissionGuide, run: int) -> tuple[np.ndarray, int, int, int]:
        squares = np.zeros((2, groups, CELLS, CELLS))
        counts = _shoot(
            scene,
            camera,
            rays,
            guide,
            np.float32(width),
            np.float32(height),
            seed,
            run * count,
            (run + 1) * count,
            np.float32(bound),
            views,
            squares,
        )
        return (squares, *counts)

    natural = natural_emission()
    squares, drew, met, traced = shoot(natural, 0)
    virtual_lights, light_tracing = (_guide(s) for s in squares)
    guided, _, met_guided, _ = shoot(virtual_lights, 1)
    if guided[0].sum() * (count + met_guided) > squares[0].sum() * (count + met):
        virtual_lights = natural
    guided, _, _, traced_guided = shoot(light_tracing, 2)
    if guided[1].sum() * traced_guided > squares[1].sum() * traced:
        light_tracing = natural
    else:
        traced = traced_guided
    return Guides(virtual_lights, light_tracing, RAYS_PER_PIXEL * count / traced if drew > 0 else 0.0)


def _guide(squares: np.ndarray) -> EmissionGuide:
    """From sums of squares (g, k, k) to a guide that keeps its share of natural emission."""
    wanted = np.sqrt(squares)
    total = wanted.mean(axis=(1, 2), keepdims=True)
    return emission_guide(np.where(total > 0, NATURAL + (1 - NATURAL) * wanted / np.where(total > 0, total, 1), 1))
