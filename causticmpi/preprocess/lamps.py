"""Lamps: the shapes that shine, each as a middle and how its points lie about it."""

import math
from typing import NamedTuple

import numpy as np

from causticmpi.scene.data import SceneData

MOST_LAMPS = 16
"""The strongest."""


class Lamps(NamedTuple):
    """Shapes that shine: middle (n, 3); variance (n, 6) of their points: xx, xy, xz, yy, yz, zz [units²]; shape (n,):
    their numbers."""

    middle: np.ndarray
    variance: np.ndarray
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
    power = np.bincount(shape, weights=area * scene.emission[scene.primitive_emission[shining]].max(axis=1))
    strongest = np.sort(np.argsort(-power, kind="stable")[:MOST_LAMPS])
    middles, variances = np.zeros((len(shapes), 3)), np.zeros((len(shapes), 6))
    for i in strongest:
        own = shape == i
        share = area[own] / area[own].sum()
        middles[i] = share @ middle[own]
        off = middle[own] - middles[i]
        whole = np.einsum("i,icd->cd", share, inner[own] + off[:, :, None] * off[:, None])
        variances[i] = whole[np.triu_indices(3)]
    return Lamps(middles[strongest].astype(np.float32), variances[strongest].astype(np.float32), shapes[strongest])
