"""Guided emission: which directions particles leave the lights in, natural emission reshaped by a learned density.

The direction of a particle comes from a point of the unit square in which natural emission, cos / pi about the normal,
is uniform. A guide is a piecewise constant density on a grid over that square, one for each group of lights, positive
everywhere: what it prefers is drawn more often and carries less flux, so that every sum over particles stays as it is.
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import particles, vec, warp
from causticmpi.kernels.jit import inline
from causticmpi.kernels.traced_scene import OFFSET, is_sphere, light_point, pick_light
from causticmpi.kernels.vec import ALMOST_ONE, ONE, ZERO


class EmissionGuide(NamedTuple):
    """Running sums over a grid of the square, each row ending with 1: rows (g, k), columns (g, k, k), float32."""

    rows: Any
    columns: Any


def emission_guide(density: np.ndarray) -> EmissionGuide:
    """The guide of a positive density (g, k, k), which need not be normalized."""
    columns = np.cumsum(density, axis=2, dtype=np.float64)
    rows = np.cumsum(columns[:, :, -1], axis=1)
    columns /= columns[:, :, -1:]
    rows /= rows[:, -1:]
    return EmissionGuide(rows.astype(np.float32), columns.astype(np.float32))


def natural_emission() -> EmissionGuide:
    """The guide that changes nothing."""
    return emission_guide(np.ones((1, 1, 1)))


@inline
def _stretch(cdf, u):
    """Bin of u, place within it, and the bin's probability."""
    i = warp.pick(cdf, u)
    before = cdf[i - 1] if i > 0 else ZERO
    width = cdf[i] - before
    return i, (u - before) / width, width


@inline
def reshape(guide, group, s, t):
    """A uniform point of the square moved to where the guide wants it; also uniform over guided density there."""
    cells = np.float32(guide.rows.shape[1])
    i, s, height = _stretch(guide.rows[group], s)
    j, t, width = _stretch(guide.columns[group, i], t)
    s, t = (np.float32(i) + s) / cells, (np.float32(j) + t) / cells
    return min(s, ALMOST_ONE), min(t, ALMOST_ONE), ONE / (cells * cells * height * width)


@inline
def group_of(light, scene, groups):
    """Group of a light: lights are grouped in runs of their number."""
    return light * groups // scene.light_cdf.shape[0]


@inline
def emit(scene, guide, u, v, w, s, t):
    """A point on the lights and a direction from it.

    u, v, w: choice of light and point; s, t: direction. Returns p, n (front), offset, power = radiance / density of p
    [W/sr], direction, and the flux [W] of the particle.
    """
    light, _ = pick_light(scene, u)
    s, t, share = reshape(guide, group_of(light, scene, guide.rows.shape[0]), s, t)
    sphere = is_sphere(scene, light)
    if sphere:
        p, n, offset, direction = emit_from_sphere(scene, light, v, w, s, t)
    else:
        p, n, offset = light_point(scene, light, w, v)
        direction = vec.to_world(warp.cosine_hemisphere(s, t), n)
    power = vec.scale(vec.row(scene.light_radiance, light), ONE / scene.light_pdf[light])
    flux = vec.scale(power, particles.PARTICLE_FLUX * share)
    if sphere:  # the point hangs on the direction, and so on the guide
        power = vec.scale(power, share)
    return p, n, offset, power, direction, flux


@inline
def emit_from_sphere(scene, light, v, w, s, t):
    """A uniform point on a light that is a sphere and a direction of density cos / pi from it: p, n, offset, direction.

    First the direction, by the point s, t of the square, then a point that faces it, which is the same joint density.
    """
    surface = scene.light_surface[light]
    direction = warp.uniform_sphere(s, t)
    n = vec.to_world(warp.cosine_hemisphere(v, w), direction)
    centre = vec.row(scene.light_corner, light)
    p = vec.along(centre, n, surface[3])
    return p, n, OFFSET * (max(abs(surface[0]), max(abs(surface[1]), abs(surface[2]))) + surface[3]), direction
