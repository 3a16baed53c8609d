"""Path tracing (PT), the unbiased rival: with next-event estimation, and by brute force.

Both tell the diffusive and the caustic part apart as IWS does: a path belongs to L_c if the first surface seen from its
first non-specular vertex p is specular, else to L_d (with what is seen directly).
"""

import math

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import lane_direction, see_packet
from causticmpi.kernels.embree import LANES, intersect, lane_hit, visible
from causticmpi.kernels.eye_path import emitted, facing, scatter_along_eye_path
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import hit_point, is_specular, light_point, pick_light
from causticmpi.kernels.vec import BLACK, INFINITY, ONE, WHITE, ZERO

ROULETTE_START = 3
"""Diffuse vertices before Russian roulette sets in; before it roulette costs more noise than it saves time."""
CHOICE, DIRECTION, LIGHT = 0, 1, 2
"""Dimensions of a vertex key."""


@inline
def light_density(scene, light, distance2, cosine):
    """Density of next-event estimation at a point of a light, as solid angle seen from `distance2` away [1/sr]."""
    return scene.light_pdf[light] * distance2 / cosine


@inline
def direct_light(scene, rays, p, n, offset, material, wo, key):
    """Next-event estimate of the light that reaches p straight from an emitter and leaves towards wo.

    Weighted against BRDF sampling by the balance heuristic. Returns (RGB radiance, rays traced).
    """
    u, v = rng.uniform2(key, LIGHT)
    light, u = pick_light(scene, u)
    q, n_q, offset_q = light_point(scene, light, u, v)
    d = vec.sub(q, p)
    distance2 = vec.dot(d, d)
    if distance2 <= ZERO:
        return BLACK, 0
    wi = vec.scale(d, ONE / math.sqrt(distance2))
    cosine, cosine_q = vec.dot(n, wi), -vec.dot(n_q, wi)
    if cosine <= ZERO or cosine_q <= ZERO:
        return BLACK, 0
    if not visible(scene.handle, rays, vec.along(p, n, offset), vec.along(q, n_q, max(offset, offset_q))):
        return BLACK, 1
    density = light_density(scene, light, distance2, cosine_q)
    weight = cosine / (density + bsdf.pdf(scene, material, n, wo, wi))  # balance heuristic [Veach 1997, (9.8)]
    f = bsdf.evaluate(scene, material, n, wo, wi)
    return vec.scale(vec.mul(f, vec.row(scene.light_radiance, light)), weight), 1


@kernel
def trace_paths(scene, camera, rays, pixels, seed, pass_index, film):
    """One path a pixel with next-event estimation and roulette; adds to `film` (see kernels.pixels). Returns rays
    traced."""
    traced = 0
    for i in range(pixels.shape[0]):
        if i % LANES == 0:
            traced += see_packet(scene, camera, rays, pixels, i, seed, pass_index)
        if pixels[i, 0] < 0:
            continue
        key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[i, 2])
        primitive, t = lane_hit(scene.triangle_count, rays, i % LANES)
        origin, direction = vec.row(camera, 0), lane_direction(rays, i % LANES)
        throughput, diffusive, caustic = WHITE, BLACK, BLACK
        depth, chain, bounce = 0, 0, 0  # D vertices so far; S vertices since the last D; all vertices
        is_caustic = False
        density = ZERO  # of the last BRDF sample; 0 after the eye or a specular surface
        while True:
            if bounce > 0:
                primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
                traced += 1
            if primitive < 0:
                break
            p, n, offset = hit_point(scene, primitive, origin, direction, t)
            material = scene.material[primitive]
            vertex = rng.subkey(key, bounce)
            bounce += 1
            if is_specular(scene.kind[material]):
                u, v = rng.uniform2(vertex, CHOICE)
                chain += 1
                if chain > bsdf.ROULETTE_START:
                    if v >= bsdf.SURVIVAL:
                        break
                    throughput = vec.scale(throughput, ONE / bsdf.SURVIVAL)
                if depth == 1 and chain == 1:
                    is_caustic = True
                origin, direction, throughput = scatter_along_eye_path(
                    scene, primitive, n, p, offset, direction, throughput, u
                )
                if vec.max3(throughput) <= ZERO:
                    break
                continue
            light = emitted(scene, primitive, n, direction)
            if vec.max3(light) > ZERO:
                weight = ONE
                if depth > 0 and chain == 0:
                    cosine = -vec.dot(n, direction)
                    weight = density / (density + light_density(scene, scene.light[primitive], t * t, cosine))
                light = vec.scale(vec.mul(throughput, light), weight)
                if is_caustic:
                    caustic = vec.add(caustic, light)
                else:
                    diffusive = vec.add(diffusive, light)
            n = facing(n, direction)
            wo = vec.neg(direction)
            albedo = bsdf.albedo(scene, material)
            if vec.max3(albedo) <= ZERO:
                break
            chain = 0
            light, shadow = direct_light(scene, rays, p, n, offset, material, wo, vertex)
            traced += shadow
            light = vec.mul(throughput, light)
            if is_caustic:
                caustic = vec.add(caustic, light)
            else:
                diffusive = vec.add(diffusive, light)
            depth += 1
            choice, survive = rng.uniform2(vertex, CHOICE)
            u, v = rng.uniform2(vertex, DIRECTION)
            direction, weight = bsdf.sample_weight(scene, material, n, wo, choice, u, v)
            throughput = vec.mul(throughput, weight)
            if depth >= ROULETTE_START:
                survival = min(bsdf.SURVIVAL, vec.max3(throughput))
                if survive >= survival:
                    break
                throughput = vec.scale(throughput, ONE / survival)
            if vec.max3(throughput) <= ZERO:
                break
            density = bsdf.pdf(scene, material, n, wo, direction)
            origin = vec.along(p, n, offset)
        add_sample(film, pixels[i, 3], diffusive, caustic)
    return traced


@kernel
def trace_paths_brute(scene, camera, rays, pixels, seed, pass_index, film):
    """One path a pixel that finds light by chance alone: no next-event estimation, no weights. Returns rays traced."""
    traced = 0
    for i in range(pixels.shape[0]):
        if i % LANES == 0:
            traced += see_packet(scene, camera, rays, pixels, i, seed, pass_index)
        if pixels[i, 0] < 0:
            continue
        key = rng.make_key(seed, rng.CAMERA, pass_index, pixels[i, 2])
        primitive, t = lane_hit(scene.triangle_count, rays, i % LANES)
        origin, direction = vec.row(camera, 0), lane_direction(rays, i % LANES)
        throughput, diffusive, caustic = WHITE, BLACK, BLACK
        depth, chain, bounce = 0, 0, 0
        is_caustic = False
        while True:
            if bounce > 0:
                primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
                traced += 1
            if primitive < 0:
                break
            p, n, offset = hit_point(scene, primitive, origin, direction, t)
            material = scene.material[primitive]
            vertex = rng.subkey(key, bounce)
            bounce += 1
            choice, survive = rng.uniform2(vertex, CHOICE)
            if is_specular(scene.kind[material]):
                chain += 1
                if depth == 1 and chain == 1:
                    is_caustic = True
                survival = bsdf.SURVIVAL if chain > bsdf.ROULETTE_START else ONE
                origin, direction, throughput = scatter_along_eye_path(
                    scene, primitive, n, p, offset, direction, throughput, choice
                )
            else:
                chain = 0
                depth += 1
                light = vec.mul(throughput, emitted(scene, primitive, n, direction))
                if is_caustic:
                    caustic = vec.add(caustic, light)
                else:
                    diffusive = vec.add(diffusive, light)
                n = facing(n, direction)
                u, v = rng.uniform2(vertex, DIRECTION)
                direction, weight = bsdf.sample_weight(scene, material, n, vec.neg(direction), choice, u, v)
                throughput = vec.mul(throughput, weight)
                origin = vec.along(p, n, offset)
                survival = ONE
                if depth > ROULETTE_START:
                    survival = min(bsdf.SURVIVAL, vec.max3(throughput))
            if survive >= survival or vec.max3(throughput) <= ZERO:
                break
            throughput = vec.scale(throughput, ONE / survival)
        add_sample(film, pixels[i, 3], diffusive, caustic)
    return traced
