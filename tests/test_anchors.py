"""Anchors against a plain reading of the trees: which one a place falls to, and what photons it knows."""

import numba
import numpy as np
import pytest
from test_forecast import build, caustic_points

from causticmpi.kernels import vec
from causticmpi.preprocess.anchors import RUN, SHORTEST, anchor_of
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast


@numba.njit
def run_anchor_of(maps, cluster, points, out):
    for i in range(points.shape[0]):
        out[i] = anchor_of(maps, cluster, vec.row(points, i))


def anchors(maps: ForecastMaps, cluster: int, points: np.ndarray) -> np.ndarray:
    out = np.zeros(len(points), np.int64)
    run_anchor_of(maps, cluster, points.astype(np.float32), out)
    return out


def runs(maps: ForecastMaps, cluster: int) -> list[tuple[int, int]]:
    """Rows of every run of a cluster's tree, by recursion."""

    def below(low: int, high: int) -> list[tuple[int, int]]:
        middle = (low + high) // 2
        return [(low, high)] if high - low <= RUN else below(low, middle) + below(middle + 1, high)

    low, high = (int(row) for row in maps.start[cluster : cluster + 2])
    return below(low, high) if high > low else []


def coordinates(maps: ForecastMaps) -> np.ndarray:
    return np.stack([maps.x, maps.y, maps.z], axis=1)


def naive_anchor(maps: ForecastMaps, cluster: int, p: np.ndarray) -> int:
    """By walking down with a point's own coordinates, and all distances."""
    low, high = (int(row) for row in maps.start[cluster : cluster + 2])
    if low == high:
        return -1
    start, points = low, coordinates(maps)
    while high - low > RUN:
        middle = (low + high) // 2
        axis = maps.axis[middle]
        low, high = (low, middle) if p[axis] < points[middle, axis] else (middle + 1, high)
    anchor = int(maps.anchor_start[cluster]) + (low - start) // SHORTEST
    return anchor if ((maps.anchor[anchor] - p) ** 2).sum() < np.float32(maps.radius) ** 2 else -1


@pytest.fixture(scope="module")
def maps() -> ForecastMaps:
    return build(caustic_points(3000))[0]


def test_every_run_has_an_anchor_of_its_own_in_its_middle(maps: ForecastMaps) -> None:
    points, seen = coordinates(maps), set()
    for cluster in range(len(maps.rank)):
        for low, high in runs(maps, cluster):
            anchor = int(maps.anchor_start[cluster]) + (low - int(maps.start[cluster])) // SHORTEST
            assert anchor not in seen and anchor < maps.anchor_start[cluster + 1]
            seen.add(anchor)
            np.testing.assert_allclose(maps.anchor[anchor], points[low:high].mean(axis=0), atol=1e-6)
    assert len(seen) > 100 and (maps.anchor_count > 0).sum() == len(seen)


def test_anchors_know_the_nearest_photons(maps: ForecastMaps) -> None:
    points = coordinates(maps)
    for cluster in range(len(maps.rank)):
        low, high = maps.start[cluster : cluster + 2]
        for anchor in range(maps.anchor_start[cluster], maps.anchor_start[cluster + 1]):
            count = maps.anchor_count[anchor]
            if count == 0:
                continue
            d2 = ((points[low:high] - maps.anchor[anchor]) ** 2).sum(axis=1)
            near = low + np.argsort(d2)[: maps.neighbours]
            near = near[d2[near - low] < maps.radius**2]
            expected = np.column_stack([maps.direction[near], maps.power[near]])
            found = maps.anchor_photon[anchor, :, :count].T
            assert (maps.anchor_photon[anchor, :, count:] == 0).all()
            assert count == len(near)
            assert np.array_equal(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])


def test_places_find_the_anchor_of_their_run(maps: ForecastMaps) -> None:
    """Photons themselves, places between them, and places too far from any."""
    points = coordinates(maps)
    for cluster in np.flatnonzero(np.diff(maps.start) > 0)[:8]:
        own = points[maps.start[cluster] : maps.start[cluster + 1]]
        moved = own + np.float32(0.7 * maps.radius) * np.random.default_rng(cluster).normal(size=own.shape)
        for asked in (own, moved.astype(np.float32), own + 3 * np.float32(np.ptp(points))):
            assert anchors(maps, cluster, asked).tolist() == [naive_anchor(maps, cluster, p) for p in asked]
    assert (anchors(maps, cluster, own) >= 0).mean() > 0.9


def test_maps_without_photons_have_no_anchor() -> None:
    maps = no_forecast()
    assert len(maps.anchor) == len(maps.anchor_count) == 0 and maps.anchor_start.tolist() == [0]
    empty = build(caustic_points(3000))[0]
    empty = empty._replace(start=np.zeros_like(empty.start))
    assert (anchors(empty, 0, np.zeros((1, 3))) == -1).all()
