"""Photon map: all caustic points in one search tree, for the density estimate of IWS+PM, which is biased [CF sec. 3.1].

The points are those that steer the forecast (see photons.py); here they are what is seen.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import kdtree, vec
from causticmpi.kernels.jit import kernel
from causticmpi.preprocess.photons import CausticPoints

PROBES = 1000
"""Caustic points whose neighbours decide the automatic radius."""
SHARE = 0.99
"""Share of the caustic points that have all k neighbours within the automatic radius."""


class PhotonMap(NamedTuple):
    """What rank 0 broadcasts, as flat arrays for kernels.

    x, y, z (n,) float32, axis (n,) uint8: caustic points in tree order; normal, direction, flux (n, 3) float32: normal
    on the lit side, direction back to the specular surface, flux over the number of particles emitted
    radius: largest search radius [scene units]; neighbours: k
    """

    x: Any
    y: Any
    z: Any
    axis: Any
    normal: Any
    direction: Any
    flux: Any
    radius: float
    neighbours: int


@kernel
def _neighbour_distances(x, y, z, axis, step, distance, row, stack, plane, found):
    """Squared distance of every step-th point's farthest of its distance.shape[0] nearest, itself left out."""
    count = x.shape[0]
    for i in range(found.shape[0]):
        p = (x[i * step], y[i * step], z[i * step])
        kdtree.nearest(x, y, z, axis, 0, count, p, vec.INFINITY, distance.shape[0], distance, row, stack, plane)
        found[i] = distance[0]


def automatic_radius(x: np.ndarray, y: np.ndarray, z: np.ndarray, axis: np.ndarray, neighbours: int) -> float:
    """Radius within which SHARE of the points have `neighbours` others: where there is light, they decide; where there
    is little, the radius does. x, y, z, axis: a search tree."""
    extent = float(np.linalg.norm([np.ptp(x), np.ptp(y), np.ptp(z)])) or 1.0
    most = min(neighbours + 1, len(x))
    if most <= neighbours:
        return extent
    step = max(1, len(x) // PROBES)
    found = np.zeros(len(x) // step, np.float32)
    _neighbour_distances(
        x,
        y,
        z,
        axis,
        step,
        np.zeros(most, np.float32),
        np.zeros(most, np.int64),
        np.zeros(2 * kdtree.MAX_DEPTH, np.int32),
        np.zeros(kdtree.MAX_DEPTH, np.float32),
        found,
    )
    return math.sqrt(float(np.quantile(found, SHARE))) or extent


def build_photon_map(points: CausticPoints, emitted: int, neighbours: int, radius: float | None = None) -> PhotonMap:
    """Index at least one caustic point. emitted: particles shot for them; radius: None derives it from the points."""
    count = len(points.power)
    order, axis = np.arange(count, dtype=np.int32), np.zeros(count, np.uint8)
    position = np.ascontiguousarray(points.position.T)
    kdtree.build_trees(position, np.array([0, count]), order, axis, np.zeros(2 * kdtree.MAX_DEPTH, np.int64))
    x, y, z = position[:, order]
    return PhotonMap(
        x=x,
        y=y,
        z=z,
        axis=axis,
        normal=points.normal[order],
        direction=points.direction[order],
        flux=points.power[order] / np.float32(emitted),
        radius=automatic_radius(x, y, z, axis, neighbours) if radius is None else radius,
        neighbours=neighbours,
    )


def no_photon_map(neighbours: int) -> PhotonMap:
    """A map without photons: no caustics anywhere."""
    floats, vectors = np.empty(0, np.float32), np.empty((0, 3), np.float32)
    return PhotonMap(floats, floats, floats, np.empty(0, np.uint8), vectors, vectors, vectors, 1.0, neighbours)
