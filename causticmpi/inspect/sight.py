"""Where the eye sees points of the scene: in the film, straight or by way of glass and mirrors."""

import numpy as np
from scipy.spatial import cKDTree

from causticmpi.kernels import rng
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import facing, follow_chain
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.kernels.vec import HALF, INFINITY, ONE
from causticmpi.render.features import first_hits

ALIKE = 0.25
"""Least cosine between a point's normal and that of the surface seen: else it lies on another wall of the corner."""


@kernel
def _ends_of_chains(scene, camera, rays, pixels, ends):
    """The first non-specular surface behind each pixel centre that sees a specular one: ends (slots, 6) float32, point
    and normal on the side that is seen; rows of other pixels stay as they are."""
    for i in range(pixels.shape[0]):
        if pixels[i, 0] < 0:
            continue
        origin, direction = primary_ray(camera, np.float32(pixels[i, 0]) + HALF, np.float32(pixels[i, 1]) + HALF)
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        if primitive < 0 or scene.kind[scene.material[primitive]] < 2:
            continue
        key = rng.make_key(0, rng.CAMERA, 0, pixels[i, 2])
        primitive, p, n, _, direction, _, _ = follow_chain(
            scene, rays, origin, direction, primitive, t, (ONE, ONE, ONE), key
        )
        if primitive >= 0:
            n = facing(n, direction)
            for c in range(3):
                ends[pixels[i, 3], c] = p[c]
                ends[pixels[i, 3], 3 + c] = n[c]


class Sight:
    """One camera's view of a scene through a window of its film (x0, y0, x1, y1), half open."""

    def __init__(
        self, scene: TracedScene, camera: np.ndarray, window: tuple[int, int, int, int], film_width: int
    ) -> None:
        self.window = window
        self.camera = camera.astype(np.float64)
        self.width, self.height = window[2] - window[0], window[3] - window[1]
        pixels, rays = pixel_order(window, film_width), ray_buffer()
        hits = np.zeros((self.width * self.height, 7), np.float32)
        first_hits(scene, camera, rays, pixels, hits)
        ends = np.zeros((len(hits), 6), np.float32)
        _ends_of_chains(scene, camera, rays, pixels, ends)
        self.normal, self.depth = hits[:, 3:6].astype(np.float64), hits[:, 6].astype(np.float64)
        self.slots = np.flatnonzero(ends[:, 3:].any(axis=1))  # pixels that see something by way of glass or a mirror
        self.ends, self.end_normals = ends[self.slots, :3].astype(np.float64), ends[self.slots, 3:].astype(np.float64)
        self.pixel_angle = float(np.linalg.norm(self.camera[2]) / np.linalg.norm(self.camera[1]))

    def spots(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (n, 3) on surfaces [scene units] are seen: (n, 2) in pixels of the window, and seen (n,) bool.

        normals (n, 3): the side of the surface that a point lies on, the other side hides it. A point that the eye sees
        straight is put there and nowhere else; one that it sees by way of specular surfaces alone, at a pixel whose
        centre looks at it; others are hidden.
        """
        points, normals = points.astype(np.float64), normals.astype(np.float64)
        spots, inside = self._projected(points)
        seen = inside & (_dot(self.camera[0] - points, normals) > 0)
        seen[seen] = self._straight(points[seen], normals[seen], spots[seen])
        hidden = np.flatnonzero(~seen)
        if len(hidden) and len(self.slots):
            distance, nearest = cKDTree(self.ends).query(points[hidden])
            footprint = self.pixel_angle * np.linalg.norm(points[hidden] - self.camera[0], axis=1)
            found = (distance <= footprint) & (_dot(self.end_normals[nearest], normals[hidden]) > ALIKE)
            slots = self.slots[nearest[found]]
            spots[hidden[found]] = np.stack([slots % self.width, slots // self.width], axis=1) + 0.5
            seen[hidden[found]] = True
        return spots, seen

    def _projected(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Film position of each point, window's corner subtracted, and whether it lies in the window."""
        corner_right_down = self.camera[[1, 2, 3]].T
        w, x, y = np.linalg.solve(corner_right_down, (points - self.camera[0]).T)
        ahead = w > 0
        w = np.where(ahead, w, 1.0)
        spots = np.stack([x / w - self.window[0], y / w - self.window[1]], axis=1)
        return spots, ahead & ((spots >= 0) & (spots < (self.width, self.height))).all(axis=1)

    def _straight(self, points: np.ndarray, normals: np.ndarray, spots: np.ndarray) -> np.ndarray:
        """Whether the surface that a point's pixel sees first is its own: it lies within a pixel's width of the plane
        of the first hit, and faces the same way."""
        x, y = np.floor(spots).astype(np.int64).T
        slot = y * self.width + x
        rays = self.camera[1] + np.stack([x + self.window[0], y + self.window[1]], axis=1).dot(self.camera[2:])
        rays += 0.5 * (self.camera[2] + self.camera[3])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        depth = np.where(np.isfinite(self.depth[slot]), self.depth[slot], 0)  # nothing there: no surface of its own
        first = self.camera[0] + depth[:, None] * rays
        off = np.abs(_dot(points - first, self.normal[slot]))
        return (depth > 0) & (off <= self.pixel_angle * depth) & (_dot(normals, self.normal[slot]) > ALIKE)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Row by row: (n, 3), (n, 3) -> (n,)."""
    return (a * b).sum(axis=1)
