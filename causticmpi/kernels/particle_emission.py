"""Emission of particles for 16 lanes, by a guide (`emission.emit`) or an aim (`aim.emission`), for `particle_waves`.

Points on triangles and cosine directions are drawn in loops over the lanes; what branches, a light that is a sphere or
a direction that is aimed, is put right lane by lane.
"""

import numpy as np

from causticmpi.kernels import aim as aim_room
from causticmpi.kernels import emission, particles, rng, vec, warp
from causticmpi.kernels import path_layout as at
from causticmpi.kernels import path_stages as stages
from causticmpi.kernels.embree import DIR, LANES, RAY16
from causticmpi.kernels.jit import inline
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.traced_scene import OFFSET, is_sphere, light_point
from causticmpi.kernels.vec import ONE, ZERO


@inline
def emit_aimed(scene, work, aim, seed, purpose, pass_index, first, last, number):
    """Particles first, first + 1, … before `last` by `aim`; `number`: that of the first in its group."""
    _begin(scene, work, seed, purpose, pass_index, first, last, number)
    _emit_from_triangles(work)
    for i in range(LANES):
        light = work.view(np.int32)[at.CHOSEN + i]
        if is_sphere(scene, light):
            p, n, offset = light_point(scene, light, work[at.SURVIVE + i], work[at.LIGHT_V + i])
            direction = vec.to_world(warp.cosine_hemisphere(work[at.U + i], work[at.V + i]), n)
            _put_right(work, i, p, n, offset, direction)
    if aim[6] > ZERO:
        for i in range(LANES):
            p, n = get3(work, at.POINT, i), get3(work, at.NORMAL, i)
            direction, weight = aim_room.emission(aim, p, n, work[at.CHOICE + i], work[at.U + i], work[at.V + i])
            put3(work, RAY16 + 16 * DIR, i, direction)
            flux = vec.scale(get3(work, at.THROUGHPUT, i), weight / particles.PARTICLE_FLUX)
            put3(work, at.THROUGHPUT, i, flux)
    _start(work)


@inline
def emit_guided(scene, work, guide, seed, purpose, pass_index, first, last, number):
    """Particles first, first + 1, … before `last` by a guide; `number`: that of the first in its group."""
    _begin(scene, work, seed, purpose, pass_index, first, last, number)
    for i in range(LANES):
        group = emission.group_of(np.int64(work.view(np.int32)[at.CHOSEN + i]), scene, guide.rows.shape[0])
        s, t, share = emission.reshape(guide, group, work[at.U + i], work[at.V + i])
        work[at.U + i], work[at.V + i] = s, t
        put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), share))
    _emit_from_triangles(work)
    for i in range(LANES):
        light = work.view(np.int32)[at.CHOSEN + i]
        if is_sphere(scene, light):
            p, n, offset, direction = emission.emit_from_sphere(
                scene, light, work[at.LIGHT_V + i], work[at.SURVIVE + i], work[at.U + i], work[at.V + i]
            )
            _put_right(work, i, p, n, offset, direction)
    _start(work)


@inline
def _begin(scene, work, seed, purpose, pass_index, first, last, number):
    """Keys, numbers, lights; THROUGHPUT is the flux of natural emission, SURVIVE and LIGHT_V choose the point."""
    words, keys = work.view(np.int32), work.view(np.uint64)
    for i in range(LANES):
        key = rng.make_key(seed, purpose, pass_index, first + i)
        keys[at.KEY // 2 + i] = key
        work[at.LIGHT_U + i], work[at.LIGHT_V + i] = rng.uniform2(key, particles.EMIT_POINT)
        work[at.U + i], work[at.V + i] = rng.uniform2(key, particles.EMIT_DIRECTION)
        work[at.SURVIVE + i], work[at.CHOICE + i] = rng.uniform2(key, particles.EMIT_CHOICE)
        work[at.ALIVE + i] = ONE if first + i < last else ZERO
        words[at.PIXEL + i] = number + i
        words[at.DEPTH + i] = 0
        words[at.CHAIN + i] = 0
    stages.choose_lights(scene, work)
    for i in range(LANES):
        flux = particles.PARTICLE_FLUX / work[at.LIGHT_PDF + i]
        put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.LIGHT_RADIANCE, i), flux))
        put3(work, at.NORMAL, i, get3(work, at.LIGHT_NORMAL, i))


@inline
def _emit_from_triangles(work):
    """A uniform point on the light of every lane, and a cosine direction from it."""
    for i in range(LANES):
        n = get3(work, at.NORMAL, i)
        a, b = warp.triangle_barycentrics(work[at.SURVIVE + i], work[at.LIGHT_V + i])
        p = vec.along(vec.along(get3(work, at.CORNER, i), get3(work, at.EDGE1, i), a), get3(work, at.EDGE2, i), b)
        put3(work, at.POINT, i, p)
        work[at.OFFSET + i] = OFFSET * work[at.LIGHT_REACH + i]
        put3(work, RAY16 + 16 * DIR, i, vec.to_world(warp.cosine_hemisphere(work[at.U + i], work[at.V + i]), n))


@inline
def _put_right(work, i, p, n, offset, direction):
    """What `_emit_from_triangles` has put down for a lane whose light is a sphere."""
    put3(work, at.POINT, i, p)
    put3(work, at.NORMAL, i, n)
    work[at.OFFSET + i] = offset
    put3(work, RAY16 + 16 * DIR, i, direction)


@inline
def _start(work):
    """The rays off the lights; lanes without flux stay behind."""
    for i in range(LANES):
        put3(work, RAY16, i, vec.along(get3(work, at.POINT, i), get3(work, at.NORMAL, i), work[at.OFFSET + i]))
        work[at.ALIVE + i] = work[at.ALIVE + i] if vec.max3(get3(work, at.THROUGHPUT, i)) > ZERO else ZERO
