"""Directions of whole clusters: tables add up, and the sampler follows them."""

from typing import NamedTuple

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, p_value, sidak

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import mixture_rays as rays
from causticmpi.kernels import vec
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.path_layout import get3
from causticmpi.preprocess.directions import COLUMNS, ROWS, coarse_tables
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast

BINS = COLUMNS * ROWS
COARSE_CASES = [1, 7, 200, 20_000]
"""Points of the lit cluster."""
COMPARISONS = len(COARSE_CASES) + 1
STRAY = 1e-5
"""Share of samples that the rounding of float32 may push over the border of their bin."""


class Work(NamedTuple):
    """What the sampler asks of a workspace."""

    forecast: cm.MixtureWork


@numba.njit
def run_by_cluster(maps, work, u, out):
    lane = work.forecast.lane
    for first in range(0, u.shape[0], LANES):
        for i in range(LANES):
            lane.view(np.int32)[rays.COUNT + i] = 1
            lane[rays.CHOICE + i], lane[rays.U + i], lane[rays.V + i] = u[first + i]
        rays.by_cluster(maps, work)
        for i in range(LANES):
            out[first + i, 0], out[first + i, 1], out[first + i, 2] = get3(lane, rays.DIRECTION, i)


@numba.njit
def run_coarse_density(maps, cluster, direction, out):
    for i in range(direction.shape[0]):
        out[i] = cm.coarse_density(maps, cluster, np.int64(cm.coarse_bin(vec.row(direction, i))))


def sample(maps: ForecastMaps, cluster: int, u: np.ndarray) -> np.ndarray:
    """Directions (n, 3) of a cluster by random numbers (n, 3); n: a multiple of 16."""
    forecast, out = rays.mixture_work(maps), np.empty(u.shape, np.float32)
    forecast.cluster[:] = cluster
    run_by_cluster(maps, Work(forecast), u, out)
    return out


def one_cluster(count: int) -> tuple[ForecastMaps, np.ndarray]:
    """Maps whose cluster 1 has the directions of `count` points, and their probability by bin; cluster 0 is dark."""
    generator = np.random.default_rng(count)
    direction = naive.unit(generator.normal(size=(count, 3)) + [1, 0.5, -0.3])
    power = generator.exponential(size=count) ** 3
    table = coarse_tables(direction.astype(np.float32), power, np.ones(count, np.int32), 2)
    column = (np.arctan2(direction[:, 1], direction[:, 0]) % (2 * np.pi) / (2 * np.pi) * COLUMNS).astype(int)
    row = np.minimum((direction[:, 2] + 1) / 2 * ROWS, ROWS - 1).astype(int)
    expected = np.bincount(row * COLUMNS + column, weights=power, minlength=BINS) / power.sum()
    return no_forecast()._replace(coarse=table), expected


@pytest.mark.parametrize("count", COARSE_CASES)
def test_coarse_tables(count: int) -> None:
    maps, expected = one_cluster(count)
    np.testing.assert_allclose(np.diff(maps.coarse[1].astype(np.float64), prepend=0), expected, atol=2e-7)
    np.testing.assert_allclose(maps.coarse[0], (np.arange(BINS) + 1) / BINS, rtol=1e-6)
    assert maps.coarse.dtype == np.float32 and (maps.coarse[:, -1] == 1).all() and (maps.coarse >= 0).all()
    last = np.flatnonzero(expected).max()
    assert (maps.coarse[1, last:] == 1).all() and (np.diff(maps.coarse, axis=1) >= 0).all()


def test_rounding_leaves_no_gap_behind_the_last_bin() -> None:
    """The largest uniform number never leads to a bin without a point, whatever the rounding of the sum."""
    generator = np.random.default_rng(1)
    clusters = 300
    direction = naive.unit(generator.normal(size=(100 * clusters, 3)) - [0, 0, 2]).astype(np.float32)
    power = generator.exponential(size=len(direction)) ** 8
    table = coarse_tables(direction, power, np.arange(len(direction)) % clusters, clusters)
    maps = no_forecast()._replace(coarse=table)
    u = np.array(LANES * [[np.nextafter(np.float32(1), np.float32(0)), 0.5, 0.5]], np.float32)
    density = np.empty(LANES, np.float32)
    for cluster in range(clusters):
        run_coarse_density(maps, cluster, sample(maps, cluster, u), density)
        assert (density > 0).all()


@pytest.mark.statistical
@pytest.mark.parametrize(("count", "cluster"), [(1, 0), *((count, 1) for count in COARSE_CASES)])
def test_coarse_sampler(count: int, cluster: int) -> None:
    maps, _ = one_cluster(count)
    sampled = sample(maps, cluster, np.random.default_rng(7).random((SAMPLES, 3), np.float32))
    cells = SphereCells(np.array([0, 0, 1]), np.linspace(-1, 1, 2 * ROWS + 1), 2 * COLUMNS)
    centres, _ = cells.quadrature(1)
    density = np.empty(len(centres), np.float32)
    run_coarse_density(maps, cluster, centres.astype(np.float32), density)
    expected = cells.integrate(density, 1)
    assert expected.sum() == pytest.approx(1, abs=1e-5)
    counts = cells.counts(sampled)
    assert counts[expected == 0].sum() <= STRAY * SAMPLES
    counts[expected == 0] = 0
    p = p_value(counts, SAMPLES * expected)
    print(f"\ncoarse {count} points, cluster {cluster}: p = {p:.3f}")
    assert p > sidak(COMPARISONS)
