"""What all IWS estimators share: the vertices that wait for their full radiance, and how rays find them.

A vertex on the stack is a non-specular point p with its throughput to the pixel. Its full radiance is Le + L_d + L_c;
the virtual lights of the first vertex are summed for a tile of 16 pixels at once, those of deeper ones for each vertex.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.light_tracing import owns
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import lane_direction, see_packet
from causticmpi.kernels.embree import LANES, intersect, lane_hit
from causticmpi.kernels.eye_path import emitted, facing, follow_chain
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import BLACK, INV_PI, ONE, WHITE, ZERO

CHOICE, DIRECTION, FEW, CHAIN, SAMPLE = 0, 1, 2, 3, 4
"""Dimensions and subkeys of a vertex key; SAMPLE + j names the j-th ray of the vertex."""
STACK = 512
"""Vertices waiting. A depth-first stack holds at most the samples of the first vertex and two of each deeper one."""
DIFFUSIVE, CAUSTIC = 0, 1


class Vertex(NamedTuple):
    """A non-specular vertex that waits for its full radiance.

    p: off its surface by `offset`; n: on the side of the eye; wo: unit direction back to the eye; throughput to the
    pixel; material; depth: non-specular vertices before it; layer its light belongs to; key of its random numbers
    """

    p: Any
    offset: Any
    n: Any
    wo: Any
    throughput: Any
    material: Any
    depth: Any
    layer: Any
    key: Any


class PassWork(NamedTuple):
    """Workspace of a pass: packet (see weak_singularities), per-lane and per-vertex records, the forecast's workspace.

    The stack of `Vertex`: vertex (STACK, 13) float32: p, offset, n, wo, throughput; tag (STACK, 3) int64: material,
    depth, layer; key (STACK,) uint64. lane (16, 5) float32: throughput, in use, and drawn (light tracing owns its
    caustics); lane_material, lane_key (16,); le (16, 3): light of the tile's pixels so far.
    """

    packet: Any
    vertex: Any
    tag: Any
    key: Any
    lane: Any
    lane_material: Any
    lane_key: Any
    le: Any
    forecast: Any


def pass_work(forecast: Any) -> PassWork:
    """Workspace around that of the forecast."""
    return PassWork(
        packet=ws.packet_buffer(),
        vertex=np.zeros((STACK, 13), np.float32),
        tag=np.zeros((STACK, 3), np.int64),
        key=np.zeros(STACK, np.uint64),
        lane=np.zeros((LANES, 5), np.float32),
        lane_material=np.zeros(LANES, np.int64),
        lane_key=np.zeros(LANES, np.uint64),
        le=np.zeros((LANES, 3), np.float32),
        forecast=forecast,
    )


@inline
def see_tile(scene, camera, work, pixels, first, seed, pass_index, splats):
    """Find the first non-specular vertex behind each of 16 pixels. Returns (vertices in use, rays traced).

    splats: light tracing draws the caustics on what it owns of what is seen directly.
    """
    packet = work.packet
    used = 0
    traced = see_packet(scene, camera, packet, pixels, first, seed, pass_index)
    for i in range(LANES):
        for c in range(3):
            packet[ws.NORMAL + 16 * c + i] = ZERO
            work.le[i, c] = ZERO
        packet[ws.EPSILON + i] = ZERO
        work.lane[i, 3] = work.lane[i, 4] = ZERO
        if pixels[first + i, 0] < 0:
            continue
        key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[first + i, 2])
        origin, direction = vec.row(camera, 0), lane_direction(packet, i)
        seen, t = lane_hit(scene.triangle_count, packet, i)
        primitive, p, n, offset, direction, throughput, more = follow_chain(
            scene, packet, origin, direction, seen, t, WHITE, rng.subkey(key, CHAIN)
        )
        traced += more
        if primitive < 0:
            continue
        light = vec.mul(throughput, emitted(scene, primitive, n, direction))
        material = np.int64(scene.material[primitive])
        for c in range(3):
            work.le[i, c] = light[c]
        if vec.max3(bsdf.albedo(scene, material)) <= ZERO:
            continue
        n = facing(n, direction)
        p = vec.along(p, n, offset)
        for c in range(3):
            packet[ws.POINT + 16 * c + i] = p[c]
            packet[ws.NORMAL + 16 * c + i] = n[c]
            packet[ws.OUT + 16 * c + i] = -direction[c]
            work.lane[i, c] = throughput[c]
        packet[ws.EPSILON + i] = offset
        work.lane[i, 3] = ONE
        if splats and not is_specular(scene.kind[scene.material[seen]]) and owns(scene, material):
            work.lane[i, 4] = ONE
        work.lane_material[i] = material
        work.lane_key[i] = key
        used += 1
    return used, traced


@inline
def gather_lights(scene, work, lights, count, bound):
    """Add all virtual lights to `work.le` of a tile. Returns shadow rays traced."""
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
                work.le[i, c] += work.lane[i, c] * x
    return traced


@inline
def gather_few(scene, work, lights, count, few, at, bound):
    """An unbiased few of the virtual lights at a vertex (weak_singularities), without its throughput.

    Returns RGB radiance, shadow rays traced.
    """
    u, _ = rng.uniform2(at.key, FEW)
    packet = work.packet
    return ws.gather_few(scene, packet, lights, count, few, at.p, at.n, at.offset, at.wo, at.material, bound, u)


@inline
def push(work, top, at):
    """Put a vertex on the stack; returns the new top."""
    row = work.vertex[top]
    row[0], row[1], row[2] = at.p
    row[3] = at.offset
    row[4], row[5], row[6] = at.n
    row[7], row[8], row[9] = at.wo
    row[10], row[11], row[12] = at.throughput
    work.tag[top, 0], work.tag[top, 1], work.tag[top, 2] = at.material, at.depth, at.layer
    work.key[top] = at.key
    return top + 1


@inline
def push_lane(work, lane):
    """Put the first vertex of a lane on the empty stack; returns the top, 0 for a lane out of use."""
    if work.lane[lane, 3] == ZERO:
        return 0
    packet = work.packet
    first = Vertex(
        (packet[ws.POINT + lane], packet[ws.POINT + 16 + lane], packet[ws.POINT + 32 + lane]),
        packet[ws.EPSILON + lane],
        (packet[ws.NORMAL + lane], packet[ws.NORMAL + 16 + lane], packet[ws.NORMAL + 32 + lane]),
        (packet[ws.OUT + lane], packet[ws.OUT + 16 + lane], packet[ws.OUT + 32 + lane]),
        vec.row(work.lane, lane),
        work.lane_material[lane],
        0,
        DIFFUSIVE,
        rng.subkey(work.lane_key[lane], SAMPLE),
    )
    return push(work, 0, first)


@inline
def pop(work, top):
    """The vertex below `top`."""
    row = work.vertex[top - 1]
    return Vertex(
        (row[0], row[1], row[2]),
        row[3],
        (row[4], row[5], row[6]),
        (row[7], row[8], row[9]),
        (row[10], row[11], row[12]),
        work.tag[top - 1, 0],
        work.tag[top - 1, 1],
        work.tag[top - 1, 2],
        work.key[top - 1],
    )


@inline
def land(scene, work, top, at, direction, weight, primitive, t, bound, survive, key):
    """What a ray from vertex `at` brings home. (primitive, t) is its hit; weight: the ray's throughput to the pixel.

    On D: the compensation, the radiance of that vertex times 1 - w (eq. w of weak_singularities). On S: a caustic, the
    whole radiance of the vertex at the end of the specular chain. The vertex is pushed if it lives through the
    roulette.
    Returns new top, the layer its light belongs to, emitted light seen, rays traced, vertices lost to a full stack.
    """
    caustic = is_specular(scene.kind[scene.material[primitive]])
    hit_layer = CAUSTIC if (at.depth == 0 and caustic) else at.layer
    distance = t
    primitive, q, m, offset, arrived, weight, traced = follow_chain(
        scene, work.packet, at.p, direction, primitive, t, weight, rng.subkey(key, CHAIN)
    )
    if primitive < 0:
        return top, hit_layer, BLACK, traced, 0
    light = vec.mul(weight, emitted(scene, primitive, m, arrived))
    m = facing(m, arrived)
    other = np.int64(scene.material[primitive])
    if not caustic:
        geometry = vec.dot(at.n, direction) * -vec.dot(m, direction) / (distance * distance)
        sharp = ws.sharpness(bsdf.evaluate(scene, at.material, at.n, at.wo, direction))
        light = vec.scale(light, ONE - ws.bounded_share(geometry, sharp, bound))
        weight = vec.scale(weight, ONE - ws.bounded_share(geometry, sharp * bsdf.peak(scene, other), bound))
    survival = min(bsdf.SURVIVAL, vec.max3(vec.mul(weight, bsdf.albedo(scene, other))))
    if survive >= survival:
        return top, hit_layer, light, traced, 0
    if top >= STACK:
        return top, hit_layer, light, traced, 1
    found = Vertex(
        vec.along(q, m, offset),
        offset,
        m,
        vec.neg(arrived),
        vec.scale(weight, ONE / survival),
        other,
        at.depth + 1,
        hit_layer,
        rng.subkey(key, SAMPLE),
    )
    return push(work, top, found), hit_layer, light, traced, 0


@inline
def compensate(scene, work, top, at, bound, reach):
    """One BRDF ray from vertex `at` for what the bound takes from its virtual lights; what it hits on S counts nothing.

    reach: sqrt(largest peak / bound); beyond sqrt(cos sharpness) of it G s <= b for any surface.
    Returns new top, what it adds to the layer of the vertex, rays traced, vertices lost to a full stack.
    """
    key = rng.subkey(at.key, SAMPLE)
    choice, survive = rng.uniform2(key, CHOICE)
    u, v = rng.uniform2(key, DIRECTION)
    direction, weight = bsdf.sample_weight(scene, at.material, at.n, at.wo, choice, u, v)
    cosine = vec.dot(at.n, direction)
    weight = vec.mul(at.throughput, weight)
    if cosine <= ZERO or vec.max3(weight) <= ZERO:
        return top, BLACK, 0, 0
    sharp = ws.sharpness(bsdf.evaluate(scene, at.material, at.n, at.wo, direction))
    far = math.sqrt(cosine * sharp) * reach
    primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, at.p, direction, far)
    if primitive < 0 or is_specular(scene.kind[scene.material[primitive]]):
        return top, BLACK, 1, 0
    top, _, light, traced, lost = land(scene, work, top, at, direction, weight, primitive, t, bound, survive, key)
    return top, light, 1 + traced, lost
