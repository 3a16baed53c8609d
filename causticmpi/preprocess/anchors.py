"""Anchors: places among the caustic points, each with the photons nearest to it and one of each chain that is rare
there, found once and for all passes.

A forecast is only a pdf: the neighbours of a place close by steer as well as one's own once their directions are turned
to what they are here (parallax), and looking them up costs a walk down a tree instead of a search. The anchors lie as
dense as the photons: one amid every run of at most RUN. There is a tree for each of the six ways that a surface may
face, over all caustic points: clusters overlap by the search radius, which in a large room is most of it.
"""

from typing import Any

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.kdtree import LEAF, MAX_DEPTH, build_trees, nearest, run_of
from causticmpi.preprocess.chains import FACINGS, WITNESSES, Chains, forget, represent, witness, witnesses
from causticmpi.preprocess.packed_photons import no_photons, pack
from causticmpi.preprocess.parallax import ROWS, lay, settle
from causticmpi.preprocess.photons import CausticPoints

RUN = 2 * LEAF
"""Photons around an anchor, at most: rows of the tree that no plane parts further."""
SHORTEST = RUN // 2
"""A run of a tree has at least as many, unless it is the whole tree: the number of its anchor follows from its rows."""
REACH = np.float32(1.75)
"""How far an anchor speaks, and the photons it knows lie from it, over the search radius: from farther off they steer
worse than the cells of a coarser grid do."""
FEWEST_RARE, MOST_RARE = 8, 16
"""Columns at least, besides those of the nearest, for photons of rare chains, and such photons at most: deeper vertices
ask 32 columns, which they come first in."""
COMPANIONS = 4
"""Other photons of the anchor that tell how wide a photon's cone is (parallax)."""


@inline
def anchor_of(maps, p, n):
    """The anchor whose run p with normal n falls into; -1 if p is farther from it than it reaches."""
    facing = vec.closest_axis(n)
    low, high = maps.tree_start[facing], maps.tree_start[facing + 1]
    if low == high:
        return np.int64(-1)
    first, _ = run_of(maps.tree_x, maps.tree_y, maps.tree_z, maps.tree_axis, low, high, p, RUN)
    anchor = np.int64(maps.anchor_start[facing] + (first - low) // SHORTEST)
    x, y, z = (maps.anchor[anchor, 0] - p[0], maps.anchor[anchor, 1] - p[1], maps.anchor[anchor, 2] - p[2])
    reach = REACH * np.float32(maps.radius)
    return anchor if x * x + y * y + z * z < reach * reach else np.int64(-1)


@kernel
def _find_runs(start, anchor_start, runs, run):
    """Rows of every run of the trees over rows start[i] … start[i + 1]: run (anchors, 2), by number of its anchor.

    runs (2 * MAX_DEPTH,) int64: workspace.
    """
    for tree in range(start.shape[0] - 1):
        top = -1
        if start[tree + 1] > start[tree]:
            top = 0
            runs[0], runs[1] = start[tree], start[tree + 1]
        while top >= 0:
            low, high = runs[2 * top], runs[2 * top + 1]
            top -= 1
            if high - low > RUN:
                middle = (low + high) >> 1
                runs[2 * top + 2], runs[2 * top + 3] = low, middle
                runs[2 * top + 4], runs[2 * top + 5] = middle + 1, high
                top += 2
            else:
                anchor = anchor_start[tree] + (low - start[tree]) // SHORTEST
                run[anchor, 0], run[anchor, 1] = low, high


@inline
def _middle(x, y, z, low, high):
    """Of the points in rows [low, high)."""
    a = b = c = 0.0
    for i in range(low, high):
        a, b, c = a + x[i], b + y[i], c + z[i]
    share = 1 / (high - low)
    return np.float32(a * share), np.float32(b * share), np.float32(c * share)


@kernel
def _gather(trees, run, anchor_start, radius2, points, chains, anchor, packed, count, search, work):
    """Fill anchor (anchors, 3), packed (anchors, BLOCK * blocks), all 0, and count (anchors,) from the trees.

    trees: x, y, z, axis, start and the caustic point of each row; search: distance, row (n,), stack and plane of
    `nearest`; work: witnesses, photon (ROWS, n), one for chains (ROWS, MOST_RARE), offset (3, n), work of `settle`.
    """
    x, y, z, axis, start, point = trees
    distance, row, stack, plane = search
    told, photon, rare, offset, rest = work
    for tree in range(start.shape[0] - 1):
        for a in range(anchor_start[tree], anchor_start[tree + 1]):
            if run[a, 0] == run[a, 1]:  # a number that no run has
                continue
            p = _middle(x, y, z, run[a, 0], run[a, 1])
            anchor[a, 0], anchor[a, 1], anchor[a, 2] = p
            first, last = start[tree], start[tree + 1]
            found = nearest(x, y, z, axis, first, last, p, radius2, row.shape[0], distance, row, stack, plane)
            forget(chains, told, tree)
            for i in range(found):
                witness(chains, told, point[row[i]])
            common = 0
            for i in range(found):
                j = point[row[i]]
                if chains.chain[j] < 0 or told.known[chains.chain[j]] >= WITNESSES:
                    lay(photon, offset, common, points, j, p)
                    common += 1
            settle(photon, offset, common, COMPANIONS, rest)
            area = vec.PI * (distance[0] if found == row.shape[0] else radius2)
            room = min(MOST_RARE, packed.shape[1] // ROWS - common)
            held = represent(chains, points, told, tree, p, WITNESSES, area, rare, 0, room)
            # Those of rare chains first: deeper vertices go by the first photons alone.
            pack(rare, held, packed[a], 0)
            pack(photon, common, packed[a], held)
            count[a] = held + common


def columns_for(neighbours: int) -> int:
    """Columns that the photons of an anchor take: with some without power or direction behind them, loops over them are
    vector code without a rest."""
    return -(-(neighbours + FEWEST_RARE) // LANES) * LANES


def build_anchors(points: CausticPoints, chains: Chains, radius: float, neighbours: int) -> dict[str, Any]:
    """The `tree_*` and `anchor*` fields of `ForecastMaps` from caustic points whose power is a number (n,).

    radius: of the search [scene units].
    """
    order = np.argsort(chains.facing, kind="stable").astype(np.int32)
    start = np.searchsorted(chains.facing[order], np.arange(FACINGS + 1)).astype(np.int64)
    axis = np.zeros(len(order), np.uint8)
    columns = np.ascontiguousarray(points.position.T)
    build_trees(columns, start, order, axis, np.zeros(2 * MAX_DEPTH, np.int64))
    x, y, z = np.take(columns, order, axis=1)
    anchor_start = np.concatenate([[0], np.cumsum(-(-np.diff(start) // SHORTEST))]).astype(np.int64)
    run = np.zeros((anchor_start[-1], 2), np.int64)
    _find_runs(start, anchor_start, np.zeros(2 * MAX_DEPTH, np.int64), run)
    anchor = np.zeros((anchor_start[-1], 3), np.float32)
    room = columns_for(neighbours)
    packed = no_photons(anchor_start[-1], room)
    count = np.zeros(anchor_start[-1], np.int32)
    trees = x, y, z, axis, start, order
    search = (
        np.zeros(neighbours, np.float32),
        np.zeros(neighbours, np.int64),
        np.zeros(2 * MAX_DEPTH, np.int32),
        np.zeros(MAX_DEPTH, np.float32),
    )
    shapes = (ROWS, neighbours), (ROWS, MOST_RARE), (3, neighbours), (5, neighbours)
    work = witnesses(chains, MOST_RARE), *(np.zeros(shape, np.float32) for shape in shapes)
    radius2 = (REACH * np.float32(radius)) ** 2
    _gather(trees, run, anchor_start, radius2, points, chains, anchor, packed, count, search, work)
    return {
        "tree_x": x,
        "tree_y": y,
        "tree_z": z,
        "tree_axis": axis,
        "tree_start": start,
        "anchor_start": anchor_start,
        "anchor": anchor,
        "anchor_photon": packed,
        "anchor_count": count,
    }


def no_anchors(neighbours: int) -> dict[str, Any]:
    """Of maps without a photon."""
    floats = np.empty(0, np.float32)
    return {
        "tree_x": floats,
        "tree_y": floats,
        "tree_z": floats,
        "tree_axis": np.empty(0, np.uint8),
        "tree_start": np.zeros(FACINGS + 1, np.int64),
        "anchor_start": np.zeros(FACINGS + 1, np.int64),
        "anchor": np.zeros((0, 3), np.float32),
        "anchor_photon": no_photons(0, columns_for(neighbours)),
        "anchor_count": np.zeros(0, np.int32),
    }
