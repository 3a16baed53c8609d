"""One pass of IWS+CF over some pixels: L = L_d by virtual lights and compensation, L_c by forecast caustic samples.

At every non-specular vertex p of an eye path:
  A  L_d: the virtual lights, all of them at the first vertex, an unbiased few at deeper ones;
  B  L_d: one BRDF ray, the compensation; what it hits on D counts with 1 - w and carries its full radiance;
  C  L_c: 2 S directions from the forecast tables; what they hit on S leads to a D vertex that carries its full
  radiance.
Outside the ranked clusters one BRDF ray serves B and C: a hit on D is B's, a hit on S is C's.
A vertex that carries its full radiance is put on a stack and treated alike, one diffuse depth deeper, so there is no
depth cut-off; roulette ends the paths.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.estimators import caustic_forecast as cf
from causticmpi.estimators import weak_singularities as ws
from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import lane_direction, see_packet
from causticmpi.kernels.embree import intersect, lane_hit
from causticmpi.kernels.eye_path import emitted, facing, follow_chain
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import is_specular
from causticmpi.kernels.vec import BLACK, INFINITY, INV_PI, ONE, WHITE, ZERO
from causticmpi.preprocess.forecast import cluster_of

CHOICE, DIRECTION, FEW, CHAIN, SAMPLE = 0, 1, 2, 3, 4
"""Dimensions and subkeys of a vertex key; SAMPLE + j names the j-th ray of the vertex."""
STACK = 512
"""Vertices waiting. A depth-first stack holds at most 2 S + 1 of the first vertex and two of each deeper one."""
DIFFUSIVE, CAUSTIC = 0, 1


class PassWork(NamedTuple):
    """Workspace of a pass: packet (see weak_singularities), per-lane and per-vertex records, the forecast's workspace.

    vertex (STACK, 13) float32: p (off its surface), offset, n, wo, throughput; tag (STACK, 3) int64: material, depth,
    layer; key (STACK,) uint64. lane (16, 4) float32: throughput and in use; lane_material, lane_key (16,); le (16, 3).
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


def pass_work(maps: Any) -> PassWork:
    """Workspace that fits the forecast maps."""
    return PassWork(
        packet=ws.packet_buffer(),
        vertex=np.zeros((STACK, 13), np.float32),
        tag=np.zeros((STACK, 3), np.int64),
        key=np.zeros(STACK, np.uint64),
        lane=np.zeros((16, 4), np.float32),
        lane_material=np.zeros(16, np.int64),
        lane_key=np.zeros(16, np.uint64),
        le=np.zeros((16, 3), np.float32),
        forecast=cf.forecast_work(maps),
    )


@inline
def _push(work, top, p, offset, n, wo, throughput, material, depth, layer, key):
    """Put a vertex on the stack; returns the new top."""
    row = work.vertex[top]
    row[0], row[1], row[2], row[3] = p[0], p[1], p[2], offset
    row[4], row[5], row[6] = n
    row[7], row[8], row[9] = wo
    row[10], row[11], row[12] = throughput
    work.tag[top, 0], work.tag[top, 1], work.tag[top, 2] = material, depth, layer
    work.key[top] = key
    return top + 1


@inline
def _see_tile(scene, camera, work, pixels, first, seed, pass_index):
    """Find the first non-specular vertex behind each of 16 pixels. Returns (vertices in use, rays traced)."""
    packet = work.packet
    used = 0
    traced = see_packet(scene, camera, packet, pixels, first, seed, pass_index)
    for i in range(16):
        for c in range(3):
            packet[ws.NORMAL + 16 * c + i] = ZERO
            work.le[i, c] = ZERO
        packet[ws.EPSILON + i] = ZERO
        work.lane[i, 3] = ZERO
        if pixels[first + i, 0] < 0:
            continue
        key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[first + i, 2])
        origin, direction = vec.row(camera, 0), lane_direction(packet, i)
        primitive, t = lane_hit(scene.triangle_count, packet, i)
        primitive, p, n, offset, direction, throughput, more = follow_chain(
            scene, packet, origin, direction, primitive, t, WHITE, rng.subkey(key, CHAIN)
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
        work.lane_material[i] = material
        work.lane_key[i] = key
        used += 1
    return used, traced


@inline
def _gather_lights(scene, work, lights, count, bound):
    """A for a tile: adds the virtual lights to `work.le`. Returns shadow rays traced."""
    packet = work.packet
    glossy = False
    for i in range(16):
        if work.lane[i, 3] > ZERO and scene.kind[work.lane_material[i]] != 0:
            glossy = True
    traced = ws.gather_tile(scene, packet, lights, count, work.lane_material, glossy, bound)
    for i in range(16):
        if work.lane[i, 3] > ZERO:
            for c in range(3):
                x = packet[ws.SUM + 16 * c + i]
                if not glossy:
                    x *= scene.reflectance[work.lane_material[i], c] * INV_PI
                work.le[i, c] += work.lane[i, c] * x
    return traced


@inline
def _carries_light(throughput, u):
    """Roulette: (scale of the throughput, 0 where the path ends). `u`: uniform."""
    survival = min(bsdf.SURVIVAL, vec.max3(throughput))
    return ZERO if u >= survival else ONE / survival


@inline
def _expand(scene, work, lights, count, maps, few, bound, compensation_reach, caustics, top):
    """Take the vertex on top of the stack, estimate its radiance, push the vertices that carry light to it.

    Returns the new top, what the vertex adds to its layer and, at depth 0, to L_c; rays traced, and vertices lost to a
    full stack.
    """
    top -= 1
    row = work.vertex[top]
    p, offset = (row[0], row[1], row[2]), row[3]
    n, wo = (row[4], row[5], row[6]), (row[7], row[8], row[9])
    throughput = (row[10], row[11], row[12])
    material, depth, layer = work.tag[top, 0], work.tag[top, 1], work.tag[top, 2]
    key = work.key[top]
    own, caustic = BLACK, BLACK
    traced, lost = 0, 0
    if depth > 0:
        start, _ = rng.uniform2(key, FEW)
        light, shadows = ws.gather_few(scene, work.packet, lights, count, few, p, n, offset, wo, material, bound, start)
        own = vec.mul(throughput, light)
        traced += shadows
    samples, occupied = 0, 0
    total1, total2 = ZERO, ZERO
    if maps.codebook.shape[1] > 0 and caustics:
        cluster = cluster_of(maps, p, n, work.forecast.codeword_distance)
        samples = cf.splitting(maps, maps.rank[cluster], depth)
        if samples > 0:
            k = cf.gather(maps, work.forecast, cluster, p)
            occupied, total1 = cf.fill_table1(scene, maps, work.forecast, k, n, wo, material)
            total2 = cf.fill_table2(scene, maps, work.forecast, occupied, n, wo, material)
    steered = samples > 0
    share = ONE / np.float32(max(samples, 1))
    for j in range(1 + 2 * samples):
        ray_key = rng.subkey(key, SAMPLE + j)
        reach = INFINITY
        choice, survive = rng.uniform2(ray_key, CHOICE)
        u, v = rng.uniform2(ray_key, DIRECTION)
        if j == 0:
            direction, weight = bsdf.sample_weight(scene, material, n, wo, choice, u, v)
            cosine = vec.dot(n, direction)
            if cosine <= ZERO:
                continue
            if steered:  # the ray is the compensation alone: beyond this distance G s <= b for any surface
                f = bsdf.evaluate(scene, material, n, wo, direction)
                reach = math.sqrt(cosine * ws.sharpness(f)) * compensation_reach
        elif j <= samples:
            if total1 <= ZERO:
                continue
            local, probability = cf.sample_table1(maps, work.forecast, occupied, total1, choice, u, v)
        else:
            if total2 <= ZERO:
                continue
            local, probability = cf.sample_table2(scene, maps, work.forecast, material, total2, choice, u, v)
        if j > 0:
            direction = vec.to_world(local, n)
            f = bsdf.evaluate(scene, material, n, wo, direction)
            weight = vec.scale(f, max(ZERO, local[2]) * share / (probability * cf.bin_density(maps)))
        weight = vec.mul(throughput, weight)
        if vec.max3(weight) <= ZERO:
            continue
        primitive, t = intersect(scene.handle, scene.triangle_count, work.packet, p, direction, reach)
        traced += 1
        if primitive < 0:
            continue
        on_specular = is_specular(scene.kind[scene.material[primitive]])
        if on_specular:
            if (j == 0 and steered) or not (caustics or depth > 0):
                continue
        elif j > 0:
            continue
        hit_layer = CAUSTIC if (depth == 0 and on_specular) else layer
        far = t
        primitive, q, m, offset_q, arrived, weight, more = follow_chain(
            scene, work.packet, p, direction, primitive, t, weight, rng.subkey(ray_key, CHAIN)
        )
        traced += more
        if primitive < 0:
            continue
        emission = emitted(scene, primitive, m, arrived)
        m = facing(m, arrived)
        other = np.int64(scene.material[primitive])
        reflected = weight
        if not on_specular:  # B: give back what the bound took away
            geometry = vec.dot(n, direction) * -vec.dot(m, direction) / (far * far)
            sharp = ws.sharpness(bsdf.evaluate(scene, material, n, wo, direction))
            emission = vec.scale(emission, ONE - ws.bounded_share(geometry, sharp, bound))
            reflected = vec.scale(weight, ONE - ws.bounded_share(geometry, sharp * bsdf.peak(scene, other), bound))
        light = vec.mul(weight, emission)
        if hit_layer == layer:
            own = vec.add(own, light)
        else:
            caustic = vec.add(caustic, light)
        reflected_bound = vec.mul(reflected, bsdf.albedo(scene, other))
        if vec.max3(reflected_bound) <= ZERO:
            continue
        alive = _carries_light(reflected_bound, survive)
        if alive <= ZERO:
            continue
        if top >= STACK:
            lost += 1
            continue
        top = _push(
            work,
            top,
            vec.along(q, m, offset_q),
            offset_q,
            m,
            vec.neg(arrived),
            vec.scale(reflected, alive),
            other,
            depth + 1,
            hit_layer,
            rng.subkey(ray_key, SAMPLE),
        )
    cf.clear_tables(work.forecast, occupied)
    return top, layer, own, caustic, traced, lost


@kernel
def trace_iws_cf(
    scene, camera, work, pixels, seed, pass_index, lights, count, maps, few, bound, most_peak, caustics, film
):
    """One sample of L_d and, with `caustics`, of L_c for every row of `pixels` (n, 4), n a multiple of 16.

    lights, count: virtual lights of the pass; maps: forecast maps, without codewords where there is no forecast;
    bound: b [units^-2]; most_peak: largest `bsdf.peak` of the scene. Adds to `film`.
    Returns (rays traced, vertices lost to a full stack: 0 unless something is badly wrong).
    """
    traced, lost = 0, 0
    bound = np.float32(bound)
    compensation_reach = math.sqrt(np.float32(most_peak) / bound)
    packet = work.packet
    for first in range(0, pixels.shape[0], 16):
        used, rays = _see_tile(scene, camera, work, pixels, first, seed, pass_index)
        traced += rays
        if used > 0:
            traced += _gather_lights(scene, work, lights, count, bound)
        for i in range(16):
            if pixels[first + i, 0] < 0:
                continue
            diffusive = vec.row(work.le, i)
            caustic = BLACK
            top = 0
            if work.lane[i, 3] > ZERO:
                top = _push(
                    work,
                    0,
                    (packet[ws.POINT + i], packet[ws.POINT + 16 + i], packet[ws.POINT + 32 + i]),
                    packet[ws.EPSILON + i],
                    (packet[ws.NORMAL + i], packet[ws.NORMAL + 16 + i], packet[ws.NORMAL + 32 + i]),
                    (packet[ws.OUT + i], packet[ws.OUT + 16 + i], packet[ws.OUT + 32 + i]),
                    vec.row(work.lane, i),
                    work.lane_material[i],
                    0,
                    DIFFUSIVE,
                    rng.subkey(work.lane_key[i], SAMPLE),
                )
            while top > 0:
                top, layer, own, extra, rays, missing = _expand(
                    scene, work, lights, count, maps, few, bound, compensation_reach, caustics, top
                )
                traced += rays
                lost += missing
                if layer == DIFFUSIVE:
                    diffusive = vec.add(diffusive, own)
                else:
                    caustic = vec.add(caustic, own)
                caustic = vec.add(caustic, extra)
            add_sample(film, pixels[first + i, 3], diffusive, caustic)
    return traced, lost
