"""The lamps themselves as the eye sees them, directly, through glass and in mirrors: E L and E S+ L.

An eye path that ends on a lamp brings all its radiance. A glint in glass fills a fraction of a pixel, one sample in
hundreds meets it, and that one outshines the rest of the pixel. A look at the lamps needs no more than its specular
chain, where a sample of the pixel pays for virtual lights and caustics as well: so there are several for each such
sample, in a grid over the pixel, wherever they are worth their cost (render.looks). Small images that are
known get one more each, about their place in the picture and with their events for sure, under the balance heuristic
[Veach 1997, (9.8)]: looks of the grid meet them as well, where their events come by chance.
"""

import math
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
from causticmpi.kernels.eye_path import choose_along_eye_path, emitted
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.traced_scene import hit_point, is_specular
from causticmpi.kernels.vec import ALMOST_ONE, INFINITY, ONE, TWO, ZERO
from causticmpi.kernels.warp import turn
from causticmpi.preprocess.lamp_images import MOST_EVENTS, STRAIGHT, WIDE, length_of
from causticmpi.preprocess.lamp_sight import (
    AXES,
    INVERSE,
    LARGER,
    MIDDLE,
    MOST_OWN,
    MOST_SIDE,
    PEAK,
    PLACE,
    RADIANCE,
    VARIANCE,
)
from causticmpi.preprocess.lamps import across, miss

PIXEL, BOUNCE, PRIMITIVE, EVENTS, WANTED = 0, 1, 2, 3, 4
"""Columns of `Looks.counts`."""
ORIGIN, DIRECTION, DISTANCE, THROUGHPUT, CHANCE, AT = 0, 3, 6, 7, 10, 11
"""First columns of `Looks.reals`."""
ANY, NAMELESS = 0, 0
"""WANTED of a look that takes events as they come, EVENTS of one that has too many for any image."""
FILM_POSITION, CHAIN = 0, 1
"""Dimensions of a look's key; CHAIN + i is of its i-th specular event."""
OWN = MOST_SIDE * MOST_SIDE
"""Number of the first look at an image: those of the grid come before."""


class Looks(NamedTuple):
    """Eye paths on their way. reals (n, 13) float32: origin, direction, distance of what is hit, throughput, how likely
    its events are by chance, film position; counts (n, 5) int64: pixel of the tile (-1: none), specular events behind
    it, primitive hit, these events and those it is to have (see lamp_images); key (n,) uint64."""

    reals: Any
    counts: Any
    key: Any


class SightWork(NamedTuple):
    """Workspace: rays of a packet, looks under way in its lanes, looks that wait on specular surfaces, light (16, 3) of
    a tile and number (16,) of its pixels."""

    packet: Any
    now: Looks
    waiting: Looks
    light: Any
    number: Any


def sight_work(side: int) -> SightWork:
    """Workspace for side x side looks at a pixel, at most."""

    def looks(rows: int) -> Looks:
        return Looks(np.zeros((rows, 13), np.float32), np.full((rows, 5), -1, np.int64), np.zeros(rows, np.uint64))

    room = LANES * (side * side + MOST_OWN)
    light, number = np.zeros((LANES, 3), np.float32), np.zeros(LANES, np.int64)
    return SightWork(ray_buffer(), looks(LANES), looks(room), light, number)


@inline
def near_image(image, row, u, v):
    """Film position (x, y) about an image, in no pixel for sure: Student's t of two degrees of freedom, half of it
    within the ellipse."""
    r = math.sqrt(u / (ONE - u))
    c, s = turn(v)
    a, b, axes = r * c, r * s, image[row, AXES : AXES + 4]
    return image[row, PLACE] + axes[0] * a + axes[1] * b, image[row, PLACE + 1] + axes[2] * a + axes[3] * b


@inline
def near_image_pdf(image, row, x, y):
    """Density of `near_image` [1 / pixel]."""
    right, down, inverse = x - image[row, PLACE], y - image[row, PLACE + 1], image[row, INVERSE : INVERSE + 4]
    a, b = inverse[0] * right + inverse[1] * down, inverse[2] * right + inverse[3] * down
    reach = ONE + a * a + b * b
    return image[row, PEAK] / (reach * reach)


@inline
def _own_density(sight, number, events, x, y):
    """Looks at images that a pixel gets at a film position with these events [1 / pixel]."""
    density = ZERO
    if sight.first.shape[0] > 0 and events != NAMELESS:
        for row in range(sight.first[number], sight.first[number + 1]):
            if sight.events[row] == events:
                density += near_image_pdf(sight.image, row, x, y)
    return density


@inline
def _larger_lamp(lamps, origin, direction, t):
    """Radiance of the brightest lamp that a ray would meet if all were LARGER, and nothing hid them but what lies well
    before them. t: of what the ray meets."""
    light, tangents = vec.BLACK, vec.frame(direction)
    for i in range(lamps.shape[0]):
        middle, variance = vec.row(lamps[:, MIDDLE:VARIANCE], i), lamps[i, VARIANCE:RADIANCE]
        a, b, ahead = miss(origin, direction, middle, direction, tangents)
        aa, ab = across(variance, tangents[0], tangents[0]), across(variance, tangents[0], tangents[1])
        bb, deep = across(variance, tangents[1], tangents[1]), across(variance, direction, direction)
        inside = bb * a * a - TWO * ab * a * b + aa * b * b <= np.float32(WIDE * LARGER**2) * (aa * bb - ab * ab)
        way = vec.dot(vec.sub(middle, origin), direction)
        hidden = t < np.float32(0.99) * way - np.float32(2 * LARGER) * math.sqrt(deep)
        shines = vec.row(lamps[:, RADIANCE:], i)
        if ahead and inside and not hidden and vec.max3(shines) > vec.max3(light):
            light = shines
    return light


@inline
def _send(work, lane, origin, direction):
    """A look's ray as a lane of the packet."""
    packet = work.packet
    for c in range(3):
        packet[RAY16 + 16 * c + lane] = origin[c]
        packet[RAY16 + 16 * (DIR + c) + lane] = direction[c]
    packet[RAY16 + 16 * 3 + lane] = ZERO
    packet[RAY16 + 16 * TFAR + lane] = INFINITY


@inline
def _set_out(camera, work, lane, x, y, pixel, wanted, key):
    """A look leaves the eye through a film position, as a lane of the packet."""
    now = work.now
    origin, direction = primary_ray(camera, x, y)
    _send(work, lane, origin, direction)
    row, counts = now.reals[lane], now.counts[lane]
    row[THROUGHPUT] = row[THROUGHPUT + 1] = row[THROUGHPUT + 2] = row[CHANCE] = ONE
    row[AT], row[AT + 1] = x, y
    counts[PIXEL], counts[BOUNCE], counts[EVENTS], counts[WANTED] = pixel, 0, STRAIGHT, wanted
    now.key[lane] = key


@inline
def _arrive(scene, sight, work, waiting, neighbours):
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
        origin, direction = lane_origin(packet, i), lane_direction(packet, i)
        if primitive >= 0 and is_specular(scene.kind[scene.material[primitive]]):
            row = then.reals[waiting]
            for c in range(3):
                row[ORIGIN + c], row[DIRECTION + c] = origin[c], direction[c]
            for c in range(THROUGHPUT, AT + 2):
                row[c] = now.reals[i, c]
            row[DISTANCE] = t
            for c in range(BOUNCE, WANTED + 1):
                then.counts[waiting, c] = now.counts[i, c]
            then.counts[waiting, PIXEL], then.counts[waiting, PRIMITIVE] = pixel, primitive
            then.key[waiting] = now.key[i]
            waiting += 1
            continue
        light = vec.BLACK
        if sight.larger.shape[0] > 0:
            light = _larger_lamp(sight.larger, origin, direction, t if primitive >= 0 else INFINITY)
        elif primitive >= 0 and scene.light[primitive] >= 0:
            _, n, _ = hit_point(scene, primitive, origin, direction, t)
            light = emitted(scene, primitive, n, direction)
        events, wanted = now.counts[i, EVENTS], now.counts[i, WANTED]
        if vec.max3(light) <= ZERO or (wanted != ANY and wanted != events):
            continue
        row, number = now.reals[i], work.number[pixel]
        own = _own_density(sight, number, events, row[AT], row[AT + 1])
        if own > ZERO:
            # The throughput is over the chance of events taken as they come, whichever way these were taken.
            side = np.float32(sight.sides[number])
            by_grid = side * side * row[CHANCE]
            for c in range(3):
                row[THROUGHPUT + c] *= by_grid / (by_grid + own)
        for c in range(3):
            work.light[pixel, c] += row[THROUGHPUT + c] * light[c]
    return waiting, traced


@inline
def _go_on(scene, work, waiting):
    """The last looks that wait go on from their specular surfaces, 16 at most. Returns how many wait still."""
    then, now = work.waiting, work.now
    sent = min(waiting, LANES)
    for i in range(sent):
        at = waiting - 1 - i
        row, counts, key = then.reals[at], then.counts[at], then.key[at]
        bounce, primitive, wanted = counts[BOUNCE], counts[PRIMITIVE], counts[WANTED]
        origin, direction = (row[0], row[1], row[2]), (row[3], row[4], row[5])
        throughput = (row[7], row[8], row[9])
        u, survive = rng.uniform2(key, CHAIN + bounce)
        if bounce >= bsdf.ROULETTE_START:
            if survive >= bsdf.SURVIVAL:
                continue
            throughput = vec.scale(throughput, ONE / bsdf.SURVIVAL)
        left = length_of(wanted) - bounce - 1
        if wanted != ANY:
            if left < 0:
                continue
            u = ZERO if (wanted >> left) & 1 else ALMOST_ONE
        p, n, offset = hit_point(scene, primitive, origin, direction, row[DISTANCE])
        p, direction, throughput, reflected, chance = choose_along_eye_path(
            scene, primitive, n, p, offset, direction, throughput, u
        )
        if wanted != ANY and reflected != (((wanted >> left) & 1) == 1):
            continue
        if vec.max3(throughput) > ZERO:
            _send(work, i, p, direction)
            for c in range(3):
                now.reals[i, THROUGHPUT + c] = throughput[c]
            now.reals[i, CHANCE] = row[CHANCE] * chance
            now.reals[i, AT], now.reals[i, AT + 1] = row[AT], row[AT + 1]
            own = now.counts[i]
            own[PIXEL], own[BOUNCE], own[WANTED] = counts[PIXEL], bounce + 1, wanted
            own[EVENTS] = 2 * counts[EVENTS] + reflected if bounce < MOST_EVENTS else NAMELESS
            now.key[i] = key
    return waiting - sent


@kernel
def see_lamps(scene, camera, work, sight, pixels, seed, pass_index, film):
    """Add the lamps that the eye sees to L_d of every row of `pixels` (n, 4), n a multiple of 16.

    work: of `sight_work` of the largest side or more; sight: see `LampSight`; a pixel gets side x side looks, one in
    each part of a grid over it, and one at each of its small images. Returns rays traced.
    """
    traced = 0
    for first in range(0, pixels.shape[0], LANES):
        waiting = lane = rays = 0
        for i in range(LANES):
            number = pixels[first + i, 2]
            work.light[i, 0] = work.light[i, 1] = work.light[i, 2] = ZERO
            work.number[i] = number
            side = np.int64(sight.sides[number])
            if pixels[first + i, 0] < 0 or side == 0:
                continue
            step = ONE / np.float32(side)
            pixel_key = rng.make_key(seed, rng.SIGHT, pass_index, number)
            left, top = np.float32(pixels[first + i, 0]), np.float32(pixels[first + i, 1])
            own = low = np.int64(0)
            if sight.first.shape[0] > 0:
                low = np.int64(sight.first[number])
                own = sight.first[number + 1] - low
            for look in range(side * side + own):
                image = low + look - side * side
                at_image = look >= side * side
                key = rng.subkey(pixel_key, OWN + look - side * side if at_image else look)
                u, v = rng.uniform2(key, FILM_POSITION)
                wanted = np.int64(ANY)
                if at_image:
                    x, y = near_image(sight.image, image, u, v)
                    wanted = sight.events[image]
                    if not (left <= x < left + ONE and top <= y < top + ONE):
                        continue
                else:
                    x, y = left + (np.float32(look % side) + u) * step, top + (np.float32(look // side) + v) * step
                _set_out(camera, work, lane, x, y, i, wanted, key)
                lane += 1
                if lane == LANES:
                    waiting, rays = _arrive(scene, sight, work, waiting, True)
                    traced += rays
                    lane = 0
        if lane > 0:
            waiting, rays = _arrive(scene, sight, work, waiting, True)
            traced += rays
        while waiting > 0:
            waiting = _go_on(scene, work, waiting)
            waiting, rays = _arrive(scene, sight, work, waiting, False)
            traced += rays
        for i in range(LANES):
            looks = np.float32(sight.sides[work.number[i]]) ** 2
            if pixels[first + i, 0] >= 0 and looks > ZERO:
                for c in range(3):
                    film[pixels[first + i, 3], c] += work.light[i, c] / looks
    return traced
