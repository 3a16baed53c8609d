"""Path tracing at non-specular vertices: emission, next-event estimation, and the rays they send (lanes of a block)."""

import math

import numpy as np

from causticmpi.kernels import bsdf, lanes, vec, warp
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import DIR, LANES, RAY16, TFAR, VALID, rtc_occluded16
from causticmpi.kernels.eye_path import emitted, facing
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import PHONG
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.path_stages import (
    BRANCH,
    choose_lights,
    name_keys,
    play_roulette,
    queue_found,
    survival_of,
    tell_kinds,
    trace_packet,
)
from causticmpi.kernels.traced_scene import OFFSET, is_specular
from causticmpi.kernels.vec import ALMOST_ONE, BLACK, INFINITY, INV_PI, ONE, PI, ZERO

_LATTICE = (np.float32(0.8191725134), np.float32(0.6710436067), np.float32(0.5497004779))
"""Steps of the additive recurrence R3 [Roberts 2018]: the rays of a vertex share one random start."""


@inline
def meet(scene, work, used, first_split, second_split):
    """Emission of non-specular vertices, and which of them go on. Returns how many of them have gloss."""
    words = work.view(np.int32)
    lights = 0
    for i in range(LANES):
        put3(work, at.RADIANCE, i, BLACK)
        lights += words[at.LIGHT + i] >= 0
    if lights > 0:
        emit(scene, work, used)
    glossy = 0
    for i in range(LANES):
        throughput, depth = get3(work, at.THROUGHPUT, i), words[at.DEPTH + i]
        has_gloss = words[at.KIND + i] == PHONG
        survival = survival_of(throughput, depth) if words[at.LIGHT + i] >= 0 else ONE  # others: `play_roulette`
        reflects = has_gloss | (vec.max3(get3(work, at.REFLECTANCE, i)) > ZERO)
        alive = (i < used) & reflects & (work[at.SURVIVE + i] < survival)
        split = first_split if depth == 0 else (second_split if depth == 1 else 1)
        put3(work, at.THROUGHPUT, i, vec.scale(throughput, ONE / survival))
        put3(work, at.NORMAL, i, facing(get3(work, at.NORMAL, i), get3(work, at.DIRECTION, i)))
        work[at.ALIVE + i] = ONE if alive else ZERO
        words[at.SPLITS + i] = np.int32(split) if alive else np.int32(0)
        glossy += alive & has_gloss
    return glossy


@inline
def emit(scene, work, used):
    """RADIANCE of the lights that lanes see, by the balance heuristic where next-event estimation finds it too."""
    words = work.view(np.int32)
    for i in range(used):
        light = words[at.LIGHT + i]
        if light < 0:
            continue
        direction, n, t = get3(work, at.DIRECTION, i), get3(work, at.NORMAL, i), work[at.DISTANCE + i]
        radiance = vec.mul(get3(work, at.THROUGHPUT, i), emitted(scene, words[at.PRIMITIVE + i], n, direction))
        if vec.max3(radiance) > ZERO:
            density = light_density(scene.light_pdf[light], t * t, -vec.dot(n, direction))
            put3(work, at.RADIANCE, i, vec.scale(radiance, ONE / (ONE + density * work[at.DOUBT + i])))


@inline
def shine_from_spheres(scene, work):
    """Lights that are spheres: the point itself for CORNER."""
    for i in range(LANES):
        e1, s = get3(work, at.EDGE1, i), get3(work, at.CORNER, i)
        if e1[0] == ZERO and e1[1] == ZERO and e1[2] == ZERO:
            radius = scene.light_surface[work.view(np.int32)[at.CHOSEN + i], 3]
            n = warp.uniform_sphere(work[at.LIGHT_U + i], work[at.LIGHT_V + i])
            put3(work, at.CORNER, i, vec.along(s, n, radius))
            put3(work, at.LIGHT_NORMAL, i, n)
            work[at.LIGHT_REACH + i] = max(abs(s[0]), max(abs(s[1]), abs(s[2]))) + radius


@inline
def direct_light(work):
    """Next-event estimate of each lane, before visibility, and its shadow ray in the packet.

    Weighted against BRDF sampling by the balance heuristic [Veach 1997, (9.8)]. Returns the rays to trace.
    """
    for i in range(LANES):
        p, n = get3(work, at.POINT, i), get3(work, at.NORMAL, i)
        a, b = warp.triangle_barycentrics(work[at.LIGHT_U + i], work[at.LIGHT_V + i])
        q = vec.along(vec.along(get3(work, at.CORNER, i), get3(work, at.EDGE1, i), a), get3(work, at.EDGE2, i), b)
        n_q = get3(work, at.LIGHT_NORMAL, i)
        d = vec.sub(q, p)
        distance2 = vec.dot(d, d)
        wi = vec.scale(d, ONE / math.sqrt(distance2))
        cosine, cosine_q = vec.dot(n, wi), -vec.dot(n_q, wi)
        density = light_density(work[at.LIGHT_PDF + i], distance2, cosine_q)
        weight = INV_PI * cosine / (density + INV_PI * cosine)
        light = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.LIGHT_RADIANCE, i))
        put3(work, at.CONTRIBUTION, i, vec.scale(vec.mul(light, get3(work, at.REFLECTANCE, i)), weight))
        put3(work, at.TO_LIGHT, i, wi)
        work[at.LIGHT_PDF + i] = density
        offset = work[at.OFFSET + i]
        origin = vec.along(p, n, offset)
        target = vec.along(q, n_q, max(offset, OFFSET * work[at.LIGHT_REACH + i]))
        put3(work, RAY16, i, origin)
        put3(work, RAY16 + 16 * DIR, i, vec.sub(target, origin))
        seen = (work[at.ALIVE + i] > ZERO) & (distance2 > ZERO) & (cosine > ZERO) & (cosine_q > ZERO)
        work[RAY16 + 16 * TFAR + i] = ONE if seen else -ONE
    return lanes.count(lanes.marked(work, RAY16 + 16 * TFAR))


@inline
def direct_light_on_gloss(scene, work):
    """What `direct_light` has put down for lanes with gloss, put right."""
    words = work.view(np.int32)
    for i in range(LANES):
        material = words[at.MATERIAL + i]
        if work[RAY16 + 16 * TFAR + i] < ZERO or words[at.KIND + i] != PHONG:
            continue
        n, wi, wo = get3(work, at.NORMAL, i), get3(work, at.TO_LIGHT, i), vec.neg(get3(work, at.DIRECTION, i))
        weight = vec.dot(n, wi) / (work[at.LIGHT_PDF + i] + bsdf.pdf(scene, material, n, wo, wi))
        light = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.LIGHT_RADIANCE, i))
        put3(work, at.CONTRIBUTION, i, vec.scale(vec.mul(light, bsdf.evaluate(scene, material, n, wo, wi)), weight))


@inline
def connect(scene, work, glossy):
    """Next-event estimation: adds what arrives to RADIANCE. Returns the rays traced."""
    choose_lights(scene, work)
    spheres = 0
    for i in range(LANES):
        e1 = get3(work, at.EDGE1, i)
        spheres += (e1[0] == ZERO) & (e1[1] == ZERO) & (e1[2] == ZERO)
    if spheres > 0:
        shine_from_spheres(scene, work)
    used = direct_light(work)
    if used == 0:
        return 0
    if glossy > 0:
        direct_light_on_gloss(scene, work)
    rtc_occluded16(work.ctypes.data + 4 * VALID, scene.handle, work.ctypes.data + 4 * RAY16, 0)
    for i in range(LANES):
        visible = work[RAY16 + 16 * TFAR + i] >= ZERO
        for c in range(3):
            work[at.RADIANCE + 16 * c + i] += work[at.CONTRIBUTION + 16 * c + i] if visible else ZERO
    return used


@inline
def deposit(work, film, used):
    """Hand RADIANCE over to the film."""
    words = work.view(np.int32)
    for i in range(used):
        pixel = words[at.PIXEL + i]
        slot, column = np.uint64(pixel >> 1), np.uint64(3 * (pixel & 1))
        for c in range(3):
            film[slot, column + np.uint64(c)] += work[at.RADIANCE + 16 * c + i]


@inline
def most_rays(work):
    """The most rays that a lane sends."""
    words = work.view(np.int32)
    most = np.int32(0)
    for i in range(LANES):
        most = max(most, words[at.SPLITS + i])
    return most


@inline
def bounce(scene, work, j, glossy):
    """The j-th ray of every lane that sends as many, sampled by the BRDF. Returns the rays traced."""
    words = work.view(np.int32)
    step = np.float32(j)
    for i in range(LANES):
        n = get3(work, at.NORMAL, i)
        u, v = fraction(work[at.U + i] + step * _LATTICE[0]), fraction(work[at.V + i] + step * _LATTICE[1])
        put3(work, RAY16, i, vec.along(get3(work, at.POINT, i), n, work[at.OFFSET + i]))
        put3(work, RAY16 + 16 * DIR, i, vec.to_world(warp.cosine_hemisphere(u, v), n))
        work[RAY16 + 16 * TFAR + i] = INFINITY if j < words[at.SPLITS + i] else -ONE
    if glossy > 0:
        for i in range(LANES):
            material = words[at.MATERIAL + i]
            if work[RAY16 + 16 * TFAR + i] < ZERO or words[at.KIND + i] != PHONG:
                continue
            n, wo = get3(work, at.NORMAL, i), vec.neg(get3(work, at.DIRECTION, i))
            u, v = fraction(work[at.U + i] + step * _LATTICE[0]), fraction(work[at.V + i] + step * _LATTICE[1])
            direction = bsdf.sample(scene, material, n, wo, fraction(work[at.CHOICE + i] + step * _LATTICE[2]), u, v)
            put3(work, RAY16 + 16 * DIR, i, direction)
            if vec.dot(direction, n) <= ZERO:
                work[RAY16 + 16 * TFAR + i] = -ONE
    return trace_packet(scene, work, RAY16)


@inline
def fraction(x):
    return min(x - np.float32(np.int32(x)), ALMOST_ONE)


@inline
def name_found(scene, work, j, glossy):
    """What the j-th rays of a block have found, as vertices.

    All rays follow light to specular surfaces, at equal shares; other surfaces are for the first ray alone.
    """
    words = work.view(np.int32)
    tell_kinds(scene, work, RAY16)
    name_keys(work, BRANCH + j)
    for i in range(LANES):
        kind, depth, pixel = words[_FOUND + i], words[at.DEPTH + i], words[at.PIXEL + i]
        mirrors = is_specular(kind)
        words[_FOUND + i] = kind if mirrors | (j == 0) else np.int32(-1)
        share = ONE / np.float32(words[at.SPLITS + i]) if mirrors else ONE
        throughput = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.REFLECTANCE, i))
        put3(work, RAY16 + 16 * at.FOUND_THROUGHPUT, i, vec.scale(throughput, share))
        cosine = vec.dot(get3(work, at.NORMAL, i), get3(work, RAY16 + 16 * DIR, i))
        work[RAY16 + 16 * at.FOUND_DOUBT + i] = PI / cosine
        words[RAY16 + 16 * at.FOUND_PIXEL + i] = pixel | np.int32(mirrors & (depth == 0))
        words[RAY16 + 16 * at.FOUND_DEPTH + i] = depth + np.int32(1)
        words[RAY16 + 16 * at.FOUND_CHAIN + i] = 0
    if glossy > 0:
        name_found_from_gloss(scene, work)
    play_roulette(work, RAY16)


_FOUND = RAY16 + 16 * at.FOUND


@inline
def name_found_from_gloss(scene, work):
    """What `name_found` has put down for lanes with gloss, put right."""
    words = work.view(np.int32)
    for i in range(LANES):
        if words[at.KIND + i] != PHONG or words[_FOUND + i] < 0:
            continue
        material = words[at.MATERIAL + i]
        n, wo, wi = get3(work, at.NORMAL, i), vec.neg(get3(work, at.DIRECTION, i)), get3(work, RAY16 + 16 * DIR, i)
        density = bsdf.pdf(scene, material, n, wo, wi)
        f = vec.scale(bsdf.evaluate(scene, material, n, wo, wi), vec.dot(wi, n) / density)
        share = ONE / np.float32(words[at.SPLITS + i]) if is_specular(words[_FOUND + i]) else ONE
        put3(work, RAY16 + 16 * at.FOUND_THROUGHPUT, i, vec.scale(vec.mul(get3(work, at.THROUGHPUT, i), f), share))
        work[RAY16 + 16 * at.FOUND_DOUBT + i] = ONE / density


@inline
def put_aside(work, j):
    """Keep what the j-th rays have found until all rays of the block are traced."""
    for row in range(0, at.PACKET_WORDS, LANES):
        lanes.copy(work, RAY16 + row, work, at.PACKETS + j * at.PACKET_WORDS + row)


@inline
def queue_bounces(work, queues, most, diffuse, specular):
    """Let what the rays of a block have found wait. Returns how many vertices wait in either queue."""
    if most == 1:
        return queue_found(work, RAY16, queues, diffuse, specular)
    words = work.view(np.int32)
    if most > 1:
        diffuse, _ = queue_found(work, at.PACKETS, queues, diffuse, specular)
        for i in range(LANES):  # ray by ray of a lane, so that their order does not depend on who else is in the block
            for j in range(words[at.SPLITS + i]):
                packet = at.PACKETS + j * at.PACKET_WORDS
                if is_specular(words[packet + 16 * at.FOUND + i]):
                    specular = at.push(work, packet, 1 << i, queues[1], specular)
    return diffuse, specular


@inline
def light_density(light_pdf, distance2, cosine):
    """Density of next-event estimation at a point of a light, as solid angle seen from `distance2` away [1/sr]."""
    return light_pdf * distance2 / cosine
