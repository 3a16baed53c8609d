"""Light tracing: caustics on diffuse surfaces that the eye sees directly, drawn by particles from the lights.

Wherever a particle meets S and then a diffuse surface in plain sight, its light goes straight onto the picture. These
splats own all of L_c there (`owns`), L S+ D E as well as L D S+ D E; caustics seen in or through something specular,
and those on gloss, no particle can draw: they are left to the forecast. The two never count the same path.
"""

import numpy as np

from causticmpi.kernels import particle_waves as waves
from causticmpi.kernels import path_layout as at
from causticmpi.kernels import rng, vec
from causticmpi.kernels.camera import film_position
from causticmpi.kernels.embree import LANES, TFAR, VALID, rtc_occluded16
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.particle_emission import emit_guided
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.vec import INV_PI, ONE, ZERO
from causticmpi.kernels.wavefront import arrive_without, leave_without

_LIGHT, _SLOT = at.PACKETS + at.PACKET_WORDS, at.PACKETS + at.PACKET_WORDS + 3 * LANES
"""Rows beside the packet of rays to the eye: what they bring to the film, and where."""


@inline
def owns(scene, material):
    """Whether splats draw the caustics on a directly seen surface of this material: on gloss they would spike."""
    return scene.kind[material] == DIFFUSE


@inline
def _project(camera, window, work):
    """The pixel that sees each vertex, KIND -1 where none does, and the radiance it gets: CONTRIBUTION.

    A pixel is the mean of radiance over its area a = step^2 on the film at distance 1; the surface in it measures
    a r^2 cos^3(camera) / cos(at), r the distance of the eye.
    """
    words = work.view(np.int32)
    eye, right = vec.row(camera, 0), vec.row(camera, 2)
    per_area = INV_PI / vec.dot(right, right)
    x0, y0, x1, y1 = window
    for i in range(LANES):
        d = vec.sub(get3(work, at.POINT, i), eye)
        cosine = -vec.dot(get3(work, at.NORMAL, i), d)  # times r
        x, y, depth = film_position(camera, d)
        light = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.REFLECTANCE, i))
        put3(work, at.CONTRIBUTION, i, vec.scale(light, cosine / (depth * depth * depth) * per_area))
        draws = (words[at.KIND + i] == DIFFUSE) & (words[at.CHAIN + i] > 0)
        seen = (cosine > ZERO) & (depth > ZERO) & (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)
        column, line = np.int32(x) - np.int32(x0), np.int32(y) - np.int32(y0)
        words[at.LIGHT + i] = line * np.int32(x1 - x0) + column if draws & seen else np.int32(-1)


@inline
def _queue_splats(scene, work, drawing, drawn):
    """Let the vertices of a block that a pixel may see wait for a packet to the eye.

    drawing: camera, window, film; drawn, and returned: how many wait, rays traced to the eye.
    """
    camera, window, film = drawing
    waiting, traced = drawn
    _project(camera, window, work)
    words = work.view(np.int32)
    eye = vec.row(camera, 0)
    for i in range(LANES):
        slot = words[at.LIGHT + i]
        if slot < 0:
            continue
        origin = vec.along(get3(work, at.POINT, i), get3(work, at.NORMAL, i), work[at.OFFSET + i])
        put3(work, at.PACKETS, waiting, origin)
        put3(work, at.PACKETS + 64, waiting, vec.sub(eye, origin))
        put3(work, _LIGHT, waiting, get3(work, at.CONTRIBUTION, i))
        words[_SLOT + waiting] = slot
        waiting += 1
        if waiting == LANES:
            traced += _splat(scene, work, film, waiting)
            waiting = 0
    return waiting, traced


@inline
def _splat(scene, work, film, waiting):
    """Draw what waits for its pixel and is seen from there. Returns shadow rays traced."""
    words = work.view(np.int32)
    for i in range(LANES):
        work[at.PACKETS + 16 * TFAR + i] = ONE if i < waiting else -ONE
    if waiting > 0:
        rtc_occluded16(work.ctypes.data + 4 * VALID, scene.handle, work.ctypes.data + 4 * at.PACKETS, 0)
    for i in range(waiting):
        if work[at.PACKETS + 16 * TFAR + i] >= ZERO:
            for c in range(3):
                film[words[_SLOT + i], c] += work[_LIGHT + 16 * c + i]
    return waiting


@kernel
def trace_light_paths(scene, camera, work, queues, guide, window, seed, pass_index, first, last, share, film):
    """Particles first … last-1 of a pass from guided emission, each of `share` of the power of the lights.

    work, queues: `particle_waves.particle_work`; window: x0, y0, x1, y1 of the film, half open, float32; adds radiance
    to film (slots, 3) float32, whose bits do not depend on how a pass is divided among calls, if each begins at a
    multiple of `particle_waves.GROUP`. Returns rays traced.
    """
    traced = 0
    drawing = camera, (window[0], window[1], window[2], window[3]), film
    for group in range(first, last, waves.GROUP):
        end = min(last, group + waves.GROUP)
        waiting = 0
        for number in range(0, end - group, LANES):
            emit_guided(scene, work, guide, seed, rng.LIGHT_PATH, pass_index, group + number, end, number)
            for i in range(LANES):
                put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), share))
            waiting = waves.wait(work, queues[0], waiting)
        (splats, eye_rays), rays = waves.walk(
            scene, work, queues, waiting, arrive_without, leave_without, queues, _queue_splats, drawing, (0, 0)
        )
        traced += rays + eye_rays + _splat(scene, work, film, splats)
    return traced
