"""The lamps themselves as the eye sees them, directly, through glass and in mirrors: E L and E S+ L.

An eye path that ends on a lamp brings all its radiance. A glint in glass fills a fraction of a pixel, one sample in
hundreds meets it, and that one outshines the rest of the pixel. A look at the lamps needs no more than its specular
chain, where a sample of the pixel pays for virtual lights and caustics as well: so there are several for each such
sample, in a grid over the pixel, wherever a lamp can be seen at all (preprocess.lamp_sight).
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import (
    DIR,
    LANES,
    RAY16,
    TFAR,
    intersect_neighbours,
    intersect_packet,
    lane_direction,
    lane_hit,
    lane_origin,
    ray_buffer,
)
from causticmpi.kernels.eye_path import emitted, scatter_along_eye_path
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.traced_scene import hit_point, is_specular
from causticmpi.kernels.vec import INFINITY, ONE, ZERO

PIXEL, BOUNCE, PRIMITIVE = 0, 1, 2
"""Columns of `Looks.counts`."""
ORIGIN, DIRECTION, DISTANCE, THROUGHPUT = 0, 3, 6, 7
"""First columns of `Looks.reals`."""
FILM_POSITION, CHAIN = 0, 1
"""Dimensions of a look's key; CHAIN + i is of its i-th specular event."""


class Looks(NamedTuple):
    """Eye paths on their way. reals (n, 10) float32: origin, direction, distance of what is hit, throughput; counts
    (n, 3) int64: pixel of the tile (-1: none), specular events behind it, primitive hit; key (n,) uint64."""

    reals: Any
    counts: Any
    key: Any


class SightWork(NamedTuple):
    """Workspace: rays of a packet, looks under way in its lanes, looks that wait on specular surfaces, light (16, 3) of
    a tile."""

    packet: Any
    now: Looks
    waiting: Looks
    light: Any


def sight_work(side: int) -> SightWork:
    """Workspace for side x side looks at a pixel."""

    def looks(rows: int) -> Looks:
        return Looks(np.zeros((rows, 10), np.float32), np.full((rows, 3), -1, np.int64), np.zeros(rows, np.uint64))

    return SightWork(ray_buffer(), looks(LANES), looks(LANES * side * side), np.zeros((LANES, 3), np.float32))


@inline
def _set_out(work, lane, origin, direction, throughput, pixel, bounce, key):
    """A look leaves as a lane of the packet."""
    packet, now = work.packet, work.now
    for c in range(3):
        packet[RAY16 + 16 * c + lane] = origin[c]
        packet[RAY16 + 16 * (DIR + c) + lane] = direction[c]
        now.reals[lane, THROUGHPUT + c] = throughput[c]
    packet[RAY16 + 16 * 3 + lane] = ZERO
    packet[RAY16 + 16 * TFAR + lane] = INFINITY
    now.counts[lane, PIXEL], now.counts[lane, BOUNCE], now.key[lane] = pixel, bounce, key


@inline
def _arrive(scene, work, waiting, neighbours):
    """Trace the packet: lamps shine, what has met a specular surface waits behind the `waiting` others. Its lanes are
    free then. neighbours: its rays are the eye's. Returns how many wait, rays traced."""
    packet, now, then = work.packet, work.now, work.waiting
    traced = 0
    for i in range(LANES):
        if now.counts[i, PIXEL] < 0:
            packet[RAY16 + 16 * TFAR + i] = -ONE
        else:
            traced += 1
    if neighbours:
        intersect_neighbours(scene.handle, scene.triangle_count, packet)
    else:
        intersect_packet(scene.handle, packet)
    for i in range(LANES):
        pixel = now.counts[i, PIXEL]
        now.counts[i, PIXEL] = -1
        if pixel < 0:
            continue
        primitive, t = lane_hit(scene.triangle_count, packet, i)
        if primitive < 0:
            continue
        origin, direction = lane_origin(packet, i), lane_direction(packet, i)
        if is_specular(scene.kind[scene.material[primitive]]):
            row = then.reals[waiting]
            for c in range(3):
                row[ORIGIN + c], row[DIRECTION + c] = origin[c], direction[c]
                row[THROUGHPUT + c] = now.reals[i, THROUGHPUT + c]
            row[DISTANCE] = t
            then.counts[waiting, PIXEL], then.counts[waiting, BOUNCE] = pixel, now.counts[i, BOUNCE]
            then.counts[waiting, PRIMITIVE], then.key[waiting] = primitive, now.key[i]
            waiting += 1
        elif scene.light[primitive] >= 0:
            _, n, _ = hit_point(scene, primitive, origin, direction, t)
            light = emitted(scene, primitive, n, direction)
            for c in range(3):
                work.light[pixel, c] += now.reals[i, THROUGHPUT + c] * light[c]
    return waiting, traced


@inline
def _go_on(scene, work, waiting):
    """The last looks that wait go on from their specular surfaces, 16 at most. Returns how many wait still."""
    then = work.waiting
    sent = min(waiting, LANES)
    for i in range(sent):
        at = waiting - 1 - i
        row, key = then.reals[at], then.key[at]
        bounce, primitive = then.counts[at, BOUNCE], then.counts[at, PRIMITIVE]
        origin, direction = (row[0], row[1], row[2]), (row[3], row[4], row[5])
        throughput = (row[7], row[8], row[9])
        u, survive = rng.uniform2(key, CHAIN + bounce)
        if bounce >= bsdf.ROULETTE_START:
            if survive >= bsdf.SURVIVAL:
                continue
            throughput = vec.scale(throughput, ONE / bsdf.SURVIVAL)
        p, n, offset = hit_point(scene, primitive, origin, direction, row[DISTANCE])
        p, direction, throughput = scatter_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u)
        if vec.max3(throughput) > ZERO:
            _set_out(work, i, p, direction, throughput, then.counts[at, PIXEL], bounce + 1, key)
    return waiting - sent


@kernel
def see_lamps(scene, camera, work, mask, side, pixels, seed, pass_index, film):
    """Add the lamps that the eye sees to L_d of every row of `pixels` (n, 4), n a multiple of 16.

    work: of `sight_work(side)`; mask: see `LampSight`; a pixel gets the mean of side x side looks, one in each part of
    a grid over it. Returns rays traced.
    """
    traced = 0
    share = ONE / np.float32(side * side)
    step = ONE / np.float32(side)
    for first in range(0, pixels.shape[0], LANES):
        waiting = lane = rays = 0
        for i in range(LANES):
            number = pixels[first + i, 2]
            work.light[i, 0] = work.light[i, 1] = work.light[i, 2] = ZERO
            if pixels[first + i, 0] < 0 or (mask.shape[0] > 0 and not mask[number]):
                continue
            pixel_key = rng.make_key(seed, rng.SIGHT, pass_index, number)
            for look in range(side * side):
                key = rng.subkey(pixel_key, look)
                u, v = rng.uniform2(key, FILM_POSITION)
                x = np.float32(pixels[first + i, 0]) + (np.float32(look % side) + u) * step
                y = np.float32(pixels[first + i, 1]) + (np.float32(look // side) + v) * step
                origin, direction = primary_ray(camera, x, y)
                _set_out(work, lane, origin, direction, vec.WHITE, i, 0, key)
                lane += 1
                if lane == LANES:
                    waiting, rays = _arrive(scene, work, waiting, True)
                    traced += rays
                    lane = 0
        if lane > 0:
            waiting, rays = _arrive(scene, work, waiting, True)
            traced += rays
        while waiting > 0:
            waiting = _go_on(scene, work, waiting)
            waiting, rays = _arrive(scene, work, waiting, False)
            traced += rays
        for i in range(LANES):
            if pixels[first + i, 0] >= 0:
                for c in range(3):
                    film[pixels[first + i, 3], c] += work.light[i, c] * share
    return traced
