"""Scenes with small images of lamps, looks at them, and plain looks to compare with."""

from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
from rendering import prepare, scene_from

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.kernels import rng, vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect
from causticmpi.kernels.eye_path import emitted, scatter_along_eye_path
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import hit_point
from causticmpi.kernels.vec import INFINITY, WHITE
from causticmpi.preprocess.lamp_images import STRAIGHT, LampImages, find_images
from causticmpi.preprocess.lamp_sight import LampSight, lamp_sight, with_images
from causticmpi.scene.tracing import camera_array

HEAD = """\
camera: {eye: [0, 0, 3], target: [0, 0, 0], fov: 45}
materials:
  white: {type: diffuse, reflectance: 0.7}
  black: {type: diffuse, reflectance: 0}
  glass: {type: dielectric, ior: 1.5}
  mirror: {type: mirror, reflectance: 0.9}
shapes:
"""
WALL = "  - {type: quad, corners: [[-2, -2, -1], [2, -2, -1], [2, 2, -1], [-2, 2, -1]], material: %s}\n"
# A glass ball, two lamps beside the picture and one in it.
BALL = (
    HEAD.replace("[0, 0, 3], target: [0, 0, 0], fov: 45", "[0.3, 0, 3], target: [0.3, 0, 0], fov: 20")
    + WALL % "white"
    + """\
  - {type: sphere, center: [0.3, 0, 0], radius: 0.4, material: glass}
  - type: quad
    corners: [[-0.8, 0.7, 0.5], [-0.76, 0.7, 0.5], [-0.76, 0.74, 0.48], [-0.8, 0.74, 0.48]]
    material: black
    emission: 30
  - {type: sphere, center: [0.95, 0.75, -0.5], radius: 0.03, material: black, emission: [5, 20, 80]}
  - {type: sphere, center: [0.1, 0.42, 0.2], radius: 0.007, material: black, emission: [8, 2, 4]}
"""
)
SIDE = 24
WHOLE = (0, 0, SIDE, SIDE)
PASSES = 4000
PLAIN = 20000
"""Plain looks at a pixel."""
REFLECTED = 2 * STRAIGHT + 1


class Found(NamedTuple):
    """A scene ready to trace, its camera, where lamps may be seen without looks at images, and their images."""

    prepared: PreparedScene
    camera: np.ndarray
    sight: LampSight
    images: LampImages

    def looks(self, images: LampImages | None, passes: int = PASSES) -> np.ndarray:
        """Lamps as so many passes see them: (passes, SIDE, SIDE, 3)."""
        sight = self.sight if images is None else with_images(self.sight, images, SIDE, SIDE)
        return self.looks_by(sight, passes).reshape(passes, SIDE, SIDE, 3)

    def looks_by(self, sight: LampSight, passes: int, window: tuple[int, int, int, int] = WHOLE) -> np.ndarray:
        """(passes, pixels of the window, 3)."""
        pixels, work = pixel_order(window, SIDE), sight_work(sight.most)
        films = np.zeros((passes, (window[2] - window[0]) * (window[3] - window[1]), 6), np.float32)
        for index, film in enumerate(films):
            see_lamps(self.prepared.traced, self.camera, work, sight, pixels, 1, index, film)
        assert not films[..., 3:].any()
        return films[..., :3]


def find(text: str, folder: Path, width: int = SIDE, height: int = SIDE) -> Found:
    scene = scene_from(text, folder)
    prepared, camera = prepare(scene), camera_array(scene.camera, width, height)
    sight = lamp_sight(scene, camera, width, height, 1)
    return Found(prepared, camera, sight, find_images(scene, prepared.traced, camera, width, sight.sides > 0))


@numba.njit
def plain_looks(traced, camera, rays, first, count, width, height, most, places, events, film):
    """Looks number first … at random places of every pixel, whose specular events are chosen by chance. Adds to film
    (pixels, 3); places (n, 2), events (n,): of those that meet a lamp by at most `most` events. Returns n."""
    met = 0
    for pixel in range(width * height):
        for look in range(first, first + count):
            key = rng.make_key(99, rng.CAMERA, look, pixel)
            u, v = rng.uniform2(key, 0)
            x, y = np.float32(pixel % width) + u, np.float32(pixel // width) + v
            origin, direction = primary_ray(camera, x, y)
            throughput, name = WHITE, 1
            for bounce in range(most + 1):
                primitive, t = intersect(traced.handle, traced.triangle_count, rays, origin, direction, INFINITY)
                if primitive < 0:
                    break
                p, n, offset = hit_point(traced, primitive, origin, direction, t)
                if traced.kind[traced.material[primitive]] < MIRROR:
                    light = vec.mul(emitted(traced, primitive, n, direction), throughput)
                    for c in range(3):
                        film[pixel, c] += light[c]
                    if vec.max3(light) > 0 and met < places.shape[0]:
                        places[met, 0], places[met, 1], events[met] = x, y, name
                        met += 1
                    break
                before, choice = vec.dot(direction, n), rng.uniform2(key, 1 + bounce)[0]
                origin, direction, throughput = scatter_along_eye_path(
                    traced, primitive, n, p, offset, direction, throughput, choice
                )
                name = 2 * name + (before * vec.dot(direction, n) < 0)
    return met
