"""Rivals of the two tables: every sampler follows its density, which covers the whole hemisphere."""

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, p_value, sidak
from test_kernels_bsdf import materials
from test_kernels_tables import FINE, NORMAL, OUT, STRAY, naive_weights, photon_maps, photons, world

from causticmpi.estimators import caustic_forecast as cf
from causticmpi.estimators import directional_tables as dt
from causticmpi.estimators import filled_table as ft
from causticmpi.kernels import vec
from causticmpi.preprocess.forecast import ForecastMaps

DIFFUSE, SOFT, SHARP = 0, 2, 3
FILLED = ("one", "one-cosine", "one-smooth")
CASES = [
    # material, columns, rows, photons, photons below the horizon, width of the photons' lobe
    (DIFFUSE, 32, 16, 50, 10, 0.3),
    (DIFFUSE, 32, 16, 20, 20, 1.0),
    (DIFFUSE, 7, 5, 200, 0, 1.0),
    (SOFT, 32, 16, 50, 5, 0.5),
    (SHARP, 32, 16, 50, 0, 0.1),
    (SHARP, 5, 3, 9, 0, 1.0),
]
COMPARISONS = len(CASES) * (len(FILLED) + 1)
LEAST = 1e-4
"""Density at least everywhere, in units of the uniform one: the smallest share that the fill gives to a bin."""


@numba.njit
def run_draw(scene, maps, work, k, n, wo, material, u, direction, density):
    """Prepare and draw, the parts in turn; the tables are left filled."""
    n, wo = vec.row(n, 0), vec.row(wo, 0)
    occupied, sum1, other = cf.prepare(scene, maps, work, k, n, wo, material)
    for i in range(u.shape[0]):
        d, density[i] = cf.draw(
            scene,
            maps,
            work,
            i % cf.parts(work),
            occupied,
            sum1,
            other,
            n,
            wo,
            material,
            u[i, 0],
            u[i, 1],
            u[i, 2],
        )
        direction[i, 0], direction[i, 1], direction[i, 2] = d
    return occupied, sum1, other


@numba.njit
def run_filled_pdf(maps, work, total, local, out):
    for i in range(local.shape[0]):
        out[i] = ft.filled_pdf(maps, work, total, vec.row(local, i))


@numba.njit
def run_table1_pdf(maps, work, total, local, out):
    for i in range(local.shape[0]):
        out[i] = dt.table1_pdf(maps, work, total, vec.row(local, i))


def cells(maps: ForecastMaps, split: int) -> np.ndarray:
    """Directions through the middles of split x split cells of every bin, row by row, in the frame of the normal."""
    rows, columns = maps.rows * split, maps.columns * split
    z, phi = (np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(columns) + 0.5) / columns
    z, phi = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def counted(maps: ForecastMaps, local: np.ndarray) -> np.ndarray:
    """Samples by cell of `cells(maps, FINE)`; those below the horizon in one more cell at the end."""
    x, y, z = local.astype(np.float64).T
    columns, rows = maps.columns * FINE, maps.rows * FINE
    column = np.minimum((np.arctan2(y, x) / (2 * np.pi) % 1 * columns).astype(int), columns - 1)
    row = np.minimum((z * rows).astype(int), rows - 1)
    return np.bincount(np.where(z > 0, row * columns + column, rows * columns), minlength=rows * columns + 1)


def drawn(sampling: str, case: tuple[int, int, int, int, int, float]) -> tuple:
    """(maps, work, sums, local directions, densities) of SAMPLES draws."""
    material, columns, rows, count, below, width = case
    maps = photon_maps(columns, rows, *photons(count, below, width))
    work = cf.forecast_work(maps, sampling)
    work.row[:count] = np.arange(count)
    u = np.random.default_rng(11).random((SAMPLES, 3), np.float32)
    direction, density = np.zeros((SAMPLES, 3), np.float32), np.zeros(SAMPLES, np.float32)
    sums = run_draw(materials(), maps, work, count, NORMAL[None], OUT[None], material, u, direction, density)
    t, b = (np.array(v, np.float64) for v in vec.frame(tuple(NORMAL)))
    local = direction.astype(np.float64) @ np.stack([t, b, NORMAL.astype(float)]).T
    return maps, work, sums, local, density


def spread(maps: ForecastMaps, one: np.ndarray) -> np.ndarray:
    """Every bin's weight given to all bins by a Gaussian of the angle between their middles."""
    middle = cells(maps, 1)
    angle = np.arccos(np.clip(middle @ middle.T, -1, 1))
    share = np.exp(-(angle**2) / (2 * ft.SPREAD**2 * 2 * np.pi / (maps.columns * maps.rows)))
    return one @ (share / share.sum(axis=1, keepdims=True))


def expected_weights(sampling: str, material: int, maps: ForecastMaps) -> np.ndarray:
    """Probability of each bin, from the definition."""
    one, two = naive_weights(material, maps)
    if one.sum() == 0:
        return two / two.sum() if sampling == "one-cosine" else np.full(len(one), 1 / len(one))
    extra = one.sum() * float(ft.FILL) / (1 - float(ft.FILL))
    if sampling == "one-smooth":
        weights = spread(maps, one) + extra / len(one)
    elif sampling == "one":
        weights = np.maximum(one, extra / len(one))
    else:
        whole = naive_weights(material, photon_maps(maps.columns, maps.rows, np.zeros((0, 3)), np.zeros(0)))[1]
        weights = np.maximum(one, whole * extra / whole.sum())
    return weights / weights.sum()


@pytest.mark.statistical
@pytest.mark.parametrize("sampling", FILLED)
@pytest.mark.parametrize("case", CASES, ids=lambda c: "-".join(map(str, c)))
def test_filled_tables(case: tuple[int, int, int, int, int, float], sampling: str) -> None:
    maps, work, sums, local, density = drawn(sampling, case)
    middle = cells(maps, FINE).astype(np.float32)
    pdf = np.empty(len(middle), np.float32)
    run_filled_pdf(maps, work, sums[2], middle, pdf)
    assert pdf.min() > LEAST / (2 * np.pi)  # no direction is out of reach
    expected = pdf.astype(np.float64) * 2 * np.pi / len(middle)
    assert expected.sum() == pytest.approx(1, abs=2e-5)
    counts = counted(maps, local)
    assert counts[-1] <= STRAY * SAMPLES
    p = p_value(counts[:-1], SAMPLES * expected)
    print(f"\n{sampling}: p = {p:.3f}")
    assert p > sidak(COMPARISONS)
    again = np.empty(2000, np.float32)
    run_filled_pdf(maps, work, sums[2], local[:2000].astype(np.float32), again)
    assert np.isclose(density[:2000], again, rtol=1e-4).mean() > 0.998  # on the border of a bin rounding decides
    by_bin = pdf.reshape(maps.rows, FINE, maps.columns, FINE).mean(axis=(1, 3)).ravel() * 2 * np.pi / len(work.fill)
    np.testing.assert_allclose(by_bin, expected_weights(sampling, case[0], maps), rtol=3e-3, atol=1e-7)


@pytest.mark.statistical
@pytest.mark.parametrize("case", CASES, ids=lambda c: "-".join(map(str, c)))
def test_mis(case: tuple[int, int, int, int, int, float]) -> None:
    """Both samplers in turn follow the half of the density that their samples are divided by."""
    material = case[0]
    maps, work, (_, sum1, _), local, density = drawn("mis", case)
    scene, split = materials(), 8
    middle = cells(maps, FINE * split)
    kd, ks = (float(a[material].max()) for a in (scene.reflectance, scene.specular))
    exponent = float(scene.exponent[material]) if scene.kind[material] else 0.0
    share = ks / (kd + ks) if scene.kind[material] else 0.0
    n, wo = NORMAL.astype(float), OUT.astype(float)
    brdf = naive.brdf_pdf(share, exponent, n, wo, world(middle))
    table = np.zeros(len(middle), np.float32)
    if sum1 > 0:
        run_table1_pdf(maps, work, sum1, middle.astype(np.float32), table)
    both = (brdf + table) * 2 * np.pi / len(middle)
    rows, columns = maps.rows * FINE, maps.columns * FINE
    expected = both.reshape(rows, split, columns, split).sum(axis=(1, 3)).ravel()
    below = 1 - (brdf * 2 * np.pi / len(middle)).sum()  # where the lobe counts nothing
    if sum1 > 0:
        counts = counted(maps, local)
        p = (
            p_value(counts, SAMPLES * np.append(expected, max(below, 0)) / 2)
            if below > 1e-4
            else p_value(counts[:-1], SAMPLES * expected / 2)
        )
    else:
        assert (density[::2] == 0).all() and (density[1::2] > 0).all()
        counts = counted(maps, local[1::2])
        p = p_value(counts[:-1], (SAMPLES // 2) * expected)
    print(f"\nmis: p = {p:.3f}, {below:.2g} below the horizon")
    assert p > sidak(COMPARISONS)
    # The density handed out with a sample is that of both samplers.
    some = (local[:, 2] > 0.01) & (density > 0)
    picked = np.flatnonzero(some)[:2000]
    table = np.zeros(len(picked), np.float32)
    if sum1 > 0:
        run_table1_pdf(maps, work, sum1, local[picked].astype(np.float32), table)
    want = table + naive.brdf_pdf(share, exponent, n, wo, world(local[picked]))
    assert np.isclose(density[picked], want, rtol=2e-3).mean() > 0.998


@pytest.mark.parametrize(("columns", "rows"), [(32, 16), (1, 1), (2, 3), (7, 5)])
def test_smoothing_conserves_and_reaches_round(columns: int, rows: int) -> None:
    share = ft.smoothing(columns, rows).astype(np.float64)
    np.testing.assert_allclose(share[:, :, :columns].sum(axis=(1, 2)), 1, rtol=1e-5)
    np.testing.assert_allclose(share[:, :, :columns], share[:, :, columns:], rtol=1e-4, atol=1e-12)  # d and d - columns
    own = np.array([share[a, a, columns] for a in range(rows)])
    assert (own >= share.max(axis=(1, 2)) * (1 - 1e-6)).all()


def test_a_full_table_needs_no_fill() -> None:
    """Every bin occupied: nothing is left for table 2, and the table stays as it is."""
    maps = photon_maps(7, 5, world(cells(no_photons(7, 5), 1)), np.ones(35))
    for sampling in FILLED:
        work = cf.forecast_work(maps, sampling)
        work.row[:35] = np.arange(35)
        u = np.random.default_rng(1).random((20_000, 3), np.float32)
        direction, density = np.zeros((len(u), 3), np.float32), np.zeros(len(u), np.float32)
        occupied, _, total = run_draw(
            materials(), maps, work, 35, NORMAL[None], OUT[None], DIFFUSE, u, direction, density
        )
        assert occupied == 35 and total > 0 and density.min() > 0


def no_photons(columns: int, rows: int) -> ForecastMaps:
    return photon_maps(columns, rows, np.zeros((0, 3)), np.zeros(0))
