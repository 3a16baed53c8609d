"""Specular chains of 16 rays side by side end where each of them ends alone."""

from pathlib import Path

import numba
import numpy as np
import pytest
from rendering import prepare, scene_from

from causticmpi.kernels import rng, vec, warp
from causticmpi.kernels.embree import (
    LANES,
    RAY16,
    TFAR,
    intersect,
    intersect_packet,
    lane_direction,
    lane_hit,
    lane_origin,
    ray_buffer,
)
from causticmpi.kernels.eye_path import follow_chain, follow_chains
from causticmpi.kernels.vec import INFINITY, WHITE

SCENE = """
camera: {eye: [0, 0.2, 3], target: [0, 0, 0], up: [0, 1, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: 0.7}
  glass: {type: dielectric, ior: 1.5}
  mirror: {type: mirror, reflectance: [0.9, 0.8, 0.7]}
  light: {type: diffuse, reflectance: 0}
shapes:
  - {type: quad, corners: [[-2, -1, 2], [2, -1, 2], [2, -1, -2], [-2, -1, -2]], material: white}
  - {type: quad, corners: [[-2, -1, -2], [2, -1, -2], [2, 2, -2], [-2, 2, -2]], material: mirror}
  - {type: sphere, center: [-0.6, 0, 0], radius: 0.6, material: glass}
  - {type: sphere, center: [0.7, 0, 0], radius: 0.6, material: mirror}
  - {type: sphere, center: [0, 1.5, 0], radius: 0.2, material: light, emission: 5}
"""
PACKETS = 400


@numba.njit
def run_alone(scene, rays, origin, direction, out):
    for i in range(direction.shape[0]):
        o, d = vec.row(origin, i), vec.row(direction, i)
        hit, t = intersect(scene.handle, scene.triangle_count, rays, o, d, INFINITY)
        primitive, p, _, _, d, w, traced = follow_chain(
            scene, rays, o, d, hit, t, WHITE, rng.make_key(1, rng.CAMERA, 0, i)
        )
        out[i, 0], out[i, 1] = primitive, traced
        if primitive >= 0:
            out[i, 2], out[i, 3], out[i, 4] = p
            out[i, 5], out[i, 6], out[i, 7] = d
            out[i, 8], out[i, 9], out[i, 10] = w


@numba.njit
def run_together(scene, rays, origin, direction, primitive, distance, throughput, key, out):
    traced = 0
    for first in range(0, direction.shape[0], LANES):
        for i in range(LANES):
            for c in range(3):
                rays[RAY16 + 16 * c + i] = origin[first + i, c]
                rays[RAY16 + 16 * (4 + c) + i] = direction[first + i, c]
                throughput[i, c] = 1
            rays[RAY16 + 16 * TFAR + i] = INFINITY
            key[i] = rng.make_key(1, rng.CAMERA, 0, first + i)
        intersect_packet(scene.handle, rays)
        for i in range(LANES):
            primitive[i], distance[i] = lane_hit(scene.triangle_count, rays, i)
        traced += follow_chains(scene, rays, primitive, distance, throughput, key)
        for i in range(LANES):
            out[first + i, 0] = primitive[i]
            if primitive[i] >= 0:
                d = lane_direction(rays, i)
                out[first + i, 2], out[first + i, 3], out[first + i, 4] = vec.along(
                    lane_origin(rays, i), d, distance[i]
                )
                out[first + i, 5], out[first + i, 6], out[first + i, 7] = d
                out[first + i, 8], out[first + i, 9], out[first + i, 10] = vec.row(throughput, i)
    return traced


def test_chains_side_by_side(tmp_path: Path) -> None:
    """The random numbers are the same, so are the paths, but where rounding turns a grazing ray to another surface."""
    scene = prepare(scene_from(SCENE, tmp_path))
    generator = np.random.default_rng(1)
    count = LANES * PACKETS
    origin = np.tile(np.float32([0, 0.2, 3]), (count, 1))
    direction = (generator.uniform(-0.4, 0.4, (count, 3)) * [1, 1, 0] - [0, 0, 1]).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    alone, together = np.zeros((count, 11)), np.zeros((count, 11))
    run_alone(scene.traced, ray_buffer(), origin, direction, alone)
    lanes = np.zeros(LANES, np.int64), np.zeros(LANES, np.float32), np.zeros((LANES, 3), np.float32)
    traced = run_together(scene.traced, ray_buffer(), origin, direction, *lanes, np.zeros(LANES, np.uint64), together)
    assert (alone[:, 1] > 2).any() and (alone[:, 0] < 0).any()
    same = alone[:, 0] == together[:, 0]
    assert same.mean() > 0.999 and abs(traced / alone[:, 1].sum() - 1) < 1e-3
    close = np.abs(alone[same, 2:] - together[same, 2:]).max(axis=1) < 1e-3
    assert close.mean() > 0.999


@pytest.mark.parametrize("seed", [0, 1])
def test_turns_inverts_turn(seed: int) -> None:
    v = np.random.default_rng(seed).random(100_000, np.float32)
    v = np.concatenate([v, np.float32([0, 0.25, 0.5, 0.75])])
    back = np.array([run_turns(*run_turn(x)) for x in v[:2000]] + [run_turns(*run_turn(x)) for x in v[-4:]])
    difference = np.abs(back - np.concatenate([v[:2000], v[-4:]]))
    assert np.minimum(difference, 1 - difference).max() < 3e-7
    assert (back >= 0).all() and (back < 1).all()
    assert run_turns(np.float32(0), np.float32(0)) == 0


@numba.njit
def run_turn(v):
    return warp.turn(v)


@numba.njit
def run_turns(x, y):
    return warp.turns(x, y)
