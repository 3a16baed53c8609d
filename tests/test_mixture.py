"""Cones around the photons of an anchor: the sampler follows its density; lanes of a tile share a cluster only when
close."""

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, p_value, sidak, uniform_p_value
from test_anchors import naive_anchor
from test_forecast import build, caustic_points
from test_kernels_bsdf import MATERIALS, materials

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.full_radiance import PassWork, pass_work
from causticmpi.estimators.iws_mixture import _foresee_tile
from causticmpi.kernels import vec
from causticmpi.kernels.material_kinds import PHONG
from causticmpi.preprocess.anchors import padded
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast

NORMAL = naive.unit([-0.4, 0.2, 0.6]).astype(np.float32)
OUT = naive.unit([0.1, 0.9, 0.8]).astype(np.float32)
DIFFUSE, SOFT, SHARP = 0, 2, 3
ANCHOR, CLUSTER, LANE = 5, 2, 3
"""The fine sampler is tested at one of 16 anchors, in one of 4 clusters; the others hold rubbish. LANE: of the
vertex."""
FINE_CASES = [
    # material, photons, of them below the horizon, their spread, half angle of the cones in degrees
    (DIFFUSE, 1, 0, 0.0, 30.0),
    (DIFFUSE, 50, 10, 0.5, 10.0),
    (DIFFUSE, 50, 0, 0.1, 3.0),
    (SOFT, 50, 5, 0.5, 10.0),
    (SHARP, 20, 0, 0.3, 20.0),
]
NARROW = [0.25, 0.5, 1.0, 3.0, 30.0]
COMPARISONS = len(FINE_CASES) + len(NARROW)
AXES = 32
LOST = 2e-5
"""Share of a cone's samples that may lie outside it by the rounding of float32: what is lost counts too much."""
STRAY = 1e-5
"""Share of samples that the rounding of float32 may push over the border of their bin."""


@numba.njit
def run_weigh(scene, maps, work, n, wo, material):
    return cm.weigh_fine(scene, maps, work, LANE, ANCHOR, vec.row(n, 0), vec.row(wo, 0), material)


@numba.njit
def run_sample_fine(maps, work, total, u, out):
    for i in range(u.shape[0]):
        direction = cm.sample_fine(maps, work, LANE, CLUSTER, ANCHOR, total, u[i, 0], u[i, 1], u[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = direction


@numba.njit
def run_fine_pdf(maps, work, total, direction, out):
    for i in range(direction.shape[0]):
        out[i] = cm.fine_pdf(maps, work, LANE, CLUSTER, ANCHOR, total, vec.row(direction, i))


@numba.njit
def run_foresee(maps, work):
    _foresee_tile(maps, work)


def photons(count: int, below: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions in a lobe about a slanted one, the first `below` of them under the horizon, and powers."""
    generator = np.random.default_rng(count)
    direction = naive.unit(naive.unit(NORMAL + 0.5 * OUT) + spread * generator.normal(size=(count, 3)))
    sign = np.sign(direction @ NORMAL.astype(float)) * np.where(np.arange(count) < below, -1, 1)
    return (direction * sign[:, None]).astype(np.float32), generator.exponential(size=count).astype(np.float32) ** 2


def gathered(direction: np.ndarray, power: np.ndarray, degrees: float) -> tuple[ForecastMaps, cm.MixtureWork]:
    neighbours = max(1, len(power))
    near = np.full((16, 4, padded(neighbours)), 7.0, np.float32)
    near[ANCHOR] = 0
    near[ANCHOR, :3, : len(power)], near[ANCHOR, 3, : len(power)] = direction.T, power
    count, cone = np.full(16, neighbours, np.int32), np.full(4, 0.5, np.float32)
    count[ANCHOR], cone[CLUSTER] = len(power), np.cos(np.radians(degrees))
    maps = no_forecast()._replace(neighbours=neighbours, anchor_photon=near, anchor_count=count, cone=cone)
    return maps, cm.mixture_work(maps)


def naive_weights(material: int, direction: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Power x cosine x luminance of the BRDF; for Lambert the BRDF is the same for all and left out."""
    wi, n, wo = direction.astype(np.float64), NORMAL.astype(np.float64), OUT.astype(np.float64)
    kind, kd, ks, exponent, _ = MATERIALS[material]
    f = np.ones(len(power))
    if kind == PHONG:
        f = naive.brdf(kd, ks, exponent, n, wo, wi) @ np.array([0.2126, 0.7152, 0.0722])
    return power * np.maximum(wi @ n, 0) * f


@pytest.mark.parametrize("material", [DIFFUSE, SOFT, SHARP])
def test_fine_weights(material: int) -> None:
    direction, power = photons(50, 10, 0.6)
    maps, work = gathered(direction, power, 5)
    total = run_weigh(materials(), maps, work, NORMAL[None], OUT[None], material)
    expected = naive_weights(material, direction, power)
    assert (expected[:10] == 0).all() and (expected[10:] > 0).all()
    cdf = work.cdf[LANE, : len(power)]
    np.testing.assert_allclose(np.diff(cdf, prepend=0), expected, atol=2e-6 * expected.sum())
    assert total == cdf[-1] and (np.diff(cdf) >= 0).all()


@pytest.mark.statistical
@pytest.mark.parametrize("case", FINE_CASES, ids=str)
def test_fine_sampler(case: tuple[int, int, int, float, float]) -> None:
    material, count, below, spread, degrees = case
    direction, power = photons(count, below, spread)
    maps, work = gathered(direction, power, degrees)
    total = run_weigh(materials(), maps, work, NORMAL[None], OUT[None], material)
    sampled = np.empty((SAMPLES, 3), np.float32)
    run_sample_fine(maps, work, total, np.random.default_rng(5).random((SAMPLES, 3), np.float32), sampled)
    used = direction[naive_weights(material, direction, power) > 0].astype(np.float64)
    axis = naive.unit(used.mean(axis=0))
    reach = np.arccos(min(1.0, (used @ axis).min())) + np.radians(1.01 * degrees)
    # The rim of a cone cuts cells: they are integrated finely.
    heights = np.cos(np.linspace(min(reach, 3.1), 0, 25))
    cells = SphereCells(axis, np.unique(np.concatenate([[-1.0], heights[:-1], [1.0]])))
    centres, _ = cells.quadrature(64)
    density = np.empty(len(centres), np.float32)
    run_fine_pdf(maps, work, total, centres.astype(np.float32), density)
    expected = cells.integrate(density, 64)
    assert expected.sum() == pytest.approx(1, abs=1e-3)
    expected /= expected.sum()
    counts = cells.counts(sampled)
    assert counts[expected == 0].sum() <= STRAY * SAMPLES
    counts[expected == 0] = 0
    p = p_value(counts, SAMPLES * expected)
    print(f"\nfine {case}: p = {p:.3f}")
    assert p > sidak(COMPARISONS)


@pytest.mark.statistical
@pytest.mark.parametrize("degrees", NARROW)
def test_narrow_cones(degrees: float) -> None:
    """Uniform within the cone, and the sampler's own directions have a density: one that had none would count as if
    another sampler had made it, with a weight larger by the ratio of the densities."""
    generator = np.random.default_rng(3)
    shares, lost = [], 0.0
    for axis in naive.unit(generator.normal(size=(AXES, 3))).astype(np.float32):
        axis *= np.sign(axis @ NORMAL)
        maps, work = gathered(axis[None], np.ones(1, np.float32), degrees)
        total = run_weigh(materials(), maps, work, NORMAL[None], OUT[None], DIFFUSE)
        sampled, density = np.empty((SAMPLES // AXES, 3), np.float32), np.empty(SAMPLES // AXES, np.float32)
        run_sample_fine(maps, work, total, generator.random((len(sampled), 3), np.float32), sampled)
        run_fine_pdf(maps, work, total, sampled, density)
        chord = naive.unit(sampled) - naive.unit(axis)
        shares.append((chord**2).sum(axis=1) / (2 * (1 - float(maps.cone[CLUSTER]))))
        lost += (density == 0).mean() / AXES
    p = uniform_p_value(np.clip(np.concatenate(shares), 0, 1 - 1e-9), 32)
    print(f"\n{degrees} degrees: {lost:.2e} without density, p of the radius {p:.3g}")
    assert lost <= LOST
    assert p > sidak(COMPARISONS)


def test_anchor_without_usable_photons() -> None:
    """No photon at all, all below the horizon, or no power: no weight, no density; nothing of the other anchors."""
    direction, power = photons(20, 20, 0.3)
    for maps, work in (
        gathered(direction[:0], power[:0], 5),
        gathered(direction, power, 5),
        gathered(-direction, 0 * power, 5),
    ):
        total = run_weigh(materials(), maps, work, NORMAL[None], OUT[None], SOFT)
        density = np.full(20, np.nan, np.float32)
        run_fine_pdf(maps, work, total, direction, density)
        assert total == 0 and (density == 0).all()


def tile(maps: ForecastMaps, p: np.ndarray, n: np.ndarray, used: np.ndarray) -> PassWork:
    work = pass_work(cm.mixture_work(maps), 1)
    for i in range(16):
        for c in range(3):
            work.packet[ws.POINT + 16 * c + i], work.packet[ws.NORMAL + 16 * c + i] = p[i, c], n[i, c]
        work.lane[i, 3] = used[i]
    run_foresee(maps, work)
    return work


@pytest.mark.parametrize("seed", range(20))
def test_lanes_share_a_cluster_only_when_close(seed: int) -> None:
    """A lane joins the first earlier lane within half a radius whose normal is alike, else it asks for itself."""
    points = caustic_points(3000)
    maps, _, _ = build(points)
    generator = np.random.default_rng(seed)
    p = points.position[generator.integers(3000)] + maps.radius * generator.uniform(-0.6, 0.6, (16, 3))
    n = np.where(generator.random((16, 1)) < 0.3, [1.0, 0, 0], naive.unit(np.array([0, 1, 0]) + 0.1))
    used = (generator.random(16) < 0.8).astype(np.float32)
    p, n = p.astype(np.float32), n.astype(np.float32)
    work = tile(maps, p, n, used).forecast
    leaders: list[int] = []
    for i in np.flatnonzero(used):
        close = [j for j in leaders if np.linalg.norm(p[i] - p[j]) <= maps.radius / 2 and n[i] @ n[j] > 0.9]
        leader = close[0] if close else i
        leaders += [] if close else [i]
        feature = np.concatenate([p[leader], n[leader] * maps.normal_scale])
        cluster = int(((maps.codebook.T - feature) ** 2).sum(axis=1).argmin())
        assert work.cluster[i] == cluster
        assert work.anchor[i] == naive_anchor(maps, cluster, p[i])
    assert (work.cluster[used == 0] == -1).all() and 1 < len(leaders) < used.sum()


def test_clusters_of_a_high_rank_are_not_asked() -> None:
    points = caustic_points(3000)
    maps, _, _ = build(points)
    p, n = np.repeat(points.position[:1], 16, axis=0), np.repeat(points.normal[:1], 16, axis=0)
    assert (tile(maps, p, n, np.ones(16)).forecast.anchor >= 0).all()
    assert (tile(maps._replace(max_rank=-1), p, n, np.ones(16)).forecast.anchor == -1).all()
