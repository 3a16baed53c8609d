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
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import ONE, WHITE


@kernel
def trace_paths(scene, camera, work, queues, splits, pixels, seed, pass_index, film):
    """One path a pixel; adds to `film` (see kernels.pixels).

    work, queues: `path_layout.path_work`; splits (2,) int64: rays of the first and of the second non-specular vertex.
    Returns rays traced.
    """
    traced = 0
    for first in range(0, pixels.shape[0], at.GROUP):
        group = pixels[first : first + at.GROUP]
        rays, diffuse, specular = see_group(scene, camera, work, queues[0], group, seed, pass_index)
        traced += rays
        wave = 0
        while diffuse + specular > 0:
            now, then = queues[wave & 1], queues[(wave + 1) & 1]
            next_diffuse, next_specular = 0, 0
            for block in range((diffuse + LANES - 1) // LANES):
                lanes = min(LANES, diffuse - block * LANES)
                at.load_block(work, now[0], block)
                traced += light_and_send(scene, work, group, film, lanes, splits)
                next_diffuse, next_specular = diffuse_stages.queue_bounces(
                    scene, work, then, lanes, next_diffuse, next_specular
                )
            for block in range((specular + LANES - 1) // LANES):
                lanes = min(LANES, specular - block * LANES)
                at.load_block(work, now[1], block)
                traced += follow_specular(scene, work, lanes)
                next_diffuse, next_specular = specular_stages.queue_packet(
                    scene, work, then, lanes, next_diffuse, next_specular
                )
            diffuse, specular = next_diffuse, next_specular
            wave += 1
    return traced


@inline
def see_group(scene, camera, work, queues, pixels, seed, pass_index):
    """Let what the eye rays of all pixels meet wait. Returns (rays traced, vertices in either queue)."""
    traced, diffuse, specular = 0, 0, 0
    for first in range(0, pixels.shape[0], LANES):
        traced += see_packet(scene, camera, work, pixels, first, seed, pass_index)
        stages.number_hits(scene, work, RAY16)
        stages.look_up(scene, work, RAY16)
        for i in range(LANES):
            kind = work.view(np.int32)[RAY16 + 16 * at.FOUND + i]
            if kind < 0:
                continue
            row = first + i
            key = rng.subkey(rng.make_key(seed, rng.CAMERA, pass_index, pixels[row, 2]), 0)
            if is_specular(kind):
                at.push(scene, work, queues[1], specular, RAY16, i, WHITE, ONE, key, row, 0, 0, 0)
                specular += 1
            else:
                at.push(scene, work, queues[0], diffuse, RAY16, i, WHITE, ONE, key, row, 0, 0, 0)
                diffuse += 1
    return traced, diffuse, specular


@inline
def light_and_send(scene, work, pixels, film, lanes, splits):
    """Emission and next-event estimation of a block of non-specular vertices, and their rays. Returns rays traced."""
    stages.locate(work, scene.triangle_count)
    stages.draw(work)
    glossy = diffuse_stages.meet(scene, work, lanes, splits[0], splits[1])
    traced = diffuse_stages.connect(scene, work, glossy)
    diffuse_stages.deposit(work, film, pixels, lanes)
    for j in range(diffuse_stages.most_rays(work, lanes)):
        traced += diffuse_stages.bounce(scene, work, j, glossy)
    return traced


@inline
def follow_specular(scene, work, lanes):
    """One specular event of a block. Returns rays traced."""
    stages.locate(work, scene.triangle_count)
    stages.draw(work)
    specular_stages.look_up_specular(scene, work, lanes)
    stages.scatter(work)
    specular_stages.scale_radiance(work)
    return stages.trace_packet(scene, work, RAY16)
