"""Path tracing at specular vertices: one event of each path (lanes of a block)."""

import math

import numpy as np

from causticmpi.estimators import path_layout as at
from causticmpi.estimators.path_layout import get3, put3
from causticmpi.estimators.path_stages import BRANCH, look_up, number_hits
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.embree import LANES, RAY16, TFAR
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import HALF, INFINITY, ONE, TWO, ZERO


@inline
def look_up_specular(scene, work, lanes):
    """Material rows of specular vertices, and which of them roulette ends."""
    words = work.view(np.int32)
    for i in range(LANES):
        work[at.ALIVE + i] = ZERO
        if i >= lanes:
            continue
        if words[at.CHAIN + i] >= bsdf.ROULETTE_START:
            if work[at.SURVIVE + i] >= bsdf.SURVIVAL:
                continue
            put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), ONE / bsdf.SURVIVAL))
        material = words[at.MATERIAL + i]
        work[at.ALIVE + i] = ONE
        work[at.IS_MIRROR + i] = ONE if scene.kind[material] == MIRROR else ZERO
        work[at.IOR + i] = scene.ior[material]
        put3(work, at.REFLECTANCE, i, vec.row(scene.reflectance, material))


@inline
def scatter(work):
    """One specular event of every lane, the eta^2 of radiance included: `bsdf.scatter_specular` for lanes."""
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
        scale = ONE if reflects else eta * eta
        reflectance = get3(work, at.REFLECTANCE, i)
        throughput = vec.scale(get3(work, at.THROUGHPUT, i), scale)
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


@inline
def queue_packet(scene, work, queues, lanes, diffuse, specular):
    """Let what the rays of specular vertices have found wait. Returns how many vertices wait in either queue."""
    words, keys = work.view(np.int32), work.view(np.uint64)
    number_hits(scene, work, RAY16)
    look_up(scene, work, RAY16)
    for i in range(lanes):
        kind = words[RAY16 + 16 * at.FOUND + i]
        throughput = get3(work, at.THROUGHPUT, i)
        if kind < 0 or work[at.ALIVE + i] <= ZERO or vec.max3(throughput) <= ZERO:
            continue
        key = rng.subkey(keys[at.KEY // 2 + i], BRANCH)
        pixel, depth, caustic = words[at.PIXEL + i], words[at.DEPTH + i], words[at.CAUSTIC + i]
        chain = words[at.CHAIN + i] + 1
        if is_specular(kind):
            at.push(scene, work, queues[1], specular, RAY16, i, throughput, ONE, key, pixel, depth, chain, caustic)
            specular += 1
        else:
            at.push(scene, work, queues[0], diffuse, RAY16, i, throughput, ONE, key, pixel, depth, chain, caustic)
            diffuse += 1
    return diffuse, specular
