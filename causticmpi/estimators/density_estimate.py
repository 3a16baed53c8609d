"""L_c from a photon map: k-nearest density estimate with an Epanechnikov kernel, biased [CF sec. 3.1; Jensen 2001].

    L_c = sum over photons within r of p:  f(wo, wi) Phi K(d)       K(d) = 2 (1 - d^2 / r^2) / (pi r^2)

r is the distance of the k-th nearest photon, at most the map's radius. The k-th itself weighs nothing, so on a plane
under uniform light the estimate has no bias; it has at edges, in corners and where light varies within r. Photons count
whose surface faces as p does (NORMALS) and that come from above the horizon of p: light does not leak round corners or
through sheets, but it does bleed through a wall onto ground that is the same on both sides.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from causticmpi.estimators import weak_singularities as ws
from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline
from causticmpi.kernels.kdtree import MAX_DEPTH, nearest
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import BLACK, INV_PI, ONE, TWO, ZERO
from causticmpi.preprocess.photon_map import PhotonMap

NORMALS = np.float32(0.9)
"""Least cosine between the normals at a photon and at p: 26 degrees."""
SLACK = np.float32(1.001)
"""Of a bound on r: more than its rounding."""


class DensityWork(NamedTuple):
    """Workspace: distance, row (k,), stack, plane: search; radiance (16, 3) float32: L_c of a tile's first vertices."""

    distance: Any
    row: Any
    stack: Any
    plane: Any
    radiance: Any


def density_work(photons: PhotonMap) -> DensityWork:
    """Workspace that fits the map."""
    return DensityWork(
        distance=np.zeros(photons.neighbours, np.float32),
        row=np.zeros(photons.neighbours, np.int64),
        stack=np.zeros(2 * MAX_DEPTH, np.int32),
        plane=np.zeros(MAX_DEPTH, np.float32),
        radiance=np.zeros((LANES, 3), np.float32),
    )


@inline
def estimate(scene, photons, work, p, n, wo, material, reach):
    """L_c (RGB radiance) at p. reach: a bound on the distance of the k-th nearest photon, or the map's radius.

    Returns L_c and that distance; the map's radius where there are fewer than k within it.
    """
    found = nearest(
        photons.x,
        photons.y,
        photons.z,
        photons.axis,
        0,
        photons.x.shape[0],
        p,
        reach * reach,
        photons.neighbours,
        work.distance,
        work.row,
        work.stack,
        work.plane,
    )
    radius: Any = np.float32(photons.radius)
    if found == photons.neighbours:
        radius = math.sqrt(work.distance[0])
    if found == 0 or radius <= ZERO:
        return BLACK, radius
    total = BLACK
    inverse = ONE / (radius * radius)
    lambert = scene.kind[material] == DIFFUSE
    for i in range(found):
        photon = work.row[i]
        wi = vec.row(photons.direction, photon)
        w = ONE - work.distance[i] * inverse
        if w > ZERO and vec.dot(n, vec.row(photons.normal, photon)) > NORMALS and vec.dot(n, wi) > ZERO:
            flux = vec.scale(vec.row(photons.flux, photon), w)
            if not lambert:
                flux = vec.mul(flux, bsdf.evaluate(scene, material, n, wo, wi))
            total = vec.add(total, flux)
    if lambert:
        total = vec.scale(vec.mul(total, vec.row(scene.reflectance, material)), INV_PI)
    return vec.scale(total, TWO * INV_PI * inverse), radius


@inline
def estimate_tile(scene, photons, work, packet, lane, materials):
    """L_c of the first vertices of a tile, in `work.radiance`. packet, lane, materials: see `full_radiance.PassWork`.

    The k-th nearest of a vertex is at most as far as that of the vertex before, plus the way between the two: a bound
    that spares the search most of its work.
    """
    most = np.float32(photons.radius)
    reach = most
    before = BLACK
    for i in range(LANES):
        if lane[i, 3] == ZERO:
            continue
        p = (packet[ws.POINT + i], packet[ws.POINT + 16 + i], packet[ws.POINT + 32 + i])
        n = (packet[ws.NORMAL + i], packet[ws.NORMAL + 16 + i], packet[ws.NORMAL + 32 + i])
        wo = (packet[ws.OUT + i], packet[ws.OUT + 16 + i], packet[ws.OUT + 32 + i])
        if reach < most:
            d = vec.sub(p, before)
            reach = min(most, SLACK * (reach + math.sqrt(vec.dot(d, d))))
        light, reach = estimate(scene, photons, work, p, n, wo, materials[i], reach)
        before = p
        for c in range(3):
            work.radiance[i, c] = light[c]
