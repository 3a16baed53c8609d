"""What vertices of paths in lanes need, of path tracing and of particles: where they are, their random numbers, packets
and what these have hit, and the specular event."""

import math

import numpy as np

from causticmpi.kernels import bsdf, lanes, rng, vec, warp
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import DIR, GEOM, LANES, MISS, PRIM, RAY16, TFAR, VALID, rtc_intersect16
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import LIGHT_BIT, MIRROR
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.traced_scene import OFFSET, ask_for_surface, is_specular
from causticmpi.kernels.vec import ALMOST_ONE, HALF, INFINITY, ONE, TWO, ZERO

CHOICE, DIRECTION, LIGHT, BRANCH = 0, 1, 2, 3
"""Dimensions of a vertex key; BRANCH + j names the vertex that its j-th ray finds."""
WORTH = np.float32(0.25)
"""Roulette brings the throughput of a path that falls below this back to it."""
SURE_DEPTH = 3
"""From this many non-specular vertices on no path survives for certain, so that white rooms end too."""
FEW_LIGHTS = 32
"""Up to so many lights are looked through one by one, in step for all lanes."""


@inline
def look_up(scene, work):
    """Rows of the scene that tell what the lanes have hit: SURFACE, SIZE, MATERIAL, LIGHT, KIND, REFLECTANCE."""
    words = work.view(np.int32)
    lanes.take8(scene.surface, work, at.PRIMITIVE, at.SURFACE)
    for i in range(LANES):
        put3(work, at.REFLECTANCE, i, vec.row(scene.reflectance, np.uint64(words[at.MATERIAL + i])))


@inline
def locate(work, triangle_count):
    """POINT, NORMAL (front side) and OFFSET of the hits: `traced_scene.hit_point` for lanes."""
    words = work.view(np.int32)
    for i in range(LANES):
        origin = get3(work, at.ORIGIN, i)
        p = vec.along(origin, get3(work, at.DIRECTION, i), work[at.DISTANCE + i])
        s = get3(work, at.SURFACE, i)
        size = work[at.SIZE + i]
        round_ = words[at.PRIMITIVE + i] >= triangle_count
        out = vec.normalize(vec.sub(p, s))
        back = vec.along(s, out, size)  # the hit of a sphere as far from its centre as it should be
        coordinate = max(abs(s[0]), max(abs(s[1]), abs(s[2]))) + size
        n = (out[0] if round_ else s[0], out[1] if round_ else s[1], out[2] if round_ else s[2])
        p = (back[0] if round_ else p[0], back[1] if round_ else p[1], back[2] if round_ else p[2])
        reach = coordinate if round_ else size
        reach = max(reach, max(abs(origin[0]), max(abs(origin[1]), abs(origin[2]))))
        put3(work, at.POINT, i, p)
        put3(work, at.NORMAL, i, n)
        work[at.OFFSET + i] = OFFSET * reach


@inline
def draw(work):
    """The random numbers of a block, by KEY: CHOICE, SURVIVE, U, V, LIGHT_U, LIGHT_V, in [0, 1)."""
    keys = work.view(np.uint64)
    for i in range(LANES):
        key = keys[at.KEY // 2 + i]
        work[at.CHOICE + i], work[at.SURVIVE + i] = rng.uniform2(key, CHOICE)
        work[at.U + i], work[at.V + i] = rng.uniform2(key, DIRECTION)
        work[at.LIGHT_U + i], work[at.LIGHT_V + i] = rng.uniform2(key, LIGHT)


@inline
def trace_packet(scene, work, packet):
    """Nearest hits of the packet at word `packet` of `work`. Returns the rays in use."""
    words = work.view(np.uint32)
    for i in range(LANES):
        words[packet + 16 * GEOM + i] = MISS
    used = lanes.count(lanes.marked(work, packet + 16 * TFAR))
    if used > 0:
        rtc_intersect16(work.ctypes.data + 4 * VALID, scene.handle, work.ctypes.data + 4 * packet, 0)
    return used


@inline
def number_hits(scene, work, packet):
    """Turn Embree's word on what a packet has hit, PRIM in its geometry, into the number of the primitive, -1 for none:
    spheres are counted behind the triangles."""
    lanes.add_product(work, packet + 16 * PRIM, packet + 16 * GEOM, scene.triangle_count)


@inline
def ask_for_hits(scene, work, packet):
    """Have the rows of `surface` that a packet has hit brought near."""
    words = work.view(np.int32)
    for i in range(LANES):
        ask_for_surface(scene, words[packet + 16 * PRIM + i])


@inline
def tell_kinds(scene, work, packet):
    """Number what a packet has hit; look up FOUND, kinds of material (-1: none), and FOUND_LIGHT, not 0 for lights."""
    words = work.view(np.int32)
    number_hits(scene, work, packet)
    ask_for_hits(scene, work, packet)
    for i in range(LANES):
        known = np.uint64(max(words[packet + 16 * PRIM + i], np.int32(0)))
        words[packet + 16 * at.FOUND + i] = scene.primitive_kind[known]
    for i in range(LANES):
        kind = words[packet + 16 * at.FOUND + i]
        words[packet + 16 * at.FOUND_LIGHT + i] = kind & LIGHT_BIT
        kind &= ~LIGHT_BIT
        words[packet + 16 * at.FOUND + i] = np.int32(-1) if words[packet + 16 * PRIM + i] < 0 else kind


@inline
def name_keys(work, branch):
    """Keys of what the lanes' rays have found, and the random numbers of its roulette: SURVIVE.

    A loop of its own: one through rows of both 32 and 64 bits becomes vectors only if they are few.
    """
    keys = work.view(np.uint64)
    for i in range(LANES):
        key = rng.subkey(keys[at.KEY // 2 + i], branch)
        keys[(RAY16 + 16 * at.FOUND_KEY) // 2 + i] = key
        _, work[at.SURVIVE + i] = rng.uniform2(key, CHOICE)


@inline
def survival_of(throughput, depth):
    """With what probability roulette lets a path go on from its non-specular vertex number `depth`."""
    survival = min(vec.max3(throughput) / WORTH, bsdf.SURVIVAL if depth >= SURE_DEPTH else ONE)
    return ONE if depth == 0 else survival


@inline
def play_roulette(work, packet):
    """Roulette at non-specular vertices that a packet has found, by SURVIVE.

    Those that die never wait, so that packets stay full; lights wait all the same, to be seen.
    """
    words = work.view(np.int32)
    for i in range(LANES):
        kind, depth = words[packet + 16 * at.FOUND + i], words[packet + 16 * at.FOUND_DEPTH + i]
        throughput = get3(work, packet + 16 * at.FOUND_THROUGHPUT, i)
        exempt = is_specular(kind) | (words[packet + 16 * at.FOUND_LIGHT + i] != 0)
        survival = ONE if exempt else survival_of(throughput, depth)
        words[packet + 16 * at.FOUND + i] = kind if work[at.SURVIVE + i] < survival else np.int32(-1)
        put3(work, packet + 16 * at.FOUND_THROUGHPUT, i, vec.scale(throughput, ONE / survival))


@inline
def queue_found(work, packet, queues, diffuse, specular):
    """Let what a packet has found wait, by FOUND; U and V are overwritten by the marks of who waits where.

    queues: of diffuse and of specular vertices, where so many wait already; returns how many do then.
    """
    words = work.view(np.int32)
    for i in range(LANES):
        kind = words[packet + 16 * at.FOUND + i]
        words[at.U + i] = np.int32((kind >= 0) & (kind < MIRROR))
        words[at.V + i] = np.int32(is_specular(kind))
    diffuse = at.push(work, packet, lanes.marked(work, at.U), queues[0], diffuse)
    specular = at.push(work, packet, lanes.marked(work, at.V), queues[1], specular)
    return diffuse, specular


@inline
def choose_lights(scene, work):
    """A light for each lane by LIGHT_U, which is rescaled to [0, 1) for another use: CHOSEN, its row, and LIGHT_REACH,
    the largest coordinate of a triangle. It is the light that `traced_scene.pick_light` picks."""
    words, cdf = work.view(np.int32), scene.light_cdf
    before, after = at.LIGHT_REACH, at.LIGHT_PDF
    for i in range(LANES):
        words[at.CHOSEN + i] = 0
        work[before + i] = ZERO
        work[after + i] = ONE
    if cdf.shape[0] <= FEW_LIGHTS:
        for light in range(cdf.shape[0] - 1):
            end = cdf[light]
            for i in range(LANES):
                past = end <= work[at.LIGHT_U + i]
                words[at.CHOSEN + i] += np.int32(past)
                work[before + i] = max(work[before + i], end if past else ZERO)
                work[after + i] = min(work[after + i], ONE if past else end)
    else:
        for i in range(LANES):
            light = warp.pick(cdf, work[at.LIGHT_U + i])
            words[at.CHOSEN + i] = light
            work[before + i] = cdf[light - 1] if light > 0 else ZERO
            work[after + i] = cdf[light]
    for i in range(LANES):
        u = (work[at.LIGHT_U + i] - work[before + i]) / (work[after + i] - work[before + i])
        work[at.LIGHT_U + i] = min(u, ALMOST_ONE)
    lanes.take16(scene.light_row, work, at.CHOSEN, at.CORNER)
    for i in range(LANES):
        corner = get3(work, at.CORNER, i)
        a, b = vec.add(corner, get3(work, at.EDGE1, i)), vec.add(corner, get3(work, at.EDGE2, i))
        work[at.LIGHT_REACH + i] = max(_farthest(corner), max(_farthest(a), _farthest(b)))


@inline
def _farthest(p):
    """The largest coordinate of a point."""
    return max(abs(p[0]), max(abs(p[1]), abs(p[2])))


@inline
def scatter(work):
    """One specular event of every lane, and its ray: `bsdf.scatter_specular` for lanes.

    ETA2 is what radiance carried against the light is still to be scaled by; lanes that are no mirrors keep THROUGHPUT.
    """
    for i in range(LANES):
        n, direction = get3(work, at.NORMAL, i), get3(work, at.DIRECTION, i)
        mirror = work[at.IS_MIRROR + i] > ZERO
        front = -vec.dot(direction, n)
        inside = front < ZERO
        side = (-n[0] if inside else n[0], -n[1] if inside else n[1], -n[2] if inside else n[2])
        cosine = abs(front)
        eta = work[at.IOR + i] if inside else ONE / work[at.IOR + i]
        sine2 = eta * eta * max(ZERO, ONE - cosine * cosine)
        inner = math.sqrt(max(ZERO, ONE - sine2))
        s = (eta * cosine - inner) / (eta * cosine + inner)
        p = (cosine - eta * inner) / (cosine + eta * inner)
        reflected = ONE if sine2 >= ONE else HALF * (s * s + p * p)
        reflects = mirror | (work[at.CHOICE + i] < reflected)
        bent = vec.normalize(vec.along(vec.scale(direction, eta), side, eta * cosine - inner))
        back = vec.along(direction, side, TWO * cosine)
        out = (back[0] if reflects else bent[0], back[1] if reflects else bent[1], back[2] if reflects else bent[2])
        work[at.ETA2 + i] = ONE if reflects else eta * eta
        reflectance, throughput = get3(work, at.REFLECTANCE, i), get3(work, at.THROUGHPUT, i)
        put3(
            work,
            at.THROUGHPUT,
            i,
            (
                throughput[0] * (reflectance[0] if mirror else ONE),
                throughput[1] * (reflectance[1] if mirror else ONE),
                throughput[2] * (reflectance[2] if mirror else ONE),
            ),
        )
        offset = work[at.OFFSET + i]
        put3(work, RAY16, i, vec.along(get3(work, at.POINT, i), n, offset if vec.dot(out, n) > ZERO else -offset))
        put3(work, RAY16 + 16 * DIR, i, out)
        work[RAY16 + 16 * TFAR + i] = INFINITY if work[at.ALIVE + i] > ZERO else -ONE
