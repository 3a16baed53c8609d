"""Nearest neighbours against brute force and against scipy's tree."""

import naive
import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from causticmpi.kernels import kdtree, vec

MOST = 20


@numba.njit
def run_nearest(x, y, z, axis, low, high, points, radius2, most, rows, distances, found):
    distance, row = np.empty(most, np.float32), np.empty(most, np.int64)
    stack, plane = np.empty(2 * kdtree.MAX_DEPTH, np.int32), np.empty(kdtree.MAX_DEPTH, np.float32)
    for i in range(points.shape[0]):
        k = kdtree.nearest(x, y, z, axis, low, high, vec.row(points, i), radius2, most, distance, row, stack, plane)
        found[i] = k
        rows[i, :k], distances[i, :k] = row[:k], distance[:k]


@numba.njit
def run_nearest_in_boxes(x, y, z, box, low, high, points, most, rows, distances):
    distance, row = np.empty(most, np.float32), np.empty(most, np.int64)
    stack, gap = np.empty(2 * kdtree.MAX_DEPTH, np.int32), np.empty(kdtree.MAX_DEPTH, np.float32)
    for i in range(points.shape[0]):
        p = vec.row(points, i)
        k = kdtree.nearest_in_boxes(x, y, z, box, low, high, p, most, distance, row, stack, gap)
        rows[i, :k], distances[i, :k] = row[:k], distance[:k]


class Trees:
    """Trees over runs of points (n, 3), as the forecast maps hold them."""

    def __init__(self, points: np.ndarray, starts: np.ndarray | None = None, order: np.ndarray | None = None) -> None:
        columns = np.ascontiguousarray(points.T, np.float32)
        self.starts = np.array([0, len(points)], np.int64) if starts is None else starts
        self.order = np.arange(len(points), dtype=np.int32) if order is None else order.astype(np.int32)
        self.before = self.order.copy()
        self.axis = np.zeros(len(self.order), np.uint8)
        kdtree.build_trees(columns, self.starts, self.order, self.axis, np.zeros(2 * kdtree.MAX_DEPTH, np.int64))
        self.x, self.y, self.z = (np.ascontiguousarray(c) for c in columns[:, self.order])
        self.points = columns.T

    def query(self, p: np.ndarray, radius: float, most: int = MOST, tree: int = 0) -> tuple[np.ndarray, ...]:
        """Rows of the original points (-1 unused), squared distances (inf unused) and numbers found."""
        rows, distances = np.full((len(p), most), -1, np.int64), np.full((len(p), most), np.inf, np.float32)
        found = np.empty(len(p), np.int64)
        low, high = self.starts[tree], self.starts[tree + 1]
        arguments = (np.ascontiguousarray(p, np.float32), np.float32(radius**2), most, rows, distances, found)
        run_nearest(self.x, self.y, self.z, self.axis, low, high, *arguments)
        assert (rows[rows >= 0] >= low).all() and (rows[rows >= 0] < high).all()
        return np.where(rows >= 0, self.order[rows], -1), distances, found

    def query_in_boxes(self, p: np.ndarray, most: int, tree: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """The first two of `query`, however far."""
        rows, distances = np.full((len(p), most), -1, np.int64), np.full((len(p), most), np.inf, np.float32)
        box = np.full((len(self.x), 6), np.nan, np.float32)
        kdtree.box_runs(self.x, self.y, self.z, self.starts, box, np.zeros(2 * kdtree.MAX_DEPTH, np.int64))
        low, high = self.starts[tree], self.starts[tree + 1]
        run_nearest_in_boxes(self.x, self.y, self.z, box, low, high, np.float32(p), most, rows, distances)
        assert (rows[rows >= 0] >= low).all() and (rows[rows >= 0] < high).all()
        return np.where(rows >= 0, self.order[rows], -1), distances


def clustered(n: int) -> np.ndarray:
    generator = np.random.default_rng(2)
    return generator.normal(size=(n // 50, 3))[generator.integers(0, n // 50, n)] + 0.01 * generator.normal(size=(n, 3))


UNIT = np.random.default_rng(1).random((3000, 3))
CLOUDS = {
    "random": UNIT,
    "clustered": clustered(3000),
    "duplicates": UNIT[np.random.default_rng(3).integers(0, 200, 3000)],
    "sorted": UNIT[np.argsort(UNIT[:, 0])],
    "reversed": UNIT[np.argsort(-UNIT[:, 1])],
    "lattice": np.stack(np.meshgrid(*[np.arange(14.0)] * 3), axis=-1).reshape(-1, 3) / 14,
    "equal": np.full((500, 3), 0.3),
    "line": np.linspace(0, 1, 2000)[:, None] * [1, 2, -1],
    "plane": UNIT * [1, 1, 0],
    "far away": UNIT + [1000, -1000, 500],
    "few": UNIT[:7],
    "one": UNIT[:1],
    "a leaf and one": UNIT[: kdtree.LEAF + 1],
}


def queries(points: np.ndarray, count: int = 150) -> np.ndarray:
    generator = np.random.default_rng(4)
    near = points[generator.integers(0, len(points), count)]
    size = max(float(np.ptp(points, axis=0).max()), 0.1)
    near[: 2 * count // 3] += 0.05 * size * generator.normal(size=(2 * count // 3, 3))
    near[: count // 6] += size
    return near.astype(np.float32)


def check(got: np.ndarray, points: np.ndarray, p: np.ndarray, radius: float, most: int, rows: np.ndarray) -> None:
    """Squared distances as brute force finds them; each row once, each truly at the distance reported."""
    for i in range(len(p)):
        oracle = naive.neighbours(points, p[i], radius**2, most)
        mine = np.sort(got[i][np.isfinite(got[i])])
        # float32 may judge a point differently that lies on the very radius
        edge = radius**2 * (1 - 1e-5)
        if len(mine) != len(oracle):
            assert min(len(mine), len(oracle)) >= min(most, (oracle < edge).sum())
        k = min(len(mine), len(oracle))
        scale = np.abs(points).max() ** 2
        np.testing.assert_allclose(mine[:k], oracle[:k], rtol=2e-5, atol=1e-12 * scale)
        used = rows[i][rows[i] >= 0]
        assert len(np.unique(used)) == len(used) == len(mine)
        true = ((points[used] - p[i].astype(np.float64)) ** 2).sum(axis=1)
        np.testing.assert_allclose(got[i][: len(used)], true, rtol=2e-5, atol=1e-12 * scale)


@pytest.mark.parametrize("radius", [0.05, 0.4, 1e6])
@pytest.mark.parametrize("name", CLOUDS)
def test_against_brute_force(name: str, radius: float) -> None:
    trees = Trees(CLOUDS[name])
    points = trees.points.astype(np.float64)
    p = queries(points)
    for most in (1, 5, MOST, 4000):
        few = p if most <= MOST else p[:10]
        rows, distances, found = trees.query(few, radius, most)
        assert (found == np.isfinite(distances).sum(axis=1)).all() and found.max() <= min(most, len(points))
        check(distances, points, few, radius, most, rows)


@pytest.mark.parametrize("name", CLOUDS)
def test_in_boxes_against_brute_force(name: str) -> None:
    """From among the points, beside them and far outside."""
    trees = Trees(CLOUDS[name])
    points = trees.points.astype(np.float64)
    p = queries(points)
    p[::5] += np.random.default_rng(8).normal(size=p[::5].shape).astype(np.float32)
    for most in (1, 5, MOST, 4000):
        few = p if most <= MOST else p[:10]
        rows, distances = trees.query_in_boxes(few, most)
        check(distances, points, few, np.inf, most, rows)


def test_against_scipy() -> None:
    points = clustered(50_000).astype(np.float32)
    p = queries(points, 2000)
    _, distances, _ = Trees(points).query(p, 0.2, 50)
    oracle, _ = cKDTree(points.astype(np.float64)).query(p.astype(np.float64), 50, distance_upper_bound=0.2)
    mine = np.sqrt(np.sort(distances, axis=1))
    disagree = np.isfinite(mine) != np.isfinite(oracle)
    assert disagree.sum() <= 2  # a point on the radius itself
    both = np.isfinite(mine) & np.isfinite(oracle)
    np.testing.assert_allclose(mine[both], oracle[both], rtol=1e-5, atol=1e-7)


def test_several_trees() -> None:
    """Runs of one order, with overlaps and an empty one: each search stays inside its tree."""
    generator = np.random.default_rng(6)
    sizes = [400, 0, 1, kdtree.LEAF, 2500]
    order = np.concatenate([generator.choice(3000, size, replace=False) for size in sizes])
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    trees = Trees(UNIT, starts, order)
    for tree in range(len(sizes)):
        members = slice(starts[tree], starts[tree + 1])
        assert sorted(trees.order[members]) == sorted(trees.before[members])  # permuted within the run only
        p = queries(UNIT, 60)
        rows, distances, found = trees.query(p, 0.3, tree=tree)
        points = np.full((3000, 3), 1e9)
        points[trees.before[members]] = UNIT.astype(np.float32)[trees.before[members]]
        check(np.where(np.isfinite(distances), distances, np.inf), points, p, 0.3, MOST, rows)
        assert found.max(initial=0) <= sizes[tree]


def test_boxes_of_several_trees() -> None:
    sizes = [400, 1, kdtree.LEAF, 2500]
    order = np.concatenate([np.random.default_rng(7).choice(3000, size, replace=False) for size in sizes])
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    trees = Trees(UNIT, starts, order)
    for tree in range(len(sizes)):
        p = queries(UNIT, 60)
        rows, distances = trees.query_in_boxes(p, MOST, tree)
        points = np.full((3000, 3), 1e9)
        members = trees.before[starts[tree] : starts[tree + 1]]
        points[members] = UNIT.astype(np.float32)[members]
        check(distances, points, p, 1e6, MOST, rows)


@pytest.mark.parametrize("name", CLOUDS)
def test_shape_of_the_tree(name: str) -> None:
    """Every inner place splits its run in the middle along the widest axis."""
    trees = Trees(CLOUDS[name])
    assert sorted(trees.order) == list(range(len(trees.order)))
    columns = np.stack([trees.x, trees.y, trees.z])
    runs = [(0, len(trees.order))]
    while runs:
        low, high = runs.pop()
        if high - low <= kdtree.LEAF:
            continue
        middle, span = (low + high) // 2, np.ptp(columns[:, low:high], axis=1)
        keys = columns[trees.axis[middle]]
        assert span[trees.axis[middle]] == span.max()
        assert (keys[low:middle] <= keys[middle]).all() and (keys[middle + 1 : high] >= keys[middle]).all()
        runs += [(low, middle), (middle + 1, high)]
