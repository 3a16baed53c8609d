"""From caustic points to forecast maps: vector quantization, energy ranks, clusters that overlap, the search radius."""

import math

import naive
import numba
import numpy as np
import pytest
from scipy.cluster.vq import kmeans2
from test_kernels_kdtree import run_nearest

from causticmpi.kernels import vec
from causticmpi.preprocess.forecast import CULLED, ForecastMaps, build_forecast, cluster_of, energy_ranks, no_forecast
from causticmpi.preprocess.photons import CausticPoints
from causticmpi.preprocess.vector_quantization import EPOCHS, NORMAL_WEIGHT, assign, features, learn_codebook

CLUSTERS = 40
CHAINS = np.int32([-5, 7, 1 << 30, 4, 5, 6, 8, 9, 10, 11, 12, 13])


def caustic_points(n: int = 20_000, seed: int = 1) -> CausticPoints:
    """A bright ring and a faint spread on a floor, and a patch on a wall, of chains each rarer than the last."""
    generator = np.random.default_rng(seed)
    kind = generator.choice(3, n, p=[0.6, 0.2, 0.2])
    angle, spread = generator.uniform(0, 2 * np.pi, n), 0.02 * generator.normal(size=n)
    ring = np.stack([(0.3 + spread) * np.cos(angle), 0 * angle, (0.3 + spread) * np.sin(angle)], axis=1)
    floor = generator.uniform(-1, 1, (n, 3)) * [1, 0, 1]
    wall = generator.uniform(-0.2, 0.2, (n, 3)) * [0, 1, 1] + [1, 0.5, 0]
    position = np.choose(kind[:, None], [ring, floor, wall])
    normal = np.where(kind[:, None] == 2, [-1.0, 0, 0], [0, 1.0, 0])
    direction = naive.unit(normal + 0.3 * generator.normal(size=(n, 3)))
    power = generator.exponential(size=(n, 3)) * np.array([3.0, 0.5, 1.0])[kind][:, None]
    curvature = generator.normal(size=(n, 6))
    chain = generator.choice(CHAINS, n, p=0.5 ** np.minimum(1 + np.arange(len(CHAINS)), len(CHAINS) - 1))
    floats = (np.ascontiguousarray(a, np.float32) for a in (position, normal, direction, power, curvature))
    return CausticPoints(*floats, chain)


POINTS = caustic_points()


def build(points: CausticPoints = POINTS, **changes: object) -> tuple:
    """build_forecast with defaults for tests."""
    settings: dict = {"seed": 3, "clusters": CLUSTERS, "neighbours": 50, "table": (32, 16), "max_rank": 8}
    return build_forecast(points, **(settings | {"splitting": 8} | changes))


@numba.njit
def run_cluster_of(maps, p, n, out):
    distance = np.empty(maps.codebook.shape[1], np.float32)
    for i in range(p.shape[0]):
        out[i] = cluster_of(maps, vec.row(p, i), vec.row(n, i), distance)


def squared_distances(codebook: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """(points, codewords) in float64."""
    return ((feature.T[:, None].astype(np.float64) - codebook.T[None].astype(np.float64)) ** 2).sum(axis=2)


def assigned(codebook: np.ndarray, feature: np.ndarray) -> np.ndarray:
    cluster = np.empty(feature.shape[1], np.int32)
    assign(codebook, feature, np.empty(codebook.shape[1], np.float32), cluster)
    return cluster


def test_features() -> None:
    feature, scale = features(POINTS.position, POINTS.normal)
    extent = np.linalg.norm(POINTS.position.max(axis=0) - POINTS.position.min(axis=0))
    assert scale == pytest.approx(NORMAL_WEIGHT * extent)
    assert np.array_equal(feature[:3].T, POINTS.position)  # unscaled: distances are scene units
    np.testing.assert_allclose(feature[3:].T, POINTS.normal * scale, rtol=1e-6)
    assert features(POINTS.position[:1], POINTS.normal[:1])[1] > 0


def test_assign_is_the_nearest_codeword() -> None:
    feature, _ = features(POINTS.position, POINTS.normal)
    codebook = learn_codebook(feature, CLUSTERS, 3)
    d2, cluster = squared_distances(codebook, feature), assigned(codebook, feature)
    mine, least = d2[np.arange(len(cluster)), cluster], d2.min(axis=1)
    assert (mine <= least * (1 + 1e-5) + 1e-12).all() and (cluster == d2.argmin(axis=1)).mean() > 0.999


def test_codebook_is_deterministic_and_small_inputs_work() -> None:
    feature, _ = features(POINTS.position, POINTS.normal)
    a, b, c = (learn_codebook(feature, CLUSTERS, seed) for seed in (3, 3, 4))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert learn_codebook(feature[:, :5].copy(), CLUSTERS, 3).shape == (6, 5)
    assert learn_codebook(feature, 1, 3).shape == (6, 1)
    same = np.repeat(feature[:, :1], 100, axis=1)
    assert np.isfinite(learn_codebook(same, 8, 3)).all()


def test_codebook_against_plain_competitive_learning() -> None:
    """All 2000 points are training vectors, in the order of the generator that the seed names."""
    feature, _ = features(POINTS.position[:2000], POINTS.normal[:2000])
    training = np.random.Generator(np.random.Philox(key=5)).permutation(2000)
    oracle = naive.competitive_learning(feature, training, 12, EPOCHS)
    np.testing.assert_allclose(learn_codebook(feature, 12, 5), oracle, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_quantization_is_near_that_of_kmeans(seed: int) -> None:
    """Mean squared error within twice that of the best of four runs of k-means, and no cluster starves."""
    feature, _ = features(POINTS.position, POINTS.normal)
    codebook = learn_codebook(feature, CLUSTERS, seed)
    error = squared_distances(codebook, feature).min(axis=1).mean()
    data = feature.T.astype(np.float64)
    best = min(
        squared_distances(kmeans2(data, CLUSTERS, minit="++", seed=s)[0].T, feature).min(axis=1).mean()
        for s in range(4)
    )
    assert error < 2 * best
    sizes = np.bincount(assigned(codebook, feature), minlength=CLUSTERS)
    assert sizes.min() > 0.1 * sizes.mean() and sizes.max() < 4 * sizes.mean()


def test_ranks_against_the_definition() -> None:
    generator = np.random.default_rng(7)
    for count in (1, 2, 3, 10, 200):
        for _ in range(20):
            energy = generator.exponential(size=count) ** 3
            energy[generator.random(count) < 0.1] = 0
            area = generator.exponential(size=count)
            area[generator.random(count) < 0.05] = 0
            if energy.sum() == 0:
                continue
            mine = energy_ranks(energy, area)
            oracle = np.array(naive.energy_ranks(list(energy), list(area), CULLED))
            # Beyond rank 20 the rest is 10^-6 of the energy, and rounding has a say.
            assert np.array_equal(mine[oracle < 20], oracle[oracle < 20])
            assert ((mine >= 20) == (oracle >= 20)).all() and ((mine == CULLED) == (oracle == CULLED)).all()
    assert energy_ranks(np.array([4.0, 2, 1, 1]), np.ones(4)).tolist() == [0, 1, 2, 3]  # bounds met exactly
    assert energy_ranks(np.array([1.0, 8]), np.array([1.0, 100])).tolist() == [0, 0]  # density orders, energy sums
    assert (energy_ranks(np.zeros(3), np.ones(3)) == CULLED).all()


def test_figure_2() -> None:
    """Ranks 0 … n hold at least 1 - 0.5^(n+1) of the energy, and would hold less without their last cluster."""
    generator = np.random.default_rng(8)
    for _ in range(50):
        energy, area = generator.exponential(size=300), generator.exponential(size=300)
        rank = energy_ranks(energy, area)
        density, total = energy / area, energy.sum()
        assert (np.diff(rank[np.argsort(-density)]) >= 0).all() and rank.min() == 0
        for n in range(rank.max() + 1):
            within = rank <= n
            held = energy[within].sum() / total
            assert held >= 1 - 0.5 ** (n + 1) - 1e-9
            last = np.flatnonzero(within)[density[within].argmin()]
            assert held - energy[last] / total < 1 - 0.5 ** (n + 1)


def test_statistics_of_clusters() -> None:
    maps, statistics, _ = build()
    feature, scale = features(POINTS.position, POINTS.normal)
    assert maps.normal_scale == scale
    cluster = assigned(maps.codebook, feature)
    power = POINTS.power.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    for j in range(CLUSTERS):
        members = cluster == j
        assert statistics.photons[j] == members.sum()
        assert statistics.energy[j] == pytest.approx(power[members].sum() / power.sum(), rel=1e-9)
        around = POINTS.position[members] - POINTS.position[members].mean(axis=0, dtype=np.float64)
        assert statistics.area[j] == pytest.approx(2 * math.pi * (around**2).sum(axis=1).mean(), rel=1e-4)
    expected = energy_ranks(statistics.energy, statistics.area)
    assert np.array_equal(maps.rank, expected) and np.array_equal(statistics.rank, expected)


WHERE = {tuple(p): i for i, p in enumerate(POINTS.position.tolist())}


def members_of(maps: ForecastMaps, j: int) -> np.ndarray:
    """Rows of POINTS in the tree of cluster j, by way of their coordinates, which are all different."""
    rows = slice(maps.start[j], maps.start[j + 1])
    return np.array([WHERE[p] for p in zip(*(a[rows].tolist() for a in (maps.x, maps.y, maps.z)), strict=True)], int)


@pytest.mark.parametrize("max_rank", [2, 30])
def test_members_are_those_within_epsilon_of_the_border(max_rank: int) -> None:
    """A point is in the tree of j if it lies on j's side, or within epsilon, of the bisector between j and its own."""
    maps, statistics, _ = build(max_rank=max_rank, overlap=0.05)
    feature, _ = features(POINTS.position, POINTS.normal)
    d2 = squared_distances(maps.codebook, feature)
    own = assigned(maps.codebook, feature)
    centres = maps.codebook.T.astype(np.float64)
    for j in range(CLUSTERS):
        got = np.sort(members_of(maps, j))
        if statistics.rank[j] > max_rank:
            assert len(got) == 0
            continue
        between = np.linalg.norm(centres[own] - centres[j], axis=1)
        with np.errstate(invalid="ignore"):
            to_border = (d2[:, j] - d2[np.arange(len(own)), own]) / (2 * between)
        inside = (own == j) | (to_border <= 0.05)
        sure = (own == j) | (np.abs(to_border - 0.05) > 1e-6)
        assert np.array_equal(np.isin(np.arange(len(own)), got)[sure], inside[sure])
        rows = slice(maps.start[j], maps.start[j + 1])
        expected = POINTS.power[members_of(maps, j)] @ np.array([0.2126, 0.7152, 0.0722])
        np.testing.assert_allclose(maps.power[rows], expected, rtol=1e-5)
        assert np.array_equal(maps.direction[rows], POINTS.direction[members_of(maps, j)])


def test_gather_in_a_cluster_misses_nothing_within_epsilon() -> None:
    """With overlap = radius, the tree of p's cluster holds every photon nearer to p than the radius in FEATURE space.

    For such a photon d(photon, border) <= |photon - p|, as p lies on its side of every bisector. On one plane (equal
    normals) feature distance is distance, so the gather is what a tree over all photons would give.
    """
    maps, statistics, _ = build(max_rank=CULLED - 1)
    radius = statistics.radius
    assert statistics.overlap == radius
    generator = np.random.default_rng(9)
    chosen = generator.integers(0, len(POINTS.power), 300)
    p = POINTS.position[chosen] + np.float32(0.3 * radius) * generator.normal(size=(300, 3)).astype(np.float32)
    normal = np.ascontiguousarray(POINTS.normal[chosen])
    cluster = np.empty(300, np.int64)
    run_cluster_of(maps, np.ascontiguousarray(p), normal, cluster)
    codewords = squared_distances(maps.codebook, np.concatenate([p.T, normal.T * np.float32(maps.normal_scale)]))
    assert (codewords[np.arange(300), cluster] <= codewords.min(axis=1) * (1 + 1e-5)).all()
    members = [members_of(maps, j) for j in range(CLUSTERS)]
    found_any = 0
    for i in range(300):
        low, high = maps.start[cluster[i]], maps.start[cluster[i] + 1]
        rows, distances, found = np.empty((1, 4000), int), np.full((1, 4000), np.inf, np.float32), np.empty(1, int)
        arguments = (p[i : i + 1].copy(), np.float32(radius**2), 4000, rows, distances, found)
        run_nearest(maps.x, maps.y, maps.z, maps.axis, low, high, *arguments)
        got = set(members[cluster[i]][rows[0, : found[0]] - low])
        offset = POINTS.position.astype(np.float64) - p[i]
        turn = maps.normal_scale * (POINTS.normal.astype(np.float64) - normal[i])
        near = np.linalg.norm(offset, axis=1)
        closeness = np.sqrt(near**2 + (turn**2).sum(axis=1))
        assert set(np.flatnonzero(closeness < radius * (1 - 1e-4))) <= got
        assert got <= set(np.flatnonzero(near < radius * (1 + 1e-5)))
        found_any += (closeness < radius).any()
    assert found_any > 250


def test_search_radius_finds_about_n() -> None:
    """Uniform photons on a plane: away from the rim a disc of the automatic radius holds n of them, within 20 %."""
    generator = np.random.default_rng(10)
    position = (generator.random((40_000, 3)) * [1, 0, 1]).astype(np.float32)
    plain = np.tile(np.float32([0, 1, 0]), (40_000, 1))
    nothing = np.zeros((40_000, 6), np.float32), np.zeros(40_000, np.int32)
    points = CausticPoints(position, plain, plain, np.ones_like(position), *nothing)
    maps, statistics, _ = build(points, max_rank=40)
    inner = position[(np.abs(position[:, [0, 2]] - 0.5) < 0.4).all(axis=1)][:400]
    counts = [(((position - p).astype(np.float64) ** 2).sum(axis=1) < statistics.radius**2).sum() for p in inner]
    assert 40 < np.mean(counts) < 60
    given, _, _ = build(radius=0.123, overlap=0.0)
    assert given.radius == 0.123 and given.start[-1] <= len(POINTS.power)


def test_maps_without_photons_and_with_one() -> None:
    assert no_forecast().codebook.shape == (6, 0) and no_forecast((8, 4)).rows == 4
    single = CausticPoints(*(a[:1] for a in POINTS))
    maps, statistics, seconds = build(single)
    assert maps.start.tolist() == [0, 1] and maps.radius > 0 and statistics.rank.tolist() == [0]
    assert set(seconds) == {"clustering", "trees"}


def test_maps_serve_the_samplers_asked_for() -> None:
    """What they do not serve is as in maps without a photon, and of the same types: kernels are compiled once."""
    both, none = build()[0]._asdict(), no_forecast((32, 16), 50)._asdict()
    tables, mixture = (build(sampling=only)[0]._asdict() for only in ("two", "mixture"))
    for name, value in both.items():
        gathers = name in ("start", "x", "y", "z", "direction", "power", "axis")
        steers = name.startswith(("tree_", "anchor", "cell"))
        for maps, served in ((tables, not steers), (mixture, not gathers)):
            if name == "start" and not served:
                assert (maps[name] == 0).all() and maps[name].shape == value.shape
            else:
                np.testing.assert_array_equal(maps[name], value if served else none[name])
            if isinstance(value, np.ndarray):
                assert maps[name].dtype == value.dtype and maps[name].ndim == value.ndim
