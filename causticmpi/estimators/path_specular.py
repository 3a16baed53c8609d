"""Path tracing at specular vertices: one event of each path (lanes of a block)."""

import numpy as np

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import LANES, RAY16
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.path_stages import BRANCH, look_up, number_hits
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import ONE, ZERO


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
def scale_radiance(work):
    """Radiance that refracts scales by eta^2 [Veach 1997, sec. 5.2]."""
    for i in range(LANES):
        put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), work[at.ETA2 + i]))


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
