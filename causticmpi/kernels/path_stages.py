"""What vertices of paths in lanes need, of path tracing and of particles: where they are, their random numbers, packets
and what these have hit, and the specular event."""

import math

import numpy as np

from causticmpi.kernels import path_layout as at
from causticmpi.kernels import rng, vec
from causticmpi.kernels.embree import GEOM, LANES, MISS, PRIM, RAY16, TFAR, VALID, rtc_intersect16
from causticmpi.kernels.jit import inline, prefetch
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.traced_scene import OFFSET
from causticmpi.kernels.vec import HALF, INFINITY, ONE, TWO, ZERO

CHOICE, DIRECTION, LIGHT, BRANCH = 0, 1, 2, 3
"""Dimensions of a vertex key; BRANCH + j names the vertex that its j-th ray finds."""


@inline
def locate(work, triangle_count):
    """POINT, NORMAL (front side) and OFFSET of the hits: `traced_scene.hit_point` for lanes."""
    words = work.view(np.int32)
    for i in range(LANES):
        origin = get3(work, at.ORIGIN, i)
        p = vec.along(origin, get3(work, at.DIRECTION, i), work[at.DISTANCE + i])
        s = get3(work, at.SURFACE, i)
        size = work[at.SURFACE + 48 + i]
        round_ = words[at.PRIMITIVE + i] >= triangle_count
        out = vec.normalize(vec.sub(p, s))
        back = vec.along(s, out, size)
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
    """The random numbers of a block."""
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
    used = 0
    for i in range(LANES):
        used += work[packet + 16 * TFAR + i] > ZERO
        words[packet + 16 * GEOM + i] = MISS
    if used > 0:
        rtc_intersect16(work.ctypes.data + 4 * VALID, scene.handle, work.ctypes.data + 4 * packet, 0)
    return used


@inline
def number_hits(scene, work, packet):
    """Turn Embree's word on what a packet has hit into the number of the primitive, -1 for none, and ask for its row of
    `surface` to be brought near: it is far away in a large mesh, and wanted only after the next packet."""
    words = work.view(np.int32)
    for i in range(LANES):
        missed = words[packet + 16 * GEOM + i] == -1
        primitive = words[packet + 16 * PRIM + i] + words[packet + 16 * GEOM + i] * np.int32(scene.triangle_count)
        words[packet + 16 * PRIM + i] = np.int32(-1) if missed else primitive
    for i in range(LANES):
        prefetch(scene.surface.ctypes.data + 32 * max(np.int64(0), np.int64(words[packet + 16 * PRIM + i])))


@inline
def look_up(scene, work, packet):
    """Kinds of material and sizes of what a packet has hit, into rows of it that Embree has filled and nobody reads."""
    words = work.view(np.int32)
    for i in range(LANES):
        primitive = words[packet + 16 * PRIM + i]
        known = max(primitive, np.int32(0))
        words[packet + 16 * at.FOUND + i] = np.int32(-1) if primitive < 0 else scene.kind[scene.material[known]]
        work[packet + 16 * at.REACH + i] = scene.surface[known, 3]


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
        put3(work, RAY16 + 64, i, out)
        work[RAY16 + 16 * TFAR + i] = INFINITY if work[at.ALIVE + i] > ZERO else -ONE
