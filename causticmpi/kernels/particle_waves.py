"""Particles in waves: the walk of `particles` for many of them at a time, 16 lanes wide.

Particles go on in groups of GROUP. All rays of a group that wait are flown, in packets, then scattered block by block,
specular and other surfaces alike; what survives moves up to fill the next wave's packets. A queue of rays has the rows
of one of vertices in `path_layout`: ORIGIN, DIRECTION, THROUGHPUT (the flux), KEY of the particle, PIXEL (its number in
the group), DEPTH (non-specular vertices before) and CHAIN (specular events since the last).

A group that begins at a multiple of GROUP does the same, bit for bit, however particles are divided among calls.
"""

import numpy as np

from causticmpi.kernels import bsdf, lanes, particles, rng, vec, warp
from causticmpi.kernels import path_layout as at
from causticmpi.kernels import path_stages as stages
from causticmpi.kernels.embree import DIR, LANES, PRIM, RAY16, TFAR
from causticmpi.kernels.eye_path import facing
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import MIRROR, PHONG
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import INFINITY, ONE, ZERO

GROUP = 1024
"""Particles that go on together: enough that the last waves, of few, cost little; few enough to stay in the cache."""


def particle_work() -> tuple[np.ndarray, np.ndarray]:
    """Workspace: `work`, the lanes, and the queues of two waves (2, words) float32."""
    return at.lanes_and_packets(2), np.zeros((2, at.ROWS * at.ROOM), np.float32)


@inline
def walk(scene, work, queues, waiting, arrive, leave, fronts, note, notebook, noted):
    """Let the `waiting` rays of a group, those in the first queue, go on until none is left.

    arrive, leave, fronts: of `wavefront`, for particles that carry one along;
    note(scene, work, notebook, noted): called for each block that has met non-specular surfaces, but for those that
    particles come to straight from a light; returns what is noted now. Returns (noted, rays traced).
    """
    traced, wave = 0, 0
    while waiting > 0:
        now, then = queues[wave & 1], queues[(wave + 1) & 1]
        _fly(scene, work, now, waiting)
        traced += waiting
        going_on = 0
        for block in range((waiting + LANES - 1) // LANES):
            used = min(LANES, waiting - block * LANES)
            at.load_block(work, now, block, used)
            specular, other, glossy = _meet(scene, work, used)
            arrive(work, fronts, wave, block)
            if wave > 0 and other > 0:
                noted = note(scene, work, notebook, noted)
            _scatter(scene, work, specular, other, glossy)
            leave(scene, work, fronts, wave, going_on)
            going_on = wait(work, then, going_on)
        waiting = going_on
        wave += 1
    return noted, traced


@inline
def _fly(scene, work, queue, count):
    """Trace the first `count` rays of a queue: DISTANCE and PRIMITIVE (-1: nothing) of what they hit."""
    for block in range((count + LANES - 1) // LANES):
        first, left = block * LANES, count - block * LANES
        for c in range(3):
            lanes.copy(queue, at.place(at.ORIGIN + 16 * c, first), work, RAY16 + 16 * c)
            lanes.copy(queue, at.place(at.DIRECTION + 16 * c, first), work, RAY16 + 16 * DIR + 16 * c)
        for i in range(LANES):
            work[RAY16 + 16 * TFAR + i] = INFINITY if i < left else -ONE
        stages.trace_packet(scene, work, RAY16)
        stages.number_hits(scene, work, RAY16)
        stages.ask_for_hits(scene, work, RAY16)
        lanes.copy(work, RAY16 + 16 * TFAR, queue, at.place(at.DISTANCE, first))
        lanes.copy(work, RAY16 + 16 * PRIM, queue, at.place(at.PRIMITIVE, first))


@inline
def _meet(scene, work, used):
    """What the rays of a block have hit. Returns how many met a specular, a non-specular and a glossy surface.

    KIND is -1 where there is nothing; NORMAL of non-specular surfaces is on the side of arrival.
    """
    words = work.view(np.int32)
    for i in range(LANES):
        hit = words[at.PRIMITIVE + i]
        words[at.CHOSEN + i] = hit
        words[at.PRIMITIVE + i] = max(hit, np.int32(0))
    stages.look_up(scene, work)
    for i in range(LANES):
        work[at.IOR + i] = scene.ior[np.uint64(words[at.MATERIAL + i])]
    specular, other, glossy = 0, 0, 0
    for i in range(LANES):
        kind = words[at.KIND + i] if (words[at.CHOSEN + i] >= 0) & (i < used) else np.int32(-1)
        words[at.KIND + i] = kind
        work[at.IS_MIRROR + i] = ONE if kind == MIRROR else ZERO
        specular += is_specular(kind)
        other += (kind >= 0) & (kind < MIRROR)
        glossy += kind == PHONG
    stages.locate(work, scene.triangle_count)
    for i in range(LANES):
        n = get3(work, at.NORMAL, i)
        front = facing(n, get3(work, at.DIRECTION, i))
        turn = words[at.KIND + i] < MIRROR
        put3(work, at.NORMAL, i, (front[0] if turn else n[0], front[1] if turn else n[1], front[2] if turn else n[2]))
    return specular, other, glossy


@inline
def _scatter(scene, work, specular, other, glossy):
    """Scatter a block, by the numbers that `_meet` returned: the rays that go on, and their flux."""
    _draw(work)
    if specular > 0:
        stages.scatter(work)
    if other > 0:
        _bounce(work)
    if glossy > 0:
        _bounce_on_gloss(scene, work)
    _settle(work)


@inline
def _draw(work):
    """The random numbers of `particles.next_vertex`, and roulette of long specular chains."""
    words, keys = work.view(np.int32), work.view(np.uint64)
    for i in range(LANES):
        kind, events = words[at.KIND + i], words[at.CHAIN + i]
        mirrors = is_specular(kind)
        step = rng.subkey(keys[at.KEY // 2 + i], words[at.DEPTH + i])
        chain = rng.subkey(step, 1)
        work[at.U + i], work[at.V + i] = rng.uniform2(step, particles.DIRECTION)
        key = chain if mirrors else step
        choice, survive = rng.uniform2(key, events if mirrors else np.int32(particles.CHOICE))
        work[at.CHOICE + i], work[at.SURVIVE + i] = choice, survive
        long = mirrors & (events >= bsdf.ROULETTE_START)
        work[at.ALIVE + i] = ONE if (kind >= 0) & ((survive < bsdf.SURVIVAL) | (not long)) else ZERO
        put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), ONE / bsdf.SURVIVAL if long else ONE))


@inline
def _bounce(work):
    """Lanes at non-specular surfaces, all as if they were diffuse: `particles.scatter_particle` for lanes."""
    words = work.view(np.int32)
    for i in range(LANES):
        n, weight = get3(work, at.NORMAL, i), get3(work, at.REFLECTANCE, i)
        survival = min(bsdf.SURVIVAL, vec.max3(weight))
        flux = vec.scale(vec.mul(get3(work, at.THROUGHPUT, i), weight), ONE / survival)
        out = vec.to_world(warp.cosine_hemisphere(work[at.U + i], work[at.V + i]), n)
        origin = vec.along(get3(work, at.POINT, i), n, work[at.OFFSET + i])
        if words[at.KIND + i] < MIRROR:
            put3(work, RAY16, i, origin)
            put3(work, RAY16 + 16 * DIR, i, out)
            put3(work, at.CONTRIBUTION, i, get3(work, at.THROUGHPUT, i))
            put3(work, at.THROUGHPUT, i, flux)
            work[at.ALIVE + i] = work[at.ALIVE + i] if work[at.SURVIVE + i] < survival else ZERO


@inline
def _bounce_on_gloss(scene, work):
    """What `_bounce` has put down for lanes with gloss, put right."""
    words = work.view(np.int32)
    for i in range(LANES):
        if words[at.KIND + i] != PHONG:
            continue
        n, back = get3(work, at.NORMAL, i), vec.neg(get3(work, at.DIRECTION, i))
        choice, u, v = work[at.CHOICE + i], work[at.U + i], work[at.V + i]
        direction, weight = bsdf.sample_weight(scene, words[at.MATERIAL + i], n, back, choice, u, v)
        survival = min(bsdf.SURVIVAL, vec.max3(weight))
        put3(work, RAY16 + 16 * DIR, i, direction)
        put3(work, at.THROUGHPUT, i, vec.scale(vec.mul(get3(work, at.CONTRIBUTION, i), weight), ONE / survival))
        work[at.ALIVE + i] = ONE if work[at.SURVIVE + i] < survival else ZERO


@inline
def _settle(work):
    """Lanes without flux end; the others count the vertex."""
    words = work.view(np.int32)
    for i in range(LANES):
        mirrors = is_specular(words[at.KIND + i])
        words[at.DEPTH + i] += np.int32(0) if mirrors else np.int32(1)
        words[at.CHAIN + i] = words[at.CHAIN + i] + np.int32(1) if mirrors else np.int32(0)
        work[at.ALIVE + i] = work[at.ALIVE + i] if vec.max3(get3(work, at.THROUGHPUT, i)) > ZERO else ZERO


@inline
def wait(work, queue, count):
    """Let the rays of the lanes that are alive wait behind `count` others. Returns how many wait."""
    alive = lanes.marked(work, at.ALIVE)
    for c in range(3):
        lanes.pack(work, RAY16 + 16 * c, alive, queue, at.place(at.ORIGIN + 16 * c, count))
        lanes.pack(work, RAY16 + 16 * DIR + 16 * c, alive, queue, at.place(at.DIRECTION + 16 * c, count))
        lanes.pack(work, at.THROUGHPUT + 16 * c, alive, queue, at.place(at.THROUGHPUT + 16 * c, count))
    lanes.pack_long(work, at.KEY, alive, queue, at.place(at.KEY, 2 * count))
    for row in (at.PIXEL, at.DEPTH, at.CHAIN):
        lanes.pack(work, row, alive, queue, at.place(row, count))
    return count + lanes.count(alive)
