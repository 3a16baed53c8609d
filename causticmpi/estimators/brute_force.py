"""Path tracing by brute force, the plain oracle: light is found by chance alone."""

from causticmpi.kernels import bsdf, rng, vec
from causticmpi.kernels.camera import see_packet
from causticmpi.kernels.embree import LANES, intersect, lane_direction, lane_hit
from causticmpi.kernels.eye_path import emitted, facing, scatter_along_eye_path
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.path_stages import CHOICE, DIRECTION
from causticmpi.kernels.pixels import add_sample
from causticmpi.kernels.traced_scene import hit_point, is_specular
from causticmpi.kernels.vec import BLACK, INFINITY, ONE, WHITE, ZERO

ROULETTE_START = 3
"""Diffuse vertices before Russian roulette sets in."""


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
