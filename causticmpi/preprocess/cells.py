"""Cells: grids over the caustic points whose occupied cells remember a few photons each, and one of each chain that is
rare there, found in O(1).

The middle level of the forecast: finer than a cluster's aggregated directions, coarser than anchors. It serves the
vertices that no anchor reaches.
"""

import math
from typing import Any

import numpy as np

from causticmpi.kernels import rng, vec
from causticmpi.kernels.jit import inline, kernel
from causticmpi.preprocess.chains import Chains, forget, represent, witness, witnesses
from causticmpi.preprocess.packed_photons import no_photons, packed_photons
from causticmpi.preprocess.parallax import POWER, ROWS, lay, settle
from causticmpi.preprocess.photons import CausticPoints

DRAWN, KEPT = 16, 32
"""Photons of a cell: drawn from its own in proportion to power, and with those that stand for chains of which few are
among them."""
FEWEST = 4
"""Photons below which a cell says nothing."""
KNOWN = 4
"""Of a chain with so many among those drawn enough is known."""
COMPANIONS = 2
"""Other photons of the cell that tell how wide a photon's cone is (parallax)."""
PHOTONS_PER_CELL = 48
LEVELS, COARSER = 3, 3
"""Grids, and the ratio of their cells' edges from one to the next: where photons are thin a larger cell speaks."""
EMPTY = np.uint64(0)


@inline
def cell_key(size, level, p, n):
    """Key of the cell of a level that p with normal n lies in, never EMPTY: place in the grid and the axis n is closest
    to. size: edge of its cells."""
    face = 6 * level + vec.closest_axis(n)
    x, y, z = np.int64(math.floor(p[0] / size)), np.int64(math.floor(p[1] / size)), np.int64(math.floor(p[2] / size))
    key = rng.mix(np.uint64(x) * np.uint64(73856093) + np.uint64(face))
    key = rng.mix(key ^ np.uint64(y))
    return rng.mix(key ^ np.uint64(z)) | np.uint64(1)


@inline
def cell_of(maps, p, n):
    """Row of the smallest cell with enough photons that p with normal n lies in; -1 where there is none."""
    mask = np.uint64(maps.cell_key.shape[0] - 1)
    size = np.float32(maps.cell_size)
    for level in range(LEVELS):
        key = cell_key(size, level, p, n)
        place = key & mask
        while maps.cell_key[place] != EMPTY:
            if maps.cell_key[place] == key:
                return np.int64(maps.cell_row[place])
            place = (place + np.uint64(1)) & mask
        size *= np.float32(COARSER)
    return np.int64(-1)


@kernel
def _keys(size, level, position, normal, keys):
    for i in range(keys.shape[0]):
        p = (position[i, 0], position[i, 1], position[i, 2])
        keys[i] = cell_key(np.float32(size), level, p, (normal[i, 0], normal[i, 1], normal[i, 2]))


@kernel
def _fill(found, table, row):
    """Open addressing: cell i under found[i]."""
    mask = np.uint64(table.shape[0] - 1)
    for i in range(found.shape[0]):
        place = found[i] & mask
        while table[place] != EMPTY:
            place = (place + np.uint64(1)) & mask
        table[place], row[place] = found[i], i


def cell_edge(radius: float, neighbours: int) -> float:
    """Edge of a cell [scene units] that holds PHOTONS_PER_CELL where the search radius holds the neighbours."""
    return radius * math.sqrt(math.pi * PHOTONS_PER_CELL / neighbours)


@kernel
def _gather(chains, points, cell, facing, area, chosen, each, companions, photon, work):
    """Fill photon (cells, ROWS, KEPT), all 0: those drawn for all cells, and behind them such as stand for rare chains.

    cell (cells, 3), facing (cells,); area: of a cell; chosen (cells, DRAWN): rows of the photons drawn; each (cells,):
    their power; companions (cells,); work: witnesses, offset (3, DRAWN) and rest, for `settle`.
    """
    told, offset, rest = work
    for i in range(cell.shape[0]):
        p = (cell[i, 0], cell[i, 1], cell[i, 2])
        forget(chains, told, facing[i])
        for k in range(DRAWN):
            witness(chains, told, chosen[i, k])
            lay(photon[i], offset, k, points, chosen[i, k], p)
            photon[i, POWER, k] = each[i]
        settle(photon[i], offset, DRAWN, companions[i], rest)
        represent(chains, points, told, facing[i], p, KNOWN, area, photon[i], DRAWN, KEPT - DRAWN)


def build_cells(points: CausticPoints, chains: Chains, size: float) -> dict[str, Any]:
    """The `cell*` fields of `ForecastMaps` from caustic points whose power is a number (n,).

    size: edge of the smallest cells [scene units].
    """
    levels = [_level(points, chains, size * COARSER**i, i) for i in range(LEVELS)]
    keys, centres, photons = (np.concatenate(parts) for parts in zip(*levels, strict=True))
    table = np.zeros(1 << max(1, int(2 * len(keys))).bit_length(), np.uint64)
    row = np.zeros(len(table), np.int32)
    _fill(keys, table, row)
    return {
        "cell_size": float(size),
        "cell_key": table,
        "cell_row": row,
        "cell": centres,
        "cell_photon": photons,
    }


def _level(points: CausticPoints, chains: Chains, size: float, level: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keys (cells,), middles (cells, 3) and packed photons (cells, ROWS * KEPT) of the cells of a level that have
    enough."""
    position, normal, power = points.position, points.normal, points.power
    keys = np.empty(len(power), np.uint64)
    _keys(size, level, position, normal, keys)
    order = np.argsort(keys, kind="stable")
    found, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
    running = np.concatenate([[0.0], np.cumsum(power[order].astype(np.float64))])
    low, high = running[first], running[first + counts]
    telling = (counts >= FEWEST) & (high > low)
    found, first, counts, low, high = (a[telling] for a in (found, first, counts, low, high))
    # Systematic resampling: every DRAWN-th part of a cell's power names a photon.
    marks = low[:, None] + (high - low)[:, None] * ((np.arange(DRAWN) + 0.5) / DRAWN)
    chosen = np.searchsorted(running, marks, side="right") - 1
    chosen = order[np.clip(chosen, first[:, None], (first + counts - 1)[:, None])]
    centre = position[chosen].mean(axis=1, dtype=np.float64).astype(np.float32)
    repeats = -(-DRAWN // np.minimum(counts, DRAWN))
    companions = np.minimum(DRAWN - 1, repeats * (1 + COMPANIONS) - 1)
    photon = np.zeros((len(found), ROWS, KEPT), np.float32)
    facing, area, each = chains.facing[order[first]], np.float32(size**2), (high - low) / DRAWN
    work = witnesses(chains, KEPT - DRAWN), np.zeros((3, DRAWN), np.float32), np.zeros((5, DRAWN), np.float32)
    _gather(chains, points, centre, facing, area, chosen, each, companions, photon, work)
    return found, centre, packed_photons(photon)


def no_cells() -> dict[str, Any]:
    """A grid without an occupied cell."""
    return {
        "cell_size": 1.0,
        "cell_key": np.zeros(2, np.uint64),
        "cell_row": np.zeros(2, np.int32),
        "cell": np.zeros((0, 3), np.float32),
        "cell_photon": no_photons(0, KEPT),
    }
