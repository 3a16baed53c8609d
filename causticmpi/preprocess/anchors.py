"""Anchors: places among the forecast photons, each with the photons nearest to it, found once and for all passes.

A forecast is only a pdf: the neighbours of a place close by steer as well as one's own, and looking them up costs a
walk down a tree instead of a search. The anchors lie as dense as the photons: one amid every run of at most RUN.
"""

from typing import Any

import numpy as np

from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.kdtree import LEAF, MAX_DEPTH, nearest, run_of

PADDING = 64
"""The photons of an anchor are padded to a multiple of this by some without power or direction: loops over them are
vector code without a rest."""
RUN = 2 * LEAF
"""Photons around an anchor, at most: rows of the tree that no plane parts further."""
SHORTEST = RUN // 2
"""A run of a tree has at least as many, unless it is the whole tree: the number of its anchor follows from its rows."""


@inline
def anchor_of(maps, cluster, p):
    """The anchor of a cluster whose run p falls into; -1 if p is farther from it than the search radius."""
    low, high = maps.start[cluster], maps.start[cluster + 1]
    if low == high:
        return np.int64(-1)
    first, _ = run_of(maps.x, maps.y, maps.z, maps.axis, low, high, p, RUN)
    anchor = np.int64(maps.anchor_start[cluster] + (first - low) // SHORTEST)
    x, y, z = (maps.anchor[anchor, 0] - p[0], maps.anchor[anchor, 1] - p[1], maps.anchor[anchor, 2] - p[2])
    radius = np.float32(maps.radius)
    return anchor if x * x + y * y + z * z < radius * radius else np.int64(-1)


@kernel
def _gather_at_anchors(
    x,
    y,
    z,
    axis,
    direction,
    power,
    start,
    anchor_start,
    radius2,
    anchor,
    photon,
    count,
    distance,
    row,
    stack,
    plane,
    runs,
):
    """Fill anchor (anchors, 3), photon (anchors, 4, >= n) and count (anchors,) from trees over the photons.

    distance, row (n,), stack, plane: workspace of `nearest`; runs (2 * MAX_DEPTH,) int64: of the walk.
    """
    for cluster in range(start.shape[0] - 1):
        top = -1
        if start[cluster + 1] > start[cluster]:
            top = 0
            runs[0], runs[1] = start[cluster], start[cluster + 1]
        while top >= 0:
            low, high = runs[2 * top], runs[2 * top + 1]
            top -= 1
            if high - low > RUN:
                middle = (low + high) >> 1
                runs[2 * top + 2], runs[2 * top + 3] = low, middle
                runs[2 * top + 4], runs[2 * top + 5] = middle + 1, high
                top += 2
                continue
            a = anchor_start[cluster] + (low - start[cluster]) // SHORTEST
            sx = sy = sz = 0.0
            for i in range(low, high):
                sx, sy, sz = sx + x[i], sy + y[i], sz + z[i]
            share = 1 / (high - low)
            p = (np.float32(sx * share), np.float32(sy * share), np.float32(sz * share))
            anchor[a, 0], anchor[a, 1], anchor[a, 2] = p
            count[a] = nearest(
                x, y, z, axis, start[cluster], start[cluster + 1], p, radius2, row.shape[0], distance, row, stack, plane
            )
            for i in range(count[a]):
                for c in range(3):
                    photon[a, c, i] = direction[row[i], c]
                photon[a, 3, i] = power[row[i]]


def padded(neighbours: int) -> int:
    """Columns that the photons of an anchor take."""
    return -(-neighbours // PADDING) * PADDING


def build_anchors(
    coordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
    axis: np.ndarray,
    direction: np.ndarray,
    power: np.ndarray,
    start: np.ndarray,
    radius: float,
    neighbours: int,
) -> dict[str, Any]:
    """The `anchor*` fields of `ForecastMaps`; arguments as there, radius in scene units."""
    rows = np.diff(start)
    anchor_start = np.concatenate([[0], np.cumsum(-(-rows // SHORTEST))]).astype(np.int64)
    anchor = np.zeros((anchor_start[-1], 3), np.float32)
    photon = np.zeros((anchor_start[-1], 4, padded(neighbours)), np.float32)
    count = np.zeros(anchor_start[-1], np.int32)
    _gather_at_anchors(
        *coordinates,
        axis,
        direction,
        power,
        start,
        anchor_start,
        np.float32(radius * radius),
        anchor,
        photon,
        count,
        np.zeros(neighbours, np.float32),
        np.zeros(neighbours, np.int64),
        np.zeros(2 * MAX_DEPTH, np.int32),
        np.zeros(MAX_DEPTH, np.float32),
        np.zeros(2 * MAX_DEPTH, np.int64),
    )
    return {"anchor_start": anchor_start, "anchor": anchor, "anchor_photon": photon, "anchor_count": count}


def no_anchors(neighbours: int) -> dict[str, Any]:
    """Of maps without a photon."""
    return {
        "anchor_start": np.zeros(1, np.int64),
        "anchor": np.zeros((0, 3), np.float32),
        "anchor_photon": np.zeros((0, 4, padded(neighbours)), np.float32),
        "anchor_count": np.zeros(0, np.int32),
    }
