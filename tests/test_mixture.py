"""Cones around the photons of an anchor: the sampler follows its density; lanes of a tile share a cluster only when
close."""

from typing import Any, NamedTuple

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, p_value, sidak, uniform_p_value
from test_anchors import naive_anchor
from test_forecast import build, caustic_points
from test_kernels_bsdf import MATERIALS, materials
from test_parallax import naive_turned

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import mixture_rays as rays
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.full_radiance import PassWork, pass_work
from causticmpi.estimators.iws_mixture import _foresee_tile
from causticmpi.estimators.mixture_rays import mixture_work
from causticmpi.kernels import vec
from causticmpi.kernels.material_kinds import PHONG
from causticmpi.preprocess.anchors import columns_for
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast
from causticmpi.preprocess.packed_photons import packed_photons, unpacked_photons
from causticmpi.preprocess.parallax import CURVATURE, HEIGHT, NARROWEST, POWER, ROWS

NORMAL = naive.unit([-0.4, 0.2, 0.6]).astype(np.float32)
OUT = naive.unit([0.1, 0.9, 0.8]).astype(np.float32)
DIFFUSE, SOFT, SHARP = 0, 2, 3
ANCHOR, LANE = 5, 3
"""The fine sampler is tested at one of 16 anchors; the others hold rubbish. LANE: of the vertex."""
STEP = np.float32([0.1, -0.05, 0.07])
"""The way from the anchor to the vertex, for which its photons are turned."""
FINE_CASES = [
    # material, photons, of them below the horizon, their spread, largest half angle of their cones in degrees, columns
    # of photons that are asked
    (DIFFUSE, 1, 0, 0.0, 30.0, 64),
    (DIFFUSE, 50, 10, 0.5, 10.0, 64),
    (DIFFUSE, 50, 0, 0.1, 3.0, 64),
    (SOFT, 50, 5, 0.5, 10.0, 64),
    (SOFT, 50, 5, 0.5, 10.0, 32),
    (DIFFUSE, 20, 0, 0.5, 10.0, 32),
    (SHARP, 20, 0, 0.3, 20.0, 64),
]
NARROW = [0.01, float(np.degrees(NARROWEST)), 0.25, 0.5, 1.0, 3.0, 30.0]
COMPARISONS = len(FINE_CASES) + len(NARROW)
AXES = 32


class Place(NamedTuple):
    """What the fine sampler asks of a vertex."""

    p: Any
    n: Any
    wo: Any
    material: Any


@numba.njit
def run_weigh(scene, maps, work, p, n, wo, material, columns):
    at = Place(vec.row(p, 0), vec.row(n, 0), vec.row(wo, 0), material)
    return cm.weigh_anchor(scene, maps, work, LANE, at, columns)


@numba.njit
def run_sample_fine(work, u, out):
    for i in range(u.shape[0]):
        axis, height = cm.choose_cone(work, LANE, u[i, 0])
        out[i, 0], out[i, 1], out[i, 2] = cm.in_cone(axis, height, u[i, 1], u[i, 2])


@numba.njit
def run_fine_pdf(work, direction, out):
    for i in range(direction.shape[0]):
        out[i] = cm.cones_pdf(work, LANE, vec.row(direction, i))


@numba.njit
def run_by_cones(work, j, others):
    rays.by_cones(work, j, others)


@numba.njit
def run_foresee(maps, work):
    _foresee_tile(maps, work)


def photons(count: int, below: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions in a lobe about a slanted one, the first `below` of them under the horizon, and powers."""
    generator = np.random.default_rng(count)
    direction = naive.unit(naive.unit(NORMAL + 0.5 * OUT) + spread * generator.normal(size=(count, 3)))
    sign = np.sign(direction @ NORMAL.astype(float)) * np.where(np.arange(count) < below, -1, 1)
    return (direction * sign[:, None]).astype(np.float32), short(generator.exponential(size=count) ** 2)


def short(x: np.ndarray) -> np.ndarray:
    """Numbers that are packed as they are."""
    return (np.float32(x).view(np.int32) & -0x10000).view(np.float32)


def height(degrees: Any) -> np.ndarray:
    """Of a cone, by its half angle."""
    return short(2 * np.sin(np.radians(degrees) / 2) ** 2)


def gathered(direction: np.ndarray, power: np.ndarray, degrees: Any) -> tuple[ForecastMaps, cm.MixtureWork]:
    """Maps with an anchor of photons that are seen in these directions, within 0.3 or so, from where it is, with cones
    of these half angles, and rubbish in what a vertex before it may have left behind."""
    count, neighbours = len(power), max(1, len(power))
    near = np.full((16, ROWS, columns_for(neighbours)), 7.0, np.float32)
    near[ANCHOR] = 0
    near[ANCHOR, :3, :count], near[ANCHOR, POWER, :count] = direction.T, power
    near[ANCHOR, HEIGHT, :count] = height(degrees)
    near[ANCHOR, CURVATURE:, :count] = np.random.default_rng(8).normal(size=(6, count))
    counts, anchor = np.full(16, neighbours, np.int32), np.full((16, 3), 7.0, np.float32)
    counts[ANCHOR], anchor[ANCHOR] = count, 0.5
    maps = no_forecast(neighbours=neighbours)._replace(
        anchor=anchor, anchor_photon=packed_photons(near), anchor_count=counts
    )
    work = mixture_work(maps)
    for array in (work.cone, work.cdf):
        array[:] = 0.5
    work.anchor[:] = 3
    work.anchor[LANE] = ANCHOR
    return maps, work


def weigh(maps: ForecastMaps, work: cm.MixtureWork, material: int, columns: int = 64) -> float:
    """Sum of the weights at the vertex a STEP from the anchor."""
    place, columns = (maps.anchor[ANCHOR] + STEP)[None], min(columns, maps.anchor_photon.shape[1] // ROWS)
    counts = run_weigh(materials(), maps, work, place, NORMAL[None], OUT[None], material, columns)
    assert counts == (work.total[LANE] > 0) and work.count[LANE] == min(maps.anchor_count[ANCHOR], columns)
    return work.total[LANE]


def seen(maps: ForecastMaps, count: int) -> np.ndarray:
    """Directions of the anchor's photons at the vertex."""
    photon = unpacked_photons(maps.anchor_photon)[ANCHOR, :, :count].T
    return naive_turned(photon[:, :3].astype(np.float64), photon[:, CURVATURE:], np.tile(STEP, (count, 1)))


def cone_axes(work: cm.MixtureWork, count: int) -> np.ndarray:
    """Axes (count, 3) of the cones at the vertex."""
    rows = work.cone[LANE].reshape(-1, cm.CONES // 16, 16)[:, :3]
    return rows.transpose(0, 2, 1).reshape(-1, 3)[:count]


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
    total = weigh(maps, work, material)
    axes = seen(maps, len(power))
    assert np.median(np.linalg.norm(axes - direction, axis=1)) > 0.1
    np.testing.assert_allclose(cone_axes(work, len(power)), axes, atol=1e-6)
    expected = naive_weights(material, axes, power)
    assert 5 < (expected == 0).sum() < 30
    cdf = work.cdf[LANE, : len(power)]
    np.testing.assert_allclose(np.diff(cdf, prepend=0), expected, atol=2e-6 * expected.sum())
    assert total == cdf[-1] and (np.diff(cdf) >= 0).all()


@pytest.mark.statistical
@pytest.mark.parametrize("case", FINE_CASES, ids=str)
def test_fine_sampler(case: tuple[int, int, int, float, float, int]) -> None:
    material, count, below, spread, degrees, columns = case
    direction, power = photons(count, below, spread)
    maps, work = gathered(direction, power, np.linspace(degrees, degrees / 2, count))
    weigh(maps, work, material, columns)
    sampled = np.empty((SAMPLES, 3), np.float32)
    run_sample_fine(work, np.random.default_rng(5).random((SAMPLES, 3), np.float32), sampled)
    axes = seen(maps, count)[:columns]
    used = axes[naive_weights(material, axes, power[:columns]) > 0]
    axis = naive.unit(used.mean(axis=0))
    reach = np.arccos(min(1.0, (used @ axis).min())) + np.radians(1.01 * degrees)
    heights = np.cos(np.concatenate([np.linspace(np.pi, reach, 8)[:-1], np.linspace(reach, 0, 25)]))
    cells = SphereCells(axis, np.unique(np.clip(heights, -1, 1)))
    centres, _ = cells.quadrature(64)
    density = np.empty(len(centres), np.float32)
    run_fine_pdf(work, centres.astype(np.float32), density)
    expected = cells.integrate(density, 64)
    assert expected.sum() == pytest.approx(1, abs=1e-3)
    expected /= expected.sum()
    p = p_value(cells.counts(sampled), SAMPLES * expected)
    print(f"\nfine {case}: p = {p:.3f}")
    assert p > sidak(COMPARISONS)


@pytest.mark.statistical
@pytest.mark.parametrize("degrees", NARROW)
def test_narrow_cones(degrees: float) -> None:
    """Around a single cone the way from its axis has the distribution told, and the density is what follows from it
    even where a cosine is all rounding."""
    generator = np.random.default_rng(3)
    shares, h = [], float(height(degrees))
    for axis in naive.unit(generator.normal(size=(AXES, 3))).astype(np.float32):
        maps, work = gathered(axis[None], np.ones(1, np.float32), degrees)
        sign = np.sign(seen(maps, 1)[0] @ NORMAL)
        maps, work = gathered(sign * axis[None], np.ones(1, np.float32), degrees)
        assert weigh(maps, work, DIFFUSE) > 0
        sampled, density = np.empty((SAMPLES // AXES, 3), np.float32), np.empty(SAMPLES // AXES, np.float32)
        run_sample_fine(work, generator.random((len(sampled), 3), np.float32), sampled)
        run_fine_pdf(work, sampled, density)
        t = ((naive.unit(sampled) - naive.unit(cone_axes(work, 1)[0])) ** 2).sum(axis=1) / 2
        np.testing.assert_allclose(density, h * (2 + h) / (4 * np.pi * (h + t) ** 2), rtol=2e-3)
        shares.append((2 + h) / 2 * t / (h + t))
    p = uniform_p_value(np.clip(np.concatenate(shares), 0, 1 - 1e-9), 32)
    print(f"\n{degrees} degrees: p of the radius {p:.3g}")
    assert p > sidak(COMPARISONS)


class Work(NamedTuple):
    """What `by_cones` asks of a workspace."""

    forecast: cm.MixtureWork


@pytest.mark.parametrize("others", [1, 2])
def test_rays_take_cones_in_strata(others: int) -> None:
    """Ray j of a vertex, behind the first `others`, has its own part of the photons by weight; what is beyond its last
    has no cone."""
    direction, power = photons(50, 10, 0.5)
    maps, work = gathered(direction, power, np.linspace(10, 5, 50))
    weigh(maps, work, DIFFUSE)
    cdf = work.cdf[LANE, :50].astype(np.float64)
    axes, heights, count, chosen = cone_axes(work, 50), height(np.linspace(10, 5, 50)), 7, set()
    work.lane[:] = 0
    work.lane.view(np.int32)[rays.COUNT + LANE] = count
    for j in range(others, count):
        for choice in (0, 0.3, 0.7, 0.9999999):
            work.lane[rays.CHOICE + LANE] = choice
            run_by_cones(Work(work), j, others)
            i = int(np.searchsorted(cdf, (j - others + choice) / (count - others) * cdf[-1], side="right"))
            axis = work.lane[rays.AXIS + LANE : rays.AXIS + 48 : 16]
            assert np.array_equal(axis, axes[i]) and work.lane[rays.HEIGHT + LANE] == heights[i]
            np.testing.assert_allclose(work.lane[rays.DIRECTION + LANE : rays.DIRECTION + 48 : 16], axis, atol=1e-6)
            chosen.add(i)
    assert len(chosen) > 12
    run_by_cones(Work(work), count, others)
    assert work.lane[rays.AXIS + LANE : rays.AXIS + 48 : 16].tolist() == [0, 0, 1]


def test_anchor_without_usable_photons() -> None:
    """No photon at all, all below the horizon, or no power: no weight, no density; nothing of the other anchors."""
    direction, power = photons(20, 20, 0.3)
    for maps, work in (
        gathered(direction[:0], power[:0], 5),
        gathered(direction, power, 5),
        gathered(-direction, 0 * power, 5),
    ):
        photon = unpacked_photons(maps.anchor_photon)
        photon[ANCHOR, CURVATURE:] = 0
        maps = maps._replace(anchor_photon=packed_photons(photon))
        total = weigh(maps, work, SOFT)
        density = np.full(20, np.nan, np.float32)
        run_fine_pdf(work, direction, density)
        assert total == 0 and (density == 0).all()


def tile(maps: ForecastMaps, p: np.ndarray, n: np.ndarray, used: np.ndarray) -> PassWork:
    work = pass_work(mixture_work(maps), 1)
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
        ranked = maps.rank[cluster] <= maps.max_rank
        assert work.anchor[i] == (naive_anchor(maps, p[i], n[i]) if ranked else -1)
    assert (work.cluster[used == 0] == -1).all() and 1 < len(leaders) < used.sum()


def test_clusters_of_a_high_rank_are_not_asked() -> None:
    points = caustic_points(3000)
    maps, _, _ = build(points)
    p, n = np.repeat(points.position[:1], 16, axis=0), np.repeat(points.normal[:1], 16, axis=0)
    assert (tile(maps, p, n, np.ones(16)).forecast.anchor >= 0).all()
    assert (tile(maps._replace(max_rank=-1), p, n, np.ones(16)).forecast.anchor == -1).all()
