"""Lamps: the shapes that shine, each as a middle and how its points lie about it; and by how much a ray misses one."""

import math
from typing import NamedTuple

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import ZERO
from causticmpi.scene.data import SceneData

MOST_LAMPS = 16
"""The strongest."""


class Lamps(NamedTuple):
    """Shapes that shine: middle (n, 3); variance (n, 6) of their points: xx, xy, xz, yy, yz, zz [units²]; radiance
    (n, 3), the mean of their area; shape (n,): their numbers."""

    middle: np.ndarray
    variance: np.ndarray
    radiance: np.ndarray
    shape: np.ndarray


def lamps_of(scene: SceneData) -> Lamps:
    """Shapes that shine, the MOST_LAMPS strongest."""
    shining = np.flatnonzero(scene.primitive_emission >= 0)
    sphere = shining >= len(scene.triangles)
    corners = scene.vertices[scene.triangles[shining[~sphere]]].astype(np.float64)
    balls = scene.spheres[shining[sphere] - len(scene.triangles)].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    sides = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    area = np.concatenate([sides / 2, 4 * math.pi * balls[:, 3] ** 2])
    middle = np.concatenate([corners.mean(axis=1), balls[:, :3]])
    away = corners - middle[: len(corners), None]
    inner = np.zeros((len(shining), 3, 3))
    inner[: len(corners)] = np.einsum("ikc,ikd->icd", away, away) / 12
    inner[len(corners) :] = np.eye(3) * (balls[:, 3] ** 2 / 4)[:, None, None]  # of the disk that is seen
    shapes, shape = np.unique(scene.primitive_shape[shining], return_inverse=True)
    radiance = scene.emission[scene.primitive_emission[shining]]
    power = np.bincount(shape, weights=area * radiance.max(axis=1))
    strongest = np.sort(np.argsort(-power, kind="stable")[:MOST_LAMPS])
    middles, variances, radiances = (np.zeros((len(shapes), columns)) for columns in (3, 6, 3))
    for i in strongest:
        own = shape == i
        share = area[own] / area[own].sum()
        middles[i] = share @ middle[own]
        off = middle[own] - middles[i]
        whole = np.einsum("i,icd->cd", share, inner[own] + off[:, :, None] * off[:, None])
        variances[i] = whole[np.triu_indices(3)]
        radiances[i] = share @ radiance[own]
    middle, variance, radiance = (array[strongest].astype(np.float32) for array in (middles, variances, radiances))
    return Lamps(middle, variance, radiance, shapes[strongest])


@inline
def miss(origin, direction, middle, normal, tangents):
    """By how much a ray misses a lamp's middle, on the plane through it: along the two tangents; ahead: whether it gets
    there."""
    slope, way = vec.dot(direction, normal), vec.dot(vec.sub(middle, origin), normal)
    off = vec.sub(vec.along(origin, direction, way / slope), middle)
    return vec.dot(off, tangents[0]), vec.dot(off, tangents[1]), (slope > ZERO) & (way > ZERO)


@inline
def across(variance, a, b):
    """aᵀ V b."""
    return (
        variance[0] * a[0] * b[0]
        + variance[1] * (a[0] * b[1] + a[1] * b[0])
        + variance[2] * (a[0] * b[2] + a[2] * b[0])
        + variance[3] * a[1] * b[1]
        + variance[4] * (a[1] * b[2] + a[2] * b[1])
        + variance[5] * a[2] * b[2]
    )
