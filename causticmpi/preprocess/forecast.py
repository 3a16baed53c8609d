"""Cluster map and forecast maps: caustic points clustered, ranked by energy and put into search trees [CF sec. 3.2]."""

import math
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import kdtree
from causticmpi.kernels.jit import inline, kernel
from causticmpi.preprocess.anchors import build_anchors, no_anchors
from causticmpi.preprocess.cells import build_cells, cell_edge, no_cells
from causticmpi.preprocess.chains import part_chains
from causticmpi.preprocess.directions import COLUMNS, ROWS, coarse_tables
from causticmpi.preprocess.k_means import k_means_codebook
from causticmpi.preprocess.photons import CausticPoints
from causticmpi.preprocess.vector_quantization import assign, features, learn_codebook, nearest_codeword

CULLED = 1 << 20
"""Rank of a cluster without energy."""
CODEBOOKS = {"vq": learn_codebook, "kmeans": k_means_codebook}
"""Values of `forecast.clustering`."""


class ForecastMaps(NamedTuple):
    """What rank 0 broadcasts: the cluster map and one forecast map per cluster, as flat arrays for kernels.

    codebook (6, m) float32: the cluster map, codewords in feature space (position, normal * normal_scale)
    rank (m,) int32: energy rank of each cluster; start (m+1,) int64: its rows of the forecast map
    x, y, z, power (k,) float32, direction (k, 3) float32, axis (k,) uint8: forecast photons in tree order, none for
    mixture sampling, which goes by what follows
    coarse (m, bins) float32: running sums of each cluster's directions (see directions.py)
    tree_x, tree_y, tree_z (n,) float32, tree_axis (n,) uint8, tree_start (7,) int64: trees over all caustic points, by
    the way their surface faces; anchor_start (7,) int64: the anchors of each; anchor (anchors, 3) float32,
    anchor_photon (anchors, ROWS times n or more) int16: where they are and photons of rare chains and the nearest
    others (see parallax.py and packed_photons.py); anchor_count (anchors,) int32: how many they are (see anchors.py)
    cell_size [scene units]; cell_key, cell_row (2^k,): hash table of occupied cells; cell (cells, 3) float32,
    cell_photon (cells, ROWS * KEPT) int16: the middle of each and photons that stand for it (see cells.py)
    normal_scale, radius: scene units; columns, rows: bins of the directional tables; neighbours: n
    """

    codebook: Any
    rank: Any
    start: Any
    x: Any
    y: Any
    z: Any
    direction: Any
    power: Any
    axis: Any
    coarse: Any
    tree_x: Any
    tree_y: Any
    tree_z: Any
    tree_axis: Any
    tree_start: Any
    anchor_start: Any
    anchor: Any
    anchor_photon: Any
    anchor_count: Any
    cell_size: float
    cell_key: Any
    cell_row: Any
    cell: Any
    cell_photon: Any
    normal_scale: float
    radius: float
    max_rank: int
    splitting: int
    columns: int
    rows: int
    neighbours: int


@dataclass(frozen=True)
class ClusterStatistics:
    """Per cluster: photons (m,), energy (m,) fraction, area (m,) units^2, rank (m,). radius: of the gather; overlap:
    epsilon; both in scene units."""

    photons: np.ndarray
    energy: np.ndarray
    area: np.ndarray
    rank: np.ndarray
    radius: float
    overlap: float


def energy_ranks(energy: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Rank of each cluster [CF sec. 3.2], 0 the most important.

    energy (m,), area (m,). The clusters are ordered by energy density; cluster j has the rank n for which the clusters
    before it hold at least 1 - 0.5^n of the energy: the ranks 0 … n together hold at least 1 - 0.5^(n+1), which is what
    the paper's Fig. 2 shows (rank 0: 50 %), where its text says "at most 1 - 0.5^n".
    """
    rank = np.full(len(energy), CULLED, np.int32)
    total = energy.sum()
    if total <= 0:
        return rank
    density = np.where(area > 0, energy / np.where(area > 0, area, 1), np.where(energy > 0, np.inf, 0))
    order = np.argsort(-density, kind="stable")
    before = np.concatenate([[0], np.cumsum(energy[order])[:-1]]) / total
    rest = np.maximum(1 - before, 2.0**-30)
    rank[order] = np.floor(-np.log2(rest) + 1e-9).astype(np.int32)
    rank[energy <= 0] = CULLED
    return rank


@kernel
def _overlaps(codebook, feature, cluster, gap, wanted, counts, cursor, rows):
    """Members of every wanted cluster: its own points and those within epsilon of its border.

    A point belongs to cluster j too if its distance to the bisector plane of j and its own cluster i is at most
    epsilon: (d_j^2 - d_i^2) <= 2 epsilon |c_j - c_i| = gap[i, j]. With `cursor` given, rows are stored, else only
    counted.
    """
    for p in range(feature.shape[1]):
        own = cluster[p]
        d_own = np.float32(0)
        for c in range(6):
            d = codebook[c, own] - feature[c, p]
            d_own += d * d
        for w in range(wanted.shape[0]):
            j = wanted[w]
            d2 = np.float32(0)
            for c in range(6):
                d = codebook[c, j] - feature[c, p]
                d2 += d * d
            # j == own by name: rounding may differ between the two sums.
            if j == own or d2 - d_own <= gap[own, j]:
                if rows.shape[0] > 0:
                    rows[cursor[j]] = p
                    cursor[j] += 1
                else:
                    counts[j] += 1


def build_forecast(
    points: CausticPoints,
    seed: int,
    clusters: int,
    neighbours: int,
    table: tuple[int, int],
    max_rank: int,
    splitting: int,
    radius: float | None = None,
    overlap: float | None = None,
    clustering: str = "vq",
    sampling: str | None = None,
) -> tuple[ForecastMaps, ClusterStatistics, dict[str, float]]:
    """Cluster, rank and index at least one caustic point. Also returns the seconds of `clustering` and of `trees`.

    radius: of the gather in scene units; None: n neighbours at the average density of the ranked clusters.
    overlap: epsilon around a cluster in scene units; None: the radius, so that a gather near the border of a cluster
    finds what a tree over all photons would. clustering: a key of CODEBOOKS. sampling: value of `forecast.sampling`
    that the maps are to serve; None: any of them.
    Raises ValueError for photons that are not finite: a density made of them would be none.
    """
    if not all(np.isfinite(array).all() for array in points):
        raise ValueError("a photon of the forecast is not finite: found nan or inf; allowed: finite numbers")
    began = time.perf_counter()
    feature, scale = features(points.position, points.normal)
    codebook = CODEBOOKS[clustering](feature, clusters, seed)
    count = codebook.shape[1]
    cluster = np.empty(feature.shape[1], np.int32)
    assign(codebook, feature, np.empty(count, np.float32), cluster)
    photons = np.bincount(cluster, minlength=count)
    power = points.power.astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    energy = np.bincount(cluster, weights=power, minlength=count)
    area = _disc_areas(points.position, cluster, count, photons)
    rank = energy_ranks(energy, area)
    wanted = np.flatnonzero(rank <= max_rank)
    if radius is None:
        density = photons[wanted].sum() / max(area[wanted].sum(), 1e-300)
        extent = float(np.linalg.norm(np.ptp(points.position, axis=0)))
        radius = min(math.sqrt(neighbours / (math.pi * density)), extent or 1.0) if density > 0 else 1.0
    overlap = radius if overlap is None else overlap
    clustered = time.perf_counter()
    maps = no_forecast(table, neighbours)._replace(
        codebook=codebook,
        rank=rank,
        coarse=coarse_tables(points.direction, power, cluster, count),
        start=np.zeros(count + 1, np.int64),
        normal_scale=scale,
        radius=radius,
        max_rank=max_rank,
        splitting=splitting,
    )
    if sampling != "mixture":
        maps = maps._replace(**_forecast_maps(points, power, codebook, feature, cluster, wanted, overlap))
    if sampling in ("mixture", None):
        grey = points._replace(power=power.astype(np.float32))
        chains = part_chains(grey)
        maps = maps._replace(
            **build_anchors(grey, chains, radius, neighbours),
            **build_cells(grey, chains, cell_edge(radius, neighbours)),
        )
    seconds = {"clustering": clustered - began, "trees": time.perf_counter() - clustered}
    return maps, ClusterStatistics(photons, energy / max(energy.sum(), 1e-300), area, rank, radius, overlap), seconds


def _forecast_maps(
    points: CausticPoints,
    power: np.ndarray,
    codebook: np.ndarray,
    feature: np.ndarray,
    cluster: np.ndarray,
    wanted: np.ndarray,
    overlap: float,
) -> dict[str, Any]:
    """The fields of `ForecastMaps` from `start` to `axis`: a tree over the photons of each wanted cluster."""
    centres = codebook.T.astype(np.float64)
    gap = 2 * overlap * np.linalg.norm(centres[:, None] - centres[None], axis=2)
    order, start = _forecast_rows(codebook, feature, cluster, gap.astype(np.float32), wanted)
    axis = np.zeros(len(order), np.uint8)
    position = np.ascontiguousarray(points.position.T)
    kdtree.build_trees(position, start, order, axis, np.zeros(2 * kdtree.MAX_DEPTH, np.int64))
    x, y, z = np.take(position, order, axis=1)
    direction, strength = points.direction[order], power[order].astype(np.float32)
    return {"start": start, "x": x, "y": y, "z": z, "direction": direction, "power": strength, "axis": axis}


def no_forecast(table: tuple[int, int] = (32, 16), neighbours: int = 1) -> ForecastMaps:
    """Maps without a cluster: every point is sampled by its BRDF alone."""
    floats, column = np.empty(0, np.float32), np.empty((6, 0), np.float32)
    return ForecastMaps(
        codebook=column,
        rank=np.empty(0, np.int32),
        start=np.zeros(1, np.int64),
        x=floats,
        y=floats,
        z=floats,
        direction=np.empty((0, 3), np.float32),
        power=floats,
        axis=np.empty(0, np.uint8),
        coarse=np.empty((0, COLUMNS * ROWS), np.float32),
        **no_anchors(neighbours),
        **no_cells(),
        normal_scale=1.0,
        radius=1.0,
        max_rank=0,
        splitting=1,
        columns=table[0],
        rows=table[1],
        neighbours=neighbours,
    )


def _disc_areas(position: np.ndarray, cluster: np.ndarray, count: int, photons: np.ndarray) -> np.ndarray:
    """Area of each cluster as that of a disc with the same mean squared distance from its centre: 2 pi E[r^2]."""
    n = np.maximum(photons, 1)
    mean_square = np.zeros(count)
    for c in range(3):
        x = position[:, c].astype(np.float64)
        mean = np.bincount(cluster, weights=x, minlength=count) / n
        mean_square += np.bincount(cluster, weights=(x - mean[cluster]) ** 2, minlength=count) / n
    return 2 * math.pi * mean_square


def _forecast_rows(
    codebook: np.ndarray, feature: np.ndarray, cluster: np.ndarray, gap: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the caustic points by cluster, overlaps included: (k,) int32, and the start of each cluster (m+1,)
    int64."""
    count = codebook.shape[1]
    counts = np.zeros(count, np.int64)
    nothing = np.empty(0, np.int32)
    _overlaps(codebook, feature, cluster, gap, wanted, counts, counts, nothing)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    rows = np.empty(start[-1], np.int32)
    if len(rows):
        _overlaps(codebook, feature, cluster, gap, wanted, counts, start[:-1].copy(), rows)
    return rows, start


@inline
def cluster_of(maps, p, n, distance):
    """The cluster that p with normal n falls into: nearest codeword in feature space. distance (m,): workspace."""
    s = np.float32(maps.normal_scale)
    return nearest_codeword(maps.codebook, (p[0], p[1], p[2], n[0] * s, n[1] * s, n[2] * s), distance)
