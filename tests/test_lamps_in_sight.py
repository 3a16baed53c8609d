"""Lamps in sight: where they can be seen, what is seen of them, and that the order of tiles changes nothing."""

from pathlib import Path

import numba
import numpy as np
import pytest
from rendering import make_config, prepare, scene_from
from z_test import ALPHA, block_means, compare

from causticmpi.config.records import Camera
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.kernels import rng
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import emitted, follow_chain
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.vec import INFINITY, WHITE
from causticmpi.preprocess.forecast import no_forecast
from causticmpi.preprocess.lamp_sight import lamp_sight, looks_of
from causticmpi.render.methods import make_method
from causticmpi.scene.content import with_camera
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

# A glass ball and a small mirror before a wall, a lamp beside, a ball that shines, and a mirror that goes on behind the
# eye.
SCENE = """\
camera: {eye: [0, 0.4, 3], target: [0, 0, 0], fov: 45}
materials:
  white: {type: diffuse, reflectance: 0.7}
  black: {type: diffuse, reflectance: 0}
  glass: {type: dielectric, ior: 1.5}
  mirror: {type: mirror, reflectance: [0.9, 0.8, 0.7]}
shapes:
  - {type: quad, corners: [[-2, -1, -1], [2, -1, -1], [2, 2, -1], [-2, 2, -1]], material: white}
  - {type: sphere, center: [0.3, 0, 0], radius: 0.4, material: glass}
  - {type: quad, corners: [[-1, -0.5, 0], [-0.6, -0.5, 0.2], [-0.6, 0, 0.2], [-1, 0, 0]], material: mirror}
  - type: quad
    corners: [[-0.9, 0.6, 0.5], [-0.6, 0.6, 0.5], [-0.6, 0.9, 0.4], [-0.9, 0.9, 0.4]]
    material: black
    emission: 30
  - {type: sphere, center: [0.9, 0.6, -0.5], radius: 0.1, material: black, emission: [5, 20, 80]}
  - {type: quad, corners: [[1.4, -1, 5], [1.4, -1, -1], [1.4, 0, -1], [1.4, 0, 5]], material: mirror}
"""
SIDE = 24
PASSES = 400


@pytest.fixture
def scene(tmp_path: Path) -> SceneData:
    return scene_from(SCENE, tmp_path)


@numba.njit
def _looks(traced, camera, rays, count, width, height, hit, radiance):
    """Plain looks, `count` at random places of every pixel: whether one meets a lamp or specular surface at once, and
    each one's radiance from lamps."""
    for pixel in range(width * height):
        for look in range(count):
            key = rng.make_key(99, rng.CAMERA, look, pixel)
            u, v = rng.uniform2(key, 0)
            x, y = np.float32(pixel % width) + u, np.float32(pixel // width) + v
            origin, direction = primary_ray(camera, x, y)
            primitive, t = intersect(traced.handle, traced.triangle_count, rays, origin, direction, INFINITY)
            if primitive >= 0 and (traced.light[primitive] >= 0 or traced.kind[traced.material[primitive]] >= MIRROR):
                hit[pixel] = True
            primitive, _, n, _, direction, throughput, _ = follow_chain(
                traced, rays, origin, direction, primitive, t, WHITE, rng.subkey(key, 1)
            )
            if primitive >= 0:
                light = emitted(traced, primitive, n, direction)
                for c in range(3):
                    radiance[look, pixel, c] = throughput[c] * light[c]


CAMERAS = [
    Camera(eye=(0, 0.4, 3), target=(0, 0, 0), fov=45),
    Camera(eye=(0.9, 0.1, 0.1), target=(-3, 0.3, 1), fov=100),
    Camera(eye=(0.3, 0.05, 0), target=(1, 0.6, -0.4), fov=60),  # inside the glass
    Camera(eye=(0, 0.4, 9), target=(0, 0.4, 12), fov=45),  # all is behind
]


@pytest.mark.parametrize("view", range(len(CAMERAS)))
def test_no_lamp_is_overlooked(scene: SceneData, view: int) -> None:
    seen_from = with_camera(scene, CAMERAS[view])
    prepared = prepare(seen_from)
    camera = camera_array(seen_from.camera, SIDE, SIDE)
    hit, looks = np.zeros(SIDE * SIDE, np.bool_), np.zeros((100, SIDE * SIDE, 3), np.float32)
    _looks(prepared.traced, camera, ray_buffer(), 100, SIDE, SIDE, hit, looks)
    mask = lamp_sight(seen_from, camera, SIDE, SIDE, 2).sides == 2
    assert not (hit & ~mask).any()
    assert mask.sum() <= (3 * hit.sum() if view != 2 else SIDE * SIDE)
    prepared.embree.close()


@pytest.mark.parametrize("side", [1, 3])
def test_lamps_are_as_bright_as_plain_looks_find(scene: SceneData, side: int) -> None:
    prepared = prepare(scene)
    camera = camera_array(scene.camera, SIDE, SIDE)
    plain = np.zeros((PASSES, SIDE * SIDE, 3), np.float32)
    _looks(prepared.traced, camera, ray_buffer(), PASSES, SIDE, SIDE, np.zeros(SIDE * SIDE, np.bool_), plain)
    sight = lamp_sight(scene, camera, SIDE, SIDE, side)
    pixels, work = pixel_order((0, 0, SIDE, SIDE), SIDE), sight_work(side)
    films = np.zeros((PASSES, SIDE * SIDE, 6), np.float32)
    for index, film in enumerate(films):
        see_lamps(prepared.traced, camera, work, sight, pixels, 1, index, film)
    assert not films[..., 3:].any()
    means, plain_means = (block_means(f.reshape(PASSES, SIDE, SIDE, -1), 8) for f in (films[..., :3], plain))
    assert compare(plain_means, means).p > ALPHA
    assert not compare(plain_means, 1.1 * means).p > ALPHA
    # A grid over the pixel does better than as many looks at random.
    variance = films[..., :3].var(axis=0).mean() * side**2
    assert variance < (1.05 if side == 1 else 0.9) * plain.var(axis=0).mean()
    prepared.embree.close()


def test_tiles_in_any_order_and_company(scene: SceneData) -> None:
    prepared = prepare(scene)
    camera = camera_array(scene.camera, SIDE, SIDE)
    pixels, work, sight = pixel_order((0, 0, SIDE, SIDE), SIDE), sight_work(2), lamp_sight(scene, camera, SIDE, SIDE, 2)
    whole, parts, everywhere = np.zeros((3, SIDE * SIDE, 6), np.float32)
    rays = see_lamps(prepared.traced, camera, work, sight, pixels, 1, 0, whole)
    starts = range(0, len(pixels), 16)
    assert rays == sum(
        see_lamps(prepared.traced, camera, work, sight, pixels[start : start + 16], 1, 0, parts)
        for start in reversed(starts)
    )
    np.testing.assert_array_equal(whole, parts)
    see_lamps(prepared.traced, camera, work, looks_of(np.full(SIDE * SIDE, 2)), pixels, 1, 0, everywhere)
    np.testing.assert_array_equal(whole, everywhere)
    assert whole.any()
    prepared.embree.close()


def test_nothing_else_adds_the_lamps(scene: SceneData) -> None:
    """In a scene of black walls the lamps in sight are all there is."""
    black = scene.material_reflectance * (scene.material_kind[:, None] >= MIRROR)
    object.__setattr__(scene, "material_reflectance", black.astype(np.float32))
    prepared = prepare(scene)
    camera = camera_array(scene.camera, SIDE, SIDE)
    pixels = pixel_order((0, 0, SIDE, SIDE), SIDE)
    everywhere = looks_of(np.full(SIDE * SIDE, 2))
    for name in ("iws", "iws+cf"):
        config = make_config(method=name)
        common = (config, prepared.traced, camera, no_forecast(), prepared.extent, None)
        method, in_passing = make_method(*common, everywhere), make_method(*common)
        film, lamps, single = np.zeros((3, SIDE * SIDE, 6), np.float32)
        method.begin_pass(0), in_passing.begin_pass(0)
        method.trace(pixels, film)
        method.see_lamps(pixels, lamps)  # type: ignore[attr-defined]
        np.testing.assert_array_equal(film, lamps)
        in_passing.trace(pixels, single)
        assert lamps[:, :3].any() and single[:, :3].any() and not lamps[:, 3:].any() and not single[:, 3:].any()
    prepared.embree.close()
