"""Path tracing at non-specular vertices: emission, next-event estimation, and the rays they send (lanes of a block)."""

import math

import numpy as np

from causticmpi.kernels import bsdf, rng, vec, warp
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import LANES, RAY16, TFAR, VALID, rtc_occluded16
from causticmpi.kernels.eye_path import emitted, facing
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import PHONG
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.path_stages import BRANCH, look_up, number_hits, trace_packet
from causticmpi.kernels.traced_scene import OFFSET, is_specular, pick_light
from causticmpi.kernels.vec import ALMOST_ONE, BLACK, INFINITY, INV_PI, ONE, ZERO

WORTH = np.float32(0.25)
"""Roulette brings the throughput of a path that falls below this back to it."""
SURE_DEPTH = 3
"""From this many non-specular vertices on no path survives for certain, so that white rooms end too."""
_LATTICE = (np.float32(0.8191725134), np.float32(0.6710436067), np.float32(0.5497004779))
"""Steps of the additive recurrence R3 [Roberts 2018]: the rays of a vertex share one random start."""


@inline
def meet(scene, work, lanes, first_split, second_split):
    """Emission, materials and roulette of non-specular vertices. Returns how many of them have gloss."""
    words = work.view(np.int32)
    glossy = 0
    for i in range(LANES):
        work[at.ALIVE + i] = ZERO
        put3(work, at.RADIANCE, i, BLACK)
        if i >= lanes:
            continue
        direction, n = get3(work, at.DIRECTION, i), get3(work, at.NORMAL, i)
        throughput = get3(work, at.THROUGHPUT, i)
        depth = words[at.DEPTH + i]
        if words[at.LIGHT + i] >= 0:
            light = vec.mul(throughput, emitted(scene, words[at.PRIMITIVE + i], n, direction))
            if vec.max3(light) > ZERO and depth > 0 and words[at.CHAIN + i] == 0:
                t = work[at.DISTANCE + i]
                density = light_density(scene.light_pdf[words[at.LIGHT + i]], t * t, -vec.dot(n, direction))
                light = vec.scale(light, work[at.DENSITY + i] / (work[at.DENSITY + i] + density))
            put3(work, at.RADIANCE, i, light)
        material = words[at.MATERIAL + i]
        if vec.max3(bsdf.albedo(scene, material)) <= ZERO:
            continue
        if depth > 0:
            survival = vec.max3(throughput) / WORTH
            survival = min(survival, bsdf.SURVIVAL if depth >= SURE_DEPTH else ONE)
            if work[at.SURVIVE + i] >= survival:
                continue
            throughput = vec.scale(throughput, ONE / survival)
            put3(work, at.THROUGHPUT, i, throughput)
        work[at.ALIVE + i] = ONE
        glossy += scene.kind[material] == PHONG
        put3(work, at.REFLECTANCE, i, vec.row(scene.reflectance, material))
        put3(work, at.NORMAL, i, facing(n, direction))
        split = first_split if depth == 0 else (second_split if depth == 1 else 1)
        work[at.SPLITS + i] = np.float32(split)
    return glossy


@inline
def choose_lights(scene, work):
    """A light for each lane, and where its points are: CORNER + a EDGE1 + b EDGE2."""
    for i in range(LANES):
        if work[at.ALIVE + i] <= ZERO:
            continue
        light, u = pick_light(scene, work[at.LIGHT_U + i])
        work[at.LIGHT_U + i] = u
        corner, e1 = vec.row(scene.light_corner, light), vec.row(scene.light_edge1, light)
        s = scene.light_surface[light]
        n, reach = (s[0], s[1], s[2]), s[3]
        if e1[0] == ZERO and e1[1] == ZERO and e1[2] == ZERO:  # a sphere: the point itself
            reach = max(abs(s[0]), max(abs(s[1]), abs(s[2]))) + s[3]
            n = warp.uniform_sphere(u, work[at.LIGHT_V + i])
            corner = vec.along(corner, n, s[3])
        put3(work, at.CORNER, i, corner)
        put3(work, at.EDGE1, i, e1)
        put3(work, at.EDGE2, i, vec.row(scene.light_edge2, light))
        put3(work, at.LIGHT_NORMAL, i, n)
        work[at.LIGHT_REACH + i] = reach
        work[at.LIGHT_PDF + i] = scene.light_pdf[light]
        put3(work, at.LIGHT_RADIANCE, i, vec.row(scene.light_radiance, light))


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
        put3(work, RAY16 + 64, i, vec.sub(target, origin))
        seen = (work[at.ALIVE + i] > ZERO) & (distance2 > ZERO) & (cosine > ZERO) & (cosine_q > ZERO)
        work[RAY16 + 16 * TFAR + i] = ONE if seen else -ONE
    used = 0
    for i in range(LANES):
        used += work[RAY16 + 16 * TFAR + i] > ZERO
    return used


@inline
def direct_light_on_gloss(scene, work):
    """What `direct_light` has put down for lanes with gloss, put right."""
    words = work.view(np.int32)
    for i in range(LANES):
        material = words[at.MATERIAL + i]
        if work[RAY16 + 16 * TFAR + i] < ZERO or scene.kind[material] != PHONG:
            continue
        n, wi, wo = get3(work, at.NORMAL, i), get3(work, at.TO_LIGHT, i), vec.neg(get3(work, at.DIRECTION, i))
        weight = vec.dot(n, wi) / (work[at.LIGHT_PDF + i] + bsdf.pdf(scene, material, n, wo, wi))
        light = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.LIGHT_RADIANCE, i))
        put3(work, at.CONTRIBUTION, i, vec.scale(vec.mul(light, bsdf.evaluate(scene, material, n, wo, wi)), weight))


@inline
def connect(scene, work, glossy):
    """Next-event estimation: adds what arrives to RADIANCE. Returns the rays traced."""
    choose_lights(scene, work)
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
def deposit(work, film, pixels, lanes):
    """Hand RADIANCE over to the film."""
    words = work.view(np.int32)
    for i in range(lanes):
        radiance = get3(work, at.RADIANCE, i)
        if radiance[0] == ZERO and radiance[1] == ZERO and radiance[2] == ZERO:  # NaN is not: the film counts it
            continue
        slot, column = pixels[words[at.PIXEL + i], 3], 3 * words[at.CAUSTIC + i]
        for c in range(3):
            film[slot, column + c] += radiance[c]


@inline
def most_rays(work, lanes):
    """The most rays that a lane sends."""
    most = ZERO
    for i in range(lanes):
        most = max(most, work[at.SPLITS + i] if work[at.ALIVE + i] > ZERO else ZERO)
    return np.int64(most)


@inline
def bounce(scene, work, j, glossy):
    """The j-th ray of every lane that sends as many, sampled by the BRDF. Returns the rays traced."""
    words = work.view(np.int32)
    first = at.PACKETS + j * at.PACKET_WORDS
    packet = work[first : first + at.PACKET_WORDS]
    step = np.float32(j)
    for i in range(LANES):
        n = get3(work, at.NORMAL, i)
        u, v = fraction(work[at.U + i] + step * _LATTICE[0]), fraction(work[at.V + i] + step * _LATTICE[1])
        put3(packet, 0, i, vec.along(get3(work, at.POINT, i), n, work[at.OFFSET + i]))
        put3(packet, 64, i, vec.to_world(warp.cosine_hemisphere(u, v), n))
        packet[16 * TFAR + i] = INFINITY if (work[at.ALIVE + i] > ZERO) & (step < work[at.SPLITS + i]) else -ONE
    if glossy > 0:
        for i in range(LANES):
            material = words[at.MATERIAL + i]
            if packet[16 * TFAR + i] < ZERO or scene.kind[material] != PHONG:
                continue
            n, wo = get3(work, at.NORMAL, i), vec.neg(get3(work, at.DIRECTION, i))
            u, v = fraction(work[at.U + i] + step * _LATTICE[0]), fraction(work[at.V + i] + step * _LATTICE[1])
            direction = bsdf.sample(scene, material, n, wo, fraction(work[at.CHOICE + i] + step * _LATTICE[2]), u, v)
            put3(packet, 64, i, direction)
            if vec.dot(direction, n) <= ZERO:
                packet[16 * TFAR + i] = -ONE
    used = trace_packet(scene, work, first)
    number_hits(scene, work, first)
    return used


@inline
def fraction(x):
    return min(x - np.float32(np.int32(x)), ALMOST_ONE)


@inline
def queue_bounces(scene, work, queues, lanes, diffuse, specular):
    """Let what the rays of a block have found wait. Returns how many vertices wait in either queue.

    All rays follow light to specular surfaces, at equal shares; other surfaces are for the first ray alone.
    """
    words, keys = work.view(np.int32), work.view(np.uint64)
    for j in range(most_rays(work, lanes)):
        look_up(scene, work, at.PACKETS + j * at.PACKET_WORDS)
    for i in range(lanes):
        if work[at.ALIVE + i] <= ZERO:
            continue
        material = words[at.MATERIAL + i]
        n, wo = get3(work, at.NORMAL, i), vec.neg(get3(work, at.DIRECTION, i))
        depth = words[at.DEPTH + i] + 1
        for j in range(np.int64(work[at.SPLITS + i])):
            packet = at.PACKETS + j * at.PACKET_WORDS
            kind = words[packet + 16 * at.FOUND + i]
            mirrors = is_specular(kind)
            if kind < 0 or (j > 0 and not mirrors):
                continue
            direction = get3(work, packet + 64, i)
            density = bsdf.pdf(scene, material, n, wo, direction)
            throughput = vec.mul(get3(work, at.THROUGHPUT, i), get3(work, at.REFLECTANCE, i))
            if scene.kind[material] == PHONG:
                f = bsdf.evaluate(scene, material, n, wo, direction)
                throughput = vec.scale(vec.mul(get3(work, at.THROUGHPUT, i), f), vec.dot(direction, n) / density)
            key = rng.subkey(keys[at.KEY // 2 + i], BRANCH + j)
            pixel, caustic = words[at.PIXEL + i], words[at.CAUSTIC + i]
            if mirrors:
                throughput = vec.scale(throughput, ONE / work[at.SPLITS + i])
                caustic = np.int32(1) if depth == 1 else caustic
                at.push(scene, work, queues[1], specular, packet, i, throughput, density, key, pixel, depth, 0, caustic)
                specular += 1
            else:
                at.push(scene, work, queues[0], diffuse, packet, i, throughput, density, key, pixel, depth, 0, caustic)
                diffuse += 1
    return diffuse, specular


@inline
def light_density(light_pdf, distance2, cosine):
    """Density of next-event estimation at a point of a light, as solid angle seen from `distance2` away [1/sr]."""
    return light_pdf * distance2 / cosine
