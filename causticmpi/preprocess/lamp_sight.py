"""Where the eye can see a lamp: the pixels that any ray to a lamp or to something specular passes through."""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.camera import film_position
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.scene.data import SceneData

MARGIN = 0.01
"""Around a primitive [pixels]: eye rays are rounded to float32."""
NEAR = 1e-6
"""What crosses the plane of the eye is cut off at this fraction of its depth."""


class LampSight(NamedTuple):
    """mask (pixels of the whole film,) bool: where a lamp may be seen, empty for everywhere; side: looks at such a
    pixel in a pass lie in a grid of side x side; 0: lamps are seen in passing, by the paths that look for vertices."""

    mask: Any
    side: int

    @property
    def in_passing(self) -> bool:
        """Whether lamps get no looks of their own."""
        return self.side == 0


def seen_in_passing() -> LampSight:
    """No looks for lamps alone."""
    return _sight(np.empty(0, np.bool_), 0)


def _sight(mask: np.ndarray, side: int) -> LampSight:
    mask.flags.writeable = False  # as shared arrays are: kernels are compiled for one type only
    return LampSight(mask, side)


def lamp_sight(scene: SceneData, camera: np.ndarray, width: int, height: int, side: int) -> LampSight:
    """Mark what holds a part of the box around a projected lamp or specular primitive. camera: see kernels.camera."""
    specular = scene.material_kind[scene.primitive_material] >= MIRROR
    wanted = np.flatnonzero(specular | (scene.primitive_emission >= 0))
    mask = np.zeros((height, width), np.bool_)
    workspace = np.zeros((8, 3)), np.zeros(8), np.zeros(4)
    _mark(scene.vertices, scene.triangles, scene.spheres, wanted, camera.astype(np.float64), *workspace, mask)
    return _sight(mask.ravel(), side)


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
