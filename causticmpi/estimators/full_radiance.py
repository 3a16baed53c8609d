"""What all IWS estimators share: a tile of 16 pixels, its vertices that wait for their full radiance, and their rays.

The full radiance of a vertex is Le + L_d + L_c; the virtual lights of the first vertices are summed for the tile at
once, those of deeper ones for each vertex. An estimator has up to 16 vertices send their rays; ray j of all of them is
then one packet, whose specular chains are followed side by side, and the next vertices are taken from those that wait
(`trace`). What a pixel gets is in `PassWork.light`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.light_tracing import owns
from causticmpi.estimators.vertices import WAITING, Vertex, Vertices, empty_vertices, get, put, take
from causticmpi.kernels import bsdf, lanes, rng, vec
from causticmpi.kernels.camera import see_packet
from causticmpi.kernels.embree import (
    DIR,
    LANES,
    RAY16,
    TFAR,
    intersect_packet,
    lane_direction,
    lane_hit,
    lane_origin,
)
from causticmpi.kernels.eye_path import emitted, facing, follow_chains
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import has_specular, hit_point
from causticmpi.kernels.vec import INV_PI, ONE, WHITE, ZERO

CHOICE, DIRECTION, FEW, CHAIN, SAMPLE = 0, 1, 2, 3, 4
"""Dimensions and subkeys of a vertex key; SAMPLE + j names the j-th ray of the vertex."""
DIFFUSIVE, CAUSTIC = 0, 1
ANYTHING, ON_DIFFUSE, ON_SPECULAR = 0, 1, 2
"""What counts of what a ray hits: on D it is a compensation, on S a caustic."""
RAY_WORDS = 8
PACKET_WORDS = RAY_WORDS * LANES
OUT_OF_USE = np.float32(-1)


class Rays(NamedTuple):
    """Rays to send: lane i of packet j is the j-th of vertex i.

    reals (packets, 8, 16) float32: direction, throughput to the pixel, random number of the roulette, reach (OUT_OF_USE
    for none); counts (packets, 16) int64: ANYTHING, ON_DIFFUSE or ON_SPECULAR; key (packets, 16) uint64
    """

    reals: Any
    counts: Any
    key: Any


class Hits(NamedTuple):
    """What a packet has hit, by lane: first float32: distance of the first hit; caustic bool: whether that is on S;
    primitive int64, distance float32: of the end of the specular chain; throughput (16, 3), key of the chain."""

    first: Any
    caustic: Any
    primitive: Any
    distance: Any
    throughput: Any
    key: Any


class PassWork(NamedTuple):
    """Workspace of a pass: packet (see weak_singularities), the vertices that wait and those worked on, the rays of
    these, what a packet of rays has hit, and the forecast's workspace.

    lane (16, 5) float32: throughput of the first vertex, in use, and drawn (light tracing owns its caustics);
    lane_material, lane_key (16,); light (16, 6): L_d and L_c of the tile's pixels so far.
    """

    packet: Any
    waiting: Vertices
    now: Vertices
    rays: Rays
    hits: Hits
    lane: Any
    lane_material: Any
    lane_key: Any
    light: Any
    forecast: Any


def pass_work(forecast: Any, most_rays: int) -> PassWork:
    """Workspace around that of the forecast; most_rays: that a vertex sends."""
    rays = Rays(
        np.full((most_rays, RAY_WORDS, LANES), OUT_OF_USE, np.float32),
        np.zeros((most_rays, LANES), np.int64),
        np.zeros((most_rays, LANES), np.uint64),
    )
    hits = Hits(
        np.zeros(LANES, np.float32),
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.float32),
        np.zeros((LANES, 3), np.float32),
        np.zeros(LANES, np.uint64),
    )
    return PassWork(
        packet=ws.packet_buffer(),
        waiting=empty_vertices(WAITING + 2 * LANES * most_rays),
        now=empty_vertices(LANES),
        rays=rays,
        hits=hits,
        lane=np.zeros((LANES, 5), np.float32),
        lane_material=np.zeros(LANES, np.int64),
        lane_key=np.zeros(LANES, np.uint64),
        light=np.zeros((LANES, 6), np.float32),
        forecast=forecast,
    )


@inline
def see_tile(scene, camera, work, pixels, first, seed, pass_index, splats, sides):
    """Find the first non-specular vertex behind each of 16 pixels. Returns (vertices in use, rays traced).

    splats: light tracing draws the caustics on what it owns of what is seen directly; sides (pixels of the whole film,)
    uint8: of the grid of looks at lamps (lamps_in_sight); at 0, and everywhere if empty, what is met of lamps is added
    here.
    """
    packet, hits, lane = work.packet, work.hits, work.lane
    traced = see_packet(scene, camera, packet, pixels, first, seed, pass_index)
    for i in range(LANES):
        lane[i, 3] = lane[i, 4] = ZERO
        hits.primitive[i], hits.distance[i] = lane_hit(scene.triangle_count, packet, i)
        hits.throughput[i, 0], hits.throughput[i, 1], hits.throughput[i, 2] = WHITE
        work.lane_key[i] = rng.make_key(seed, rng.CAMERA, pass_index, pixels[first + i, 2])
        hits.key[i] = rng.subkey(work.lane_key[i], CHAIN)
        if splats and hits.primitive[i] >= 0 and not has_specular(scene, hits.primitive[i]):
            lane[i, 4] = ONE
    traced += follow_chains(scene, packet, hits.primitive, hits.distance, hits.throughput, hits.key)
    used = 0
    for i in range(LANES):
        for c in range(6):
            work.light[i, c] = ZERO
        for c in range(3):
            packet[ws.NORMAL + 16 * c + i] = ZERO
        packet[ws.EPSILON + i] = ZERO
        primitive = hits.primitive[i]
        if primitive < 0:
            continue
        direction, throughput = lane_direction(packet, i), vec.row(hits.throughput, i)
        p, n, offset = hit_point(scene, primitive, lane_origin(packet, i), direction, hits.distance[i])
        material = np.int64(scene.material[primitive])
        if sides.shape[0] == 0 or sides[pixels[first + i, 2]] == 0:
            add_light(work, i, DIFFUSIVE, vec.mul(throughput, emitted(scene, primitive, n, direction)))
        if vec.max3(bsdf.albedo(scene, material)) <= ZERO:
            continue
        n = facing(n, direction)
        p = vec.along(p, n, offset)
        for c in range(3):
            packet[ws.POINT + 16 * c + i] = p[c]
            packet[ws.NORMAL + 16 * c + i] = n[c]
            packet[ws.OUT + 16 * c + i] = -direction[c]
            lane[i, c] = throughput[c]
        packet[ws.EPSILON + i] = offset
        lane[i, 3] = ONE
        if not owns(scene, material):
            lane[i, 4] = ZERO
        work.lane_material[i] = material
        used += 1
    return used, traced


@inline
def gather_lights(scene, work, lights, count, bound):
    """Add all virtual lights to the light of a tile. Returns shadow rays traced."""
    packet = work.packet
    glossy = False
    for i in range(LANES):
        if work.lane[i, 3] > ZERO and scene.kind[work.lane_material[i]] != DIFFUSE:
            glossy = True
    traced = ws.gather_tile(scene, packet, lights, count, work.lane_material, glossy, bound)
    for i in range(LANES):
        if work.lane[i, 3] > ZERO:
            for c in range(3):
                x = packet[ws.SUM + 16 * c + i]
                if not glossy:
                    x *= scene.reflectance[work.lane_material[i], c] * INV_PI
                work.light[i, c] += work.lane[i, c] * x
    return traced


@inline
def add_light(work, lane, layer, light):
    """To a pixel of the tile."""
    for c in range(3):
        work.light[lane, 3 * layer + c] += light[c]


@inline
def gather_few(scene, work, lights, count, few, at, bound):
    """Add an unbiased few of the virtual lights of a vertex (weak_singularities). Returns shadow rays traced."""
    u, _ = rng.uniform2(at.key, FEW)
    packet = work.packet
    light, traced = ws.gather_few(
        scene, packet, lights, count, few, at.p, at.n, at.offset, at.wo, at.material, bound, u
    )
    add_light(work, at.lane, at.layer, vec.mul(at.throughput, light))
    return traced


@inline
def first_vertex(work, lane):
    """The first vertex of a lane, which is in use."""
    packet = work.packet
    return Vertex(
        (packet[ws.POINT + lane], packet[ws.POINT + 16 + lane], packet[ws.POINT + 32 + lane]),
        packet[ws.EPSILON + lane],
        (packet[ws.NORMAL + lane], packet[ws.NORMAL + 16 + lane], packet[ws.NORMAL + 32 + lane]),
        (packet[ws.OUT + lane], packet[ws.OUT + 16 + lane], packet[ws.OUT + 32 + lane]),
        vec.row(work.lane, lane),
        work.lane_material[lane],
        0,
        DIFFUSIVE,
        lane,
        rng.subkey(work.lane_key[lane], SAMPLE),
    )


@inline
def send(work, i, j, direction, weight, reach, survive, key, counts):
    """Let the j-th ray of vertex i wait for its packet. weight: its throughput to the pixel; reach: beyond it nothing
    counts; counts: of ANYTHING, ON_DIFFUSE, ON_SPECULAR."""
    ray = work.rays.reals[j]
    for c in range(3):
        ray[c, i], ray[3 + c, i] = direction[c], weight[c]
    ray[6, i] = survive
    ray[7, i] = reach if vec.max3(weight) > ZERO else OUT_OF_USE
    work.rays.counts[j, i] = counts
    work.rays.key[j, i] = key


@inline
def compensate(scene, work, i, at, reach):
    """One BRDF ray from vertex i for what the bound takes from its virtual lights; what it hits on S counts nothing.

    reach: sqrt(largest peak / bound); beyond sqrt(cos sharpness) of it G s <= b for any surface.
    """
    key = rng.subkey(at.key, SAMPLE)
    choice, survive = rng.uniform2(key, CHOICE)
    u, v = rng.uniform2(key, DIRECTION)
    direction, weight = bsdf.sample_weight(scene, at.material, at.n, at.wo, choice, u, v)
    cosine = vec.dot(at.n, direction)
    if cosine > ZERO:
        sharp = ws.sharpness(bsdf.evaluate(scene, at.material, at.n, at.wo, direction))
        far = math.sqrt(cosine * sharp) * reach
        send(work, i, 0, direction, vec.mul(at.throughput, weight), far, survive, key, ON_DIFFUSE)


@inline
def trace(scene, work, top, bound):
    """Trace the rays of the vertices in `work.now`: light they see goes to its pixel, vertices they find wait behind
    the `top` others. The last of all are then taken into `work.now`, to be worked on next.

    Returns how many wait still, how many were taken, rays traced, vertices lost for want of room.
    """
    packet, rays, hits = work.packet, work.rays, work.hits
    traced, lost = 0, 0
    for j in range(rays.counts.shape[0]):
        ray = rays.reals[j]
        sent = 0
        for i in range(LANES):
            sent += ray[7, i] > ZERO
        if sent == 0:
            continue
        for c in range(3):
            lanes.copy(rays.reals, PACKET_WORDS * j + LANES * c, packet, RAY16 + 16 * (DIR + c))
        lanes.copy(rays.reals, PACKET_WORDS * j + LANES * 7, packet, RAY16 + 16 * TFAR)
        for i in range(LANES):
            for c in range(3):
                packet[RAY16 + 16 * c + i] = work.now.reals[i, c]
                hits.throughput[i, c] = ray[3 + c, i]
        intersect_packet(scene.handle, packet)
        traced += sent
        for i in range(LANES):
            primitive, t = lane_hit(scene.triangle_count, packet, i)
            if primitive >= 0:
                caustic = has_specular(scene, primitive)
                if rays.counts[j, i] == (ON_DIFFUSE if caustic else ON_SPECULAR):
                    primitive = np.int64(-1)
                hits.first[i], hits.caustic[i] = t, caustic
                hits.key[i] = rng.subkey(rays.key[j, i], CHAIN)
            hits.primitive[i], hits.distance[i] = primitive, t
        traced += follow_chains(scene, packet, hits.primitive, hits.distance, hits.throughput, hits.key)
        for i in range(LANES):
            if hits.primitive[i] >= 0:
                top, missing = _land(scene, work, top, i, j, bound)
                lost += missing
        for i in range(LANES):
            ray[7, i] = OUT_OF_USE
    top, taken = take(work.waiting, work.now, top)
    return top, taken, traced, lost


@inline
def _land(scene, work, top, i, j, bound):
    """What the j-th ray of vertex i brings home.

    On D: the compensation, the radiance of that vertex times 1 - w (eq. w of weak_singularities). On S: a caustic, the
    whole radiance of the vertex at the end of the specular chain. The vertex waits if it lives through the roulette.
    Returns how many wait now, vertices lost for want of room.
    """
    at, hits = get(work.now, i), work.hits
    distance, caustic = hits.first[i], hits.caustic[i]
    layer = np.int64(CAUSTIC) if (at.depth == 0 and caustic) else at.layer
    primitive, arrived = hits.primitive[i], lane_direction(work.packet, i)
    weight = vec.row(hits.throughput, i)
    q, m, offset = hit_point(scene, primitive, lane_origin(work.packet, i), arrived, hits.distance[i])
    light = vec.mul(weight, emitted(scene, primitive, m, arrived))
    m = facing(m, arrived)
    other = np.int64(scene.material[primitive])
    if not caustic:
        geometry = vec.dot(at.n, arrived) * -vec.dot(m, arrived) / (distance * distance)
        sharp = ws.sharpness(bsdf.evaluate(scene, at.material, at.n, at.wo, arrived))
        light = vec.scale(light, ONE - ws.bounded_share(geometry, sharp, bound))
        weight = vec.scale(weight, ONE - ws.bounded_share(geometry, sharp * bsdf.peak(scene, other), bound))
    add_light(work, at.lane, layer, light)
    survival = min(bsdf.SURVIVAL, vec.max3(vec.mul(weight, bsdf.albedo(scene, other))))
    if work.rays.reals[j, 6, i] >= survival:
        return top, 0
    if top >= work.waiting.key.shape[0]:
        return top, 1
    found = Vertex(
        vec.along(q, m, offset),
        offset,
        m,
        vec.neg(arrived),
        vec.scale(weight, ONE / survival),
        other,
        at.depth + 1,
        layer,
        at.lane,
        rng.subkey(work.rays.key[j, i], SAMPLE),
    )
    put(work.waiting, top, found)
    return top + 1, 0


@inline
def deposit(work, pixels, first, film):
    """Hand the light of the tile over to the film."""
    for i in range(LANES):
        if pixels[first + i, 0] >= 0:
            light = work.light[i]
            add_sample(film, pixels[first + i, 3], (light[0], light[1], light[2]), (light[3], light[4], light[5]))
