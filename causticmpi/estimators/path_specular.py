"""Path tracing at specular vertices: one event of each path (lanes of a block)."""

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import LANES, RAY16
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.path_stages import BRANCH, name_keys, play_roulette, queue_found, tell_kinds
from causticmpi.kernels.vec import ONE, ZERO


@inline
def meet_specular(scene, work, used):
    """What the specular event needs to know, and which vertices roulette ends."""
    words = work.view(np.int32)
    for i in range(LANES):
        work[at.IOR + i] = scene.ior[np.uint64(words[at.MATERIAL + i])]
    for i in range(LANES):
        long = words[at.CHAIN + i] >= bsdf.ROULETTE_START
        survival = bsdf.SURVIVAL if long else ONE
        put3(work, at.THROUGHPUT, i, vec.scale(get3(work, at.THROUGHPUT, i), ONE / survival))
        work[at.ALIVE + i] = ONE if (i < used) & (work[at.SURVIVE + i] < survival) else ZERO
        work[at.IS_MIRROR + i] = ONE if words[at.KIND + i] == MIRROR else ZERO


@inline
def queue_packet(scene, work, queues, diffuse, specular):
    """Let what the rays of specular vertices have found wait. Returns how many vertices wait in either queue."""
    words = work.view(np.int32)
    tell_kinds(scene, work, RAY16)
    name_keys(work, BRANCH)
    for i in range(LANES):
        # Radiance that refracts scales by eta^2 [Veach 1997, sec. 5.2].
        throughput = vec.scale(get3(work, at.THROUGHPUT, i), work[at.ETA2 + i])
        goes_on = (work[at.ALIVE + i] > ZERO) & (vec.max3(throughput) > ZERO)
        words[_FOUND + i] = words[_FOUND + i] if goes_on else np.int32(-1)
        put3(work, RAY16 + 16 * at.FOUND_THROUGHPUT, i, throughput)
        work[RAY16 + 16 * at.FOUND_DOUBT + i] = ZERO
        words[RAY16 + 16 * at.FOUND_PIXEL + i] = words[at.PIXEL + i]
        words[RAY16 + 16 * at.FOUND_DEPTH + i] = words[at.DEPTH + i]
        words[RAY16 + 16 * at.FOUND_CHAIN + i] = words[at.CHAIN + i] + np.int32(1)
    play_roulette(work, RAY16)
    return queue_found(work, RAY16, queues, diffuse, specular)


_FOUND = RAY16 + 16 * at.FOUND
