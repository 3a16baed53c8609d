"""Virtual point lights (VPLs), renewed every pass [CF sec. 3.1].

Direct ones lie on the emitters, indirect ones at every non-specular vertex of the particle paths, also after a specular
chain (else the paths L S+ D D E were lost). Their emission may be guided, for a guide leaves nothing out; photons aimed
at specular objects must never get here.
The first bounces of a pass are stratified by a randomly shifted Halton sequence, which leaves each pass unbiased.
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, particles, rng, vec
from causticmpi.kernels.emission import emit
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import ALMOST_ONE, INV_PI, ONE, ZERO


class VirtualLights(NamedTuple):
    """Arrays of one pass; rows from the returned count on are unused.

    point (n, 3), normal (n, 3) on the lit side, offset (n,): scene units
    intensity (n, 3): what leaves per unit solid angle and cosine, over the number of paths; for gloss the arriving flux
    arrival (n, 3): unit direction back to where the particle came from
    material (n,) int32: -1 on an emitter; peak (n,): `bsdf.peak` of the material, 1 on an emitter
    """

    point: Any
    normal: Any
    offset: Any
    intensity: Any
    arrival: Any
    material: Any
    peak: Any


def empty_virtual_lights(capacity: int) -> VirtualLights:
    """Room for `capacity` lights."""
    vectors = [np.zeros((capacity, 3), np.float32) for _ in range(4)]
    return VirtualLights(
        vectors[0],
        vectors[1],
        np.zeros(capacity, np.float32),
        vectors[2],
        vectors[3],
        np.zeros(capacity, np.int32),
        np.zeros(capacity, np.float32),
    )


@inline
def _radical_inverse(base, index):
    inverse = 1.0 / base
    digit_weight, result = inverse, 0.0
    while index > 0:
        result += digit_weight * (index % base)
        index //= base
        digit_weight *= inverse
    return result


@inline
def _halton(base, index, shift):
    """Randomly shifted (Cranley-Patterson) Halton point in [0, 1)."""
    x = _radical_inverse(base, index) + shift
    return min(np.float32(x - np.floor(x)), ALMOST_ONE)


@inline
def _store(lights, i, p, n, offset, intensity, arrival, material, peak):
    if i < lights.offset.shape[0]:
        for c in range(3):
            lights.point[i, c] = p[c]
            lights.normal[i, c] = n[c]
            lights.intensity[i, c] = intensity[c]
            lights.arrival[i, c] = arrival[c]
        lights.offset[i] = offset
        lights.material[i] = material
        lights.peak[i] = peak


@kernel
def trace_virtual_lights(scene, rays, guide, seed, pass_index, paths, lights):
    """Trace `paths` particle paths from guided emission; returns (number of lights, rays traced).

    Where the number exceeds the room in `lights`, the rest was counted but not stored: enlarge and call again.
    """
    count, traced = 0, 0
    share = ONE / np.float32(paths)
    shift = rng.make_key(seed, rng.SHIFT, pass_index, 0)
    s0, s1 = rng.uniform2(shift, 0)
    s2, s3 = rng.uniform2(shift, 1)
    s4, s5 = rng.uniform2(shift, 2)
    s6, _ = rng.uniform2(shift, 3)
    for path in range(paths):
        key = rng.make_key(seed, rng.PARTICLE, pass_index, path)
        u, v, w = (np.float32(path) + s6) * share, _halton(2, path, s0), _halton(3, path, s1)
        p, n, offset, power, direction, flux = emit(scene, guide, u, v, w, _halton(5, path, s2), _halton(7, path, s3))
        power, flux = vec.scale(power, share), vec.scale(flux, share)
        _store(lights, count, p, n, offset, power, n, -1, ONE)
        count += 1
        origin = vec.along(p, n, offset)
        bounce = 0
        while vec.max3(flux) > ZERO:
            u, v = particles.scatter_uniforms(key, bounce)
            if bounce == 0:
                u, v = _halton(11, path, s4), _halton(13, path, s5)
            at, origin, direction, flux, more = particles.next_vertex(
                scene, rays, origin, direction, flux, key, bounce, u, v
            )
            traced += more
            if at.primitive >= 0 and vec.max3(bsdf.albedo(scene, at.material)) > ZERO:
                intensity = at.flux
                peak = bsdf.peak(scene, at.material)
                if scene.kind[at.material] == DIFFUSE:
                    intensity = vec.scale(vec.mul(at.flux, vec.row(scene.reflectance, at.material)), INV_PI)
                _store(lights, count, at.p, at.n, at.offset, intensity, at.back, at.material, peak)
                count += 1
            bounce += 1
    return count, traced
