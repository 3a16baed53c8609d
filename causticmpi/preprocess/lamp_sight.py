"""Where the eye can see a lamp: the pixels that any ray to a lamp or to something specular passes through, and small
images of lamps in them."""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.camera import film_position
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.preprocess.lamp_images import LampImages, places_on_other_film
from causticmpi.preprocess.lamps import lamps_of
from causticmpi.scene.data import SceneData

MARGIN = 0.01
"""Around a primitive [pixels]: eye rays are rounded to float32."""
NEAR = 1e-6
"""What crosses the plane of the eye is cut off at this fraction of its depth."""
DENSER, WIDEST = 4.0, 0.6
"""An image gets looks of its own where, in its middle, they lie so many times as dense as a single look at a random
place whose events are its own by chance; half axes of the places of such looks, at most [pixels]."""
MOST_OWN = 8
"""Looks at images in a pixel: at those that are likeliest to be met by chance."""
AROUND = 1.5
"""They are sent to pixels that an ellipse so many times as large touches."""
CORNER = 0.71
"""How far the corners of a pixel lie from its middle [pixels]."""
PLACE, AXES, INVERSE, PEAK, COLUMNS = 0, 2, 6, 10, 11
"""First columns of `LampSight.image`."""
MOST_SIDE = 8
"""Looks at a pixel in a pass, at most so many squared."""
LARGER = 8.0
"""How many times as wide lamps are for looks that only tell where more looks are worth their cost."""
MIDDLE, VARIANCE, RADIANCE = 0, 3, 9
"""First columns of `LampSight.larger`."""


class LampSight(NamedTuple):
    """sides (pixels of the whole film,) uint8: looks at a pixel in a pass lie in a grid of so many a side; 0, and
    everywhere if empty: lamps are seen in passing, by the paths that look for vertices.

    larger (n, 12) float32: middle, variance and radiance of `lamps_of`; if there are any, these lamps are seen instead
    of those of the scene, LARGER times as wide.

    Looks of their own have the images in rows first[pixel] … first[pixel + 1], first (pixels + 1,) int32, empty if
    there are none: image (rows, COLUMNS) float32: middle of the places of a look; half axes as a matrix that takes the
    unit disk to their ellipse; its inverse; density there [1 / pixel]; events (rows,) int64 of lamp_images.
    """

    sides: Any
    larger: Any
    first: Any
    image: Any
    events: Any

    @property
    def most(self) -> int:
        """Largest side of a grid of looks; 0: there are none."""
        return int(self.sides.max(initial=0))

    @property
    def knows_images(self) -> bool:
        """Whether images get looks of their own."""
        return len(self.first) > 0


def looks_of(sides: np.ndarray) -> LampSight:
    """Looks by grids of so many a side at each pixel (pixels,), and none at images."""
    none = np.zeros(0, np.int32), np.zeros((0, COLUMNS), np.float32), np.zeros(0, np.int64)
    return _sight(sides.astype(np.uint8), np.zeros((0, 12), np.float32), *none)


def seen_in_passing() -> LampSight:
    """No looks for lamps alone."""
    return looks_of(np.zeros(0))


def _sight(*arrays: np.ndarray) -> LampSight:
    for array in arrays:
        array.flags.writeable = False  # as shared arrays are: kernels are compiled for one type only
    return LampSight(*arrays)


def lamp_sight(scene: SceneData, camera: np.ndarray, width: int, height: int, side: int) -> LampSight:
    """Looks by a grid of side x side at every pixel that holds a part of the box around a projected lamp or specular
    primitive. camera: see kernels.camera."""
    return looks_of(side * _marked(scene, camera, width, height))


def with_images(sight: LampSight, images: LampImages, width: int, height: int) -> LampSight:
    """With looks at images of lamps in a picture of so many pixels, and one at random at least where these are."""
    first, image, events = _own_looks(images, width, height)
    sides = sight.sides
    if len(first):
        sides = np.maximum(sides if len(sides) else np.uint8(0), np.diff(first) > 0)
    return _sight(sides, sight.larger, first, image, events)


def sides_on_other_film(sides: np.ndarray, size: tuple[int, int], other: tuple[int, int]) -> np.ndarray:
    """The sides of a picture, width and height `size`, in one of other width and height that shows the same."""
    middles = np.arange(max(other))[:, None] + 0.5  # along either axis
    column, row = np.clip(places_on_other_film(middles, other, size), 0, np.array(size) - 1).astype(int).T
    moved: np.ndarray = sides.reshape(size[1], size[0])[row[: other[1], None], column[: other[0]]].ravel()
    return moved


def at_most(sight: LampSight, side: int) -> LampSight:
    """With grids of at most so many looks a side."""
    return _sight(np.minimum(sight.sides, np.uint8(side)), *sight[1:])


def with_larger_lamps(sight: LampSight, scene: SceneData) -> LampSight:
    """With looks at lamps LARGER times as wide instead."""
    lamps = lamps_of(scene)
    larger = np.concatenate([lamps.middle, lamps.variance, lamps.radiance], axis=1)
    return _sight(sight.sides, larger, sight.first, sight.image, sight.events)


def _own_looks(images: LampImages, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`first`, `image` and `events` of a LampSight."""
    turned, half, _ = np.linalg.svd(images.axes)
    narrow = np.minimum(half, WIDEST)
    peak = 1 / (math.pi * narrow.prod(axis=1))
    pixels, owners = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)]
    for i in np.flatnonzero(peak >= DENSER * images.chance):
        extent = np.abs(turned[i]) @ (AROUND * half[i])
        low, high = (np.floor(images.place[i] + way * extent).astype(int) for way in (-1, 1))
        x, y = np.meshgrid(
            *(np.arange(max(0, a), min(b + 1, c)) for a, b, c in zip(low, high, (width, height), strict=True))
        )
        away = np.abs((np.stack([x.ravel(), y.ravel()], axis=1) + 0.5 - images.place[i]) @ turned[i])
        pixels.append((y * width + x).ravel()[(away <= AROUND * half[i] + CORNER).all(axis=1)])
        owners.append(np.full(len(pixels[-1]), i, np.int32))
    pixel, owner = np.concatenate(pixels), np.concatenate(owners)
    order = np.lexsort((-(images.chance * half.prod(axis=1))[owner], pixel))
    kept = order[np.arange(len(order)) - np.searchsorted(pixel[order], pixel[order]) < MOST_OWN]
    pixel, owner = pixel[kept], owner[kept]
    # Of an ellipse longer than a pixel each pixel has its own part.
    away = np.stack([pixel % max(1, width), pixel // max(1, width)], axis=1) + 0.5 - images.place[owner]
    reach = np.maximum(half - 0.5, 0)[owner]
    along = np.clip(np.einsum("ij,ijk->ik", away, turned[owner]), -reach, reach)
    image = np.empty((len(pixel), COLUMNS), np.float32)
    image[:, PLACE:AXES] = images.place[owner] + np.einsum("ijk,ik->ij", turned[owner], along)
    image[:, AXES:INVERSE] = (turned * narrow[:, None])[owner].reshape(-1, 4)
    image[:, INVERSE:PEAK] = (turned / narrow[:, None]).transpose(0, 2, 1)[owner].reshape(-1, 4)
    image[:, PEAK] = peak[owner]
    first = np.searchsorted(pixel, np.arange(width * height + 1 if len(pixel) else 0)).astype(np.int32)
    return first, image, images.events[owner]


def _marked(scene: SceneData, camera: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels (pixels,) where a lamp or something specular may be seen."""
    specular = scene.material_kind[scene.primitive_material] >= MIRROR
    wanted = np.flatnonzero(specular | (scene.primitive_emission >= 0))
    mask = np.zeros((height, width), np.bool_)
    workspace = np.zeros((8, 3)), np.zeros(8), np.zeros(4)
    _mark(scene.vertices, scene.triangles, scene.spheres, wanted, camera.astype(np.float64), *workspace, mask)
    return mask.ravel()


@inline
def _grow(camera, d, box):
    """Let box (least and most x, least and most y) hold the film position in pixels of a point d away from the eye."""
    x, y, _ = film_position(camera, d)
    box[0], box[1] = min(box[0], x), max(box[1], x)
    box[2], box[3] = min(box[2], y), max(box[3], y)


@kernel
def _mark(vertices, triangles, spheres, wanted, camera, points, depth, box, mask):
    """Mark pixels of mask (height, width) for the `wanted` primitives.

    points (8, 3), depth (8,), box (4,) float64: workspace.
    """
    height, width = mask.shape
    widest = 0.0
    for corner in range(4):
        x, y = (width if corner & 1 else 0), (height if corner & 2 else 0)
        reach2 = 0.0
        for c in range(3):
            reach2 += (camera[1, c] + x * camera[2, c] + y * camera[3, c]) ** 2
        widest = max(widest, np.sqrt(reach2))
    for i in range(wanted.shape[0]):
        sphere = wanted[i] - triangles.shape[0]
        count = 3 if sphere < 0 else 8
        for k in range(count):
            for c in range(3):
                if sphere < 0:
                    points[k, c] = vertices[triangles[wanted[i], k], c] - camera[0, c]
                else:
                    away = spheres[sphere, 3] if (k >> c) & 1 else -spheres[sphere, 3]
                    points[k, c] = spheres[sphere, c] + away - camera[0, c]
            _, _, depth[k] = film_position(camera, vec.row(points, k))
        deepest, nearest = depth[0], depth[0]
        for k in range(1, count):
            deepest, nearest = max(deepest, depth[k]), min(nearest, depth[k])
        if deepest <= 0:
            continue
        near = NEAR * deepest
        if nearest < near:
            # What is nearer than the cut would be seen if it were this close to the eye: then by every pixel.
            gap2 = 0.0
            for c in range(3):
                low = high = points[0, c]
                for k in range(1, count):
                    low, high = min(low, points[k, c]), max(high, points[k, c])
                gap2 += max(0.0, low, -high) ** 2
            if gap2 <= (widest * near) ** 2:
                mask[:] = True
                return
        box[0] = box[2] = np.inf
        box[1] = box[3] = -np.inf
        for k in range(count):
            a = vec.row(points, k)
            if depth[k] >= near:
                _grow(camera, a, box)
                continue
            for m in range(count):
                if depth[m] > near:
                    f = (near - depth[k]) / (depth[m] - depth[k])
                    _grow(camera, vec.along(a, vec.sub(vec.row(points, m), a), f), box)
        left, right = max(0.0, np.floor(box[0] - MARGIN)), min(float(width), np.floor(box[1] + MARGIN) + 1)
        top, bottom = max(0.0, np.floor(box[2] - MARGIN)), min(float(height), np.floor(box[3] + MARGIN) + 1)
        for y in range(int(top), int(bottom)):
            for x in range(int(left), int(right)):
                mask[y, x] = True
