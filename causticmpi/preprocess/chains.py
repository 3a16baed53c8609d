"""Chains: caustic points by the mirrors and lenses that their light came by, and a photon that stands for each of them.

The photons nearest to a place are of its brightest chains. Of a faint one, such as what a glass ball throws back to a
mirror, there may be none among them, and a ray that meets the lamp by it all the same, by chance, counts as much as
thousands of others. The light of each chain seems to come from one image of its lamp, however, so that a photon of it
that landed far away tells the direction here too, once it is turned (parallax), and how dense the photons of the chain
lie tells how bright it is. (A chain is known by its shapes alone: two lamps by way of one ball, or two faces of one
prism, are one chain with two images, and one that begins at a wall has no image; its witnesses then disagree, and the
cone is as wide as that.)
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.kdtree import MAX_DEPTH, box_runs, build_trees, nearest_in_boxes
from causticmpi.kernels.vec import ZERO
from causticmpi.preprocess.parallax import POWER, ROWS, lay, settle
from causticmpi.preprocess.photons import CausticPoints

FACINGS = 6
WITNESSES = 5
"""Photons of a chain that tell of it at a place, those nearest to it: chains with fewer tell nothing."""
MOST_CHAINS = 32
"""Of each facing, the strongest: each costs a search for each anchor and cell."""
_MOST = np.float32(1e6)
"""The photon that stands for a chain has no more times its witnesses' power: they may all lie in one place."""


class Chains(NamedTuple):
    """Caustic points by facing and chain.

    facing (n,) int8: the half axis that the surface of a caustic point faces; chain (n,) int32: row of its chain, -1
    for none. Per chain: start (m + 1,) int64, rows of its tree; by facing: first (7,) int64, rows of its chains.
    x, y, z (k,) float32, box (k, 6) float32, point (k,) int32: the trees, and the caustic point of each of their rows.
    """

    facing: Any
    chain: Any
    first: Any
    start: Any
    x: Any
    y: Any
    z: Any
    box: Any
    point: Any


class Witnesses(NamedTuple):
    """Workspace: known (m,): photons of each chain that a place has already; brightness (room,): of the chains that
    photons stand for; photon (ROWS, WITNESSES), offset and rest, for `settle`; distance to gap, for the search."""

    known: Any
    brightness: Any
    photon: Any
    offset: Any
    rest: Any
    distance: Any
    row: Any
    stack: Any
    gap: Any


def witnesses(chains: Chains, room: int) -> Witnesses:
    """Workspace for up to `room` chains at a place."""
    return Witnesses(
        known=np.zeros(len(chains.start) - 1, np.int64),
        brightness=np.zeros(room, np.float32),
        photon=np.zeros((ROWS, WITNESSES), np.float32),
        offset=np.zeros((3, WITNESSES), np.float32),
        rest=np.zeros((5, WITNESSES), np.float32),
        distance=np.zeros(WITNESSES, np.float32),
        row=np.zeros(WITNESSES, np.int64),
        stack=np.zeros(2 * MAX_DEPTH, np.int32),
        gap=np.zeros(MAX_DEPTH, np.float32),
    )


@kernel
def _face(normal, facing):
    for i in range(normal.shape[0]):
        facing[i] = vec.closest_axis((normal[i, 0], normal[i, 1], normal[i, 2]))


def part_chains(points: CausticPoints) -> Chains:
    """Chains of caustic points whose power is a number (n,)."""
    facing = np.empty(len(points.power), np.int8)
    _face(points.normal, facing)
    name = facing.astype(np.int64) << 32 | points.chain.view(np.uint32)
    names, chain, counts = np.unique(name, return_inverse=True, return_counts=True)
    power = np.bincount(chain, weights=points.power, minlength=len(names))
    telling = counts >= WITNESSES
    order = np.lexsort((-power, names >> 32))
    order = order[telling[order]]
    place = np.arange(len(order)) - np.searchsorted(names[order] >> 32, names[order] >> 32)
    telling[order] = place < MOST_CHAINS
    chain = np.where(telling, np.cumsum(telling) - 1, -1)[chain].astype(np.int32)
    start = np.concatenate([[0], np.cumsum(counts[telling])]).astype(np.int64)
    point = np.argsort(chain, kind="stable").astype(np.int32)[len(chain) - start[-1] :]
    axis, columns = np.zeros(len(point), np.uint8), np.ascontiguousarray(points.position.T)
    build_trees(columns, start, point, axis, np.zeros(2 * MAX_DEPTH, np.int64))
    x, y, z = np.take(columns, point, axis=1)
    box = np.zeros((len(point), 6), np.float32)
    box_runs(x, y, z, start, box, np.zeros(2 * MAX_DEPTH, np.int64))
    first = np.searchsorted(names[telling] >> 32, np.arange(FACINGS + 1)).astype(np.int64)
    return Chains(facing, chain, first, start, x, y, z, box, point)


@inline
def forget(chains, work, facing):
    """No photon of a chain of a facing is known."""
    for chain in range(chains.first[facing], chains.first[facing + 1]):
        work.known[chain] = 0


@inline
def witness(chains, work, point):
    """One photon more of the chain of a caustic point is known."""
    if chains.chain[point] >= 0:
        work.known[chains.chain[point]] += 1


@inline
def represent(chains, points, work, facing, p, enough, area, photon, first, room):
    """Fill photons first … first + room - 1 of a place p, photon (ROWS, >= first + room), by such as stand for the
    chains of a facing of which fewer than `enough` are known: of the brightest if there are more.

    points: caustic points as flat arrays; area: that over which a photon already there has its power [units²]; room:
    at least 1. Returns how many there are.
    """
    held = 0
    for chain in range(chains.first[facing], chains.first[facing + 1]):
        if work.known[chain] >= enough:
            continue
        low, high = chains.start[chain], chains.start[chain + 1]
        trees = chains.x, chains.y, chains.z, chains.box
        nearest_in_boxes(*trees, low, high, p, WITNESSES, work.distance, work.row, work.stack, work.gap)
        power, closest = ZERO, 0
        for i in range(WITNESSES):
            power += points.power[chains.point[work.row[i]]]
            closest = i if work.distance[i] < work.distance[closest] else closest
        lit = vec.PI * work.distance[0]
        brightness = power * (area / lit if area < _MOST * lit else _MOST)
        place = held
        if held == room:
            place = 0
            for i in range(room):
                place = i if work.brightness[i] < work.brightness[place] else place
            if work.brightness[place] >= brightness:
                continue
        for i in range(WITNESSES):
            lay(work.photon, work.offset, i, points, chains.point[work.row[i]], p)
        settle(work.photon, work.offset, WITNESSES, WITNESSES - 1, work.rest)
        for row in range(ROWS):
            photon[row, first + place] = work.photon[row, closest]
        photon[POWER, first + place] = brightness
        work.brightness[place] = brightness
        held = max(held, place + 1)
    return held
