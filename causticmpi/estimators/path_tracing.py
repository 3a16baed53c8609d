"""Path tracing (PT) with next-event estimation, the unbiased rival.

It tells the diffusive and the caustic part apart as IWS does: a path belongs to L_c if the first surface seen from its
first non-specular vertex p is specular, else to L_d (with what is seen directly).

Light that comes by way of specular surfaces is met by luck alone, and makes nearly all the noise. So the first
non-specular vertices of a path send several rays into the scene; all of them follow specular surfaces, while other
surfaces, lit by next-event estimation, are for the first ray alone. Roulette by throughput makes one path of them again
where they meet a non-specular surface. A scene without specular surfaces has no use for it, and is not split.
"""

import numpy as np

from causticmpi.estimators import path_diffuse as diffuse_stages
from causticmpi.estimators import path_specular as specular_stages
from causticmpi.kernels import path_layout as at
from causticmpi.kernels import path_stages as stages
from causticmpi.kernels import rng
from causticmpi.kernels.camera import see_packet
from causticmpi.kernels.embree import LANES, RAY16
from causticmpi.kernels.jit import inline, kernel, prefetch
from causticmpi.kernels.path_layout import put3
from causticmpi.kernels.vec import WHITE, ZERO


@kernel
def trace_paths(scene, camera, work, queues, splits, pixels, seed, pass_index, film):
    """One path a pixel; adds to `film` (see kernels.pixels).

    work, queues: `path_layout.path_work`; splits (2,) int64: rays of the first and of the second non-specular vertex.
    Returns rays traced.
    """
    traced = 0
    for first in range(0, pixels.shape[0], at.GROUP):
        group = pixels[first : first + at.GROUP]
        rays, diffuse, specular = see_group(scene, camera, work, queues[0], group, seed, pass_index, film)
        traced += rays
        wave = 0
        while diffuse + specular > 0:
            now, then = queues[wave & 1], queues[(wave + 1) & 1]
            next_diffuse, next_specular = 0, 0
            for block in range((diffuse + LANES - 1) // LANES):
                used = min(LANES, diffuse - block * LANES)
                begin_block(scene, work, now[0], block, used)
                glossy = diffuse_stages.meet(scene, work, used, splits[0], splits[1])
                traced += diffuse_stages.connect(scene, work, glossy)
                diffuse_stages.deposit(work, film, used)
                most = diffuse_stages.most_rays(work)
                for j in range(most):
                    traced += diffuse_stages.bounce(scene, work, j, glossy)
                    diffuse_stages.name_found(scene, work, j, glossy)
                    if most > 1:
                        diffuse_stages.put_aside(work, j)
                next_diffuse, next_specular = diffuse_stages.queue_bounces(
                    work, then, most, next_diffuse, next_specular
                )
            for block in range((specular + LANES - 1) // LANES):
                used = min(LANES, specular - block * LANES)
                begin_block(scene, work, now[1], block, used)
                specular_stages.meet_specular(scene, work, used)
                stages.scatter(work)
                traced += stages.trace_packet(scene, work, RAY16)
                next_diffuse, next_specular = specular_stages.queue_packet(
                    scene, work, then, next_diffuse, next_specular
                )
            diffuse, specular = next_diffuse, next_specular
            wave += 1
    return traced


@inline
def see_group(scene, camera, work, queues, pixels, seed, pass_index, film):
    """Let what the eye rays of all pixels meet wait, and have the rows of the film that will be added to brought near.

    Returns (rays traced, vertices in either queue).
    """
    traced, diffuse, specular = 0, 0, 0
    words, keys = work.view(np.int32), work.view(np.uint64)
    for first in range(0, pixels.shape[0], LANES):
        traced += see_packet(scene, camera, work, pixels, first, seed, pass_index)
        stages.tell_kinds(scene, work, RAY16)
        for i in range(LANES):
            key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[first + i, 2])
            keys[(RAY16 + 16 * at.FOUND_KEY) // 2 + i] = rng.subkey(key, 0)
        for i in range(LANES):
            put3(work, RAY16 + 16 * at.FOUND_THROUGHPUT, i, WHITE)
            work[RAY16 + 16 * at.FOUND_DOUBT + i] = ZERO
            words[RAY16 + 16 * at.FOUND_PIXEL + i] = pixels[first + i, 3] << 1
            words[RAY16 + 16 * at.FOUND_DEPTH + i] = 0
            words[RAY16 + 16 * at.FOUND_CHAIN + i] = 0
        for i in range(LANES):
            prefetch(film.ctypes.data + 24 * np.int64(pixels[first + i, 3]))
        diffuse, specular = stages.queue_found(work, RAY16, queues, diffuse, specular)
    return traced, diffuse, specular


@inline
def begin_block(scene, work, queue, block, used):
    """Take a block of vertices up: what and where they are, and their random numbers."""
    at.load_block(work, queue, block, used)
    stages.look_up(scene, work)
    stages.locate(work, scene.triangle_count)
    stages.draw(work)
