"""Forecast tables: both samplers follow their densities, the domains are disjoint and together cover the hemisphere."""

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, p_value, sidak
from test_kernels_bsdf import materials

from causticmpi.estimators import caustic_forecast as cf
from causticmpi.estimators import directional_tables as dt
from causticmpi.kernels import vec
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast

NORMAL = naive.unit([-0.4, 0.2, 0.6]).astype(np.float32)
OUT = naive.unit([0.1, 0.9, 0.8]).astype(np.float32)
DIFFUSE, SOFT, SHARP, WHITE = 0, 2, 3, 6
FINE = 3
"""Cells of the chi-square test along each side of a bin."""
CASES = [
    # material, columns, rows, photons, photons below the horizon, width of the photons' lobe
    (DIFFUSE, 32, 16, 50, 10, 0.3),
    (DIFFUSE, 32, 16, 0, 0, 1.0),
    (DIFFUSE, 32, 16, 20, 20, 1.0),
    (DIFFUSE, 2, 2, 3, 0, 0.2),
    (DIFFUSE, 7, 5, 200, 0, 1.0),
    (SOFT, 32, 16, 50, 5, 0.5),
    (SHARP, 32, 16, 50, 0, 0.1),
    (SHARP, 32, 16, 0, 0, 1.0),
    (SHARP, 5, 3, 9, 0, 1.0),
    (WHITE, 16, 8, 40, 0, 1.0),
]
COMPARISONS = 2 * len(CASES)
STRAY = 1e-5
"""Share of samples that the rounding of float32 may push over the border of their bin."""


@numba.njit
def run_tables(scene, maps, work, k, n, wo, material, u, local1, prob1, local2, prob2):
    """Fill both tables and sample them; they are left filled. Returns occupied bins and the sums of both."""
    n, wo = vec.row(n, 0), vec.row(wo, 0)
    occupied, sum1 = dt.fill_table1(scene, maps, work, k, n, wo, material)
    sum2 = dt.fill_table2(scene, maps, work, occupied, n, wo, material)
    for i in range(u.shape[0]):
        if sum1 > 0:
            d, prob1[i] = dt.sample_table1(maps, work, occupied, sum1, u[i, 0], u[i, 1], u[i, 2])
            local1[i, 0], local1[i, 1], local1[i, 2] = d
        if sum2 > 0:
            d, prob2[i] = dt.sample_table2(scene, maps, work, material, sum2, u[i, 0], u[i, 1], u[i, 2])
            local2[i, 0], local2[i, 1], local2[i, 2] = d
    return occupied, sum1, sum2


@numba.njit
def run_densities(scene, maps, work, material, sum1, sum2, local, out):
    for i in range(local.shape[0]):
        out[i, 0] = dt.table1_pdf(maps, work, sum1, vec.row(local, i))
        out[i, 1] = dt.table2_pdf(scene, maps, work, material, sum2, vec.row(local, i))
        out[i, 2] = dt.bin_of(maps, vec.row(local, i))


@numba.njit
def run_clear(work, occupied):
    dt.clear_tables(work, occupied)


@numba.njit
def run_round_trip(maps, u, out):
    for i in range(u.shape[0]):
        out[i] = dt.bin_of(maps, dt.direction_in_bin(maps, i % (maps.columns * maps.rows), u[i, 0], u[i, 1]))


@numba.njit
def run_splitting(maps, rank, depth):
    return cf.splitting(maps, rank, depth)


def photon_maps(columns: int, rows: int, direction: np.ndarray, power: np.ndarray) -> ForecastMaps:
    return no_forecast((columns, rows))._replace(
        direction=np.ascontiguousarray(direction, np.float32).reshape(-1, 3),
        power=np.ascontiguousarray(power, np.float32),
        neighbours=max(1, len(power)),
    )


def photons(count: int, below: int, width: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Directions in a lobe about a slanted direction, the first `below` of them under the horizon, and powers."""
    generator = np.random.default_rng(seed)
    direction = naive.unit(naive.unit(NORMAL + 0.5 * OUT) + width * generator.normal(size=(count, 3)))
    sign = np.sign(direction @ NORMAL.astype(float)) * np.where(np.arange(count) < below, -1, 1)
    return direction * sign[:, None], generator.exponential(size=count) ** 3


def every_bin(columns: int, rows: int) -> np.ndarray:
    """World directions through the centres of all bins."""
    index = np.arange(columns * rows)
    z, phi = (index // columns + 0.5) / rows, 2 * np.pi * (index % columns + 0.5) / columns
    return world(np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1))


def world(local: np.ndarray) -> np.ndarray:
    t, b = (np.array(v, np.float64) for v in vec.frame(tuple(NORMAL)))
    return local @ np.stack([t, b, NORMAL.astype(float)])


class Filled:
    """Both tables, samples of them and the densities at the cells of the chi-square test."""

    def __init__(self, material: int, maps: ForecastMaps, count: int, samples: int) -> None:
        self.maps, self.work, self.material, self.samples = maps, cf.forecast_work(maps), material, samples
        self.work.row[:count] = np.arange(count)
        u = np.random.default_rng(5).random((samples, 3), np.float32)
        self.local = [np.zeros((samples, 3), np.float32) for _ in range(2)]
        self.probability = [np.zeros(samples, np.float32) for _ in range(2)]
        arguments = (self.local[0], self.probability[0], self.local[1], self.probability[1])
        scene = materials()
        self.occupied, *self.sums = run_tables(
            scene, maps, self.work, count, NORMAL[None], OUT[None], material, u, *arguments
        )
        z = (np.arange(maps.rows * FINE) + 0.5) / (maps.rows * FINE)
        phi = 2 * np.pi * (np.arange(maps.columns * FINE) + 0.5) / (maps.columns * FINE)
        z, phi = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
        r = np.sqrt(1 - z * z)
        self.centres = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
        self.angle = 2 * np.pi / len(z)
        self.density = np.empty((len(z), 3), np.float64)
        run_densities(scene, maps, self.work, material, *self.sums, self.centres, self.density)

    def counts(self, table: int) -> np.ndarray:
        x, y, z = self.local[table].astype(np.float64).T
        columns, rows = self.maps.columns * FINE, self.maps.rows * FINE
        column = np.minimum((np.arctan2(y, x) / (2 * np.pi) % 1 * columns).astype(int), columns - 1)
        row = np.minimum((z * rows).astype(int), rows - 1)
        return np.bincount(row * columns + column, minlength=rows * columns)


def naive_weights(material: int, maps: ForecastMaps) -> tuple[np.ndarray, np.ndarray]:
    """Table 1 and table 2 by bin, from the definition."""
    scene, n, wo = materials(), NORMAL.astype(float), OUT.astype(float)
    exponent = float(scene.exponent[material]) if scene.kind[material] else None
    kd, ks = scene.reflectance[material], scene.specular[material]
    luminance = np.array([0.2126, 0.7152, 0.0722])
    one, two = np.zeros(maps.columns * maps.rows), np.zeros(maps.columns * maps.rows)
    t, b = (np.array(v, np.float64) for v in vec.frame(tuple(NORMAL)))
    for wi, power in zip(maps.direction.astype(np.float64), maps.power, strict=True):
        if wi @ n > 0:
            index = naive.bin_of(maps.columns, maps.rows, np.array([wi @ t, wi @ b, wi @ n]))
            weight = power * (wi @ n) * (naive.brdf(kd, ks, exponent, n, wo, wi[None])[0] @ luminance)
            one[index] += np.float32(weight)  # the far tail of a lobe underflows to "not occupied"
    one[one > 0] = np.maximum(one[one > 0], dt.LEAST * one.sum())
    for index, wi in enumerate(every_bin(maps.columns, maps.rows)):
        floor = dt.FLOOR * ((kd + ks) @ luminance) / np.pi
        f = naive.brdf(kd, ks, exponent, n, wo, wi[None])[0] @ luminance
        two[index] = 0 if one[index] > 0 else (wi @ n) * (f + floor)
    return one, two


@pytest.mark.statistical
@pytest.mark.parametrize("case", CASES, ids=lambda c: "-".join(map(str, c)))
def test_tables(case: tuple[int, int, int, int, int, float]) -> None:
    material, columns, rows, count, below, width = case
    maps = photon_maps(columns, rows, *photons(count, below, width))
    filled = Filled(material, maps, count, SAMPLES)
    one, two = (filled.density[:, i] for i in range(2))
    assert ((one > 0) ^ (two > 0)).all()  # disjoint, and no direction out of reach
    assert (filled.sums[0] > 0) == (count > below) == bool((one > 0).any())
    for table in range(2):
        if filled.sums[table] <= 0:
            continue
        density = filled.density[:, table]
        assert (density * filled.angle).sum() == pytest.approx(1, abs=2e-5)
        counts = filled.counts(table)
        assert counts[density == 0].sum() <= STRAY * filled.samples
        counts[density == 0] = 0
        assert p_value(counts, filled.samples * density * filled.angle) > sidak(COMPARISONS)
        # The probability returned with a sample is that of its bin.
        bins = counts.nonzero()[0]
        known = np.unique(density[bins] * filled.angle * FINE * FINE)
        got = np.unique(filled.probability[table])
        assert np.abs(got[:, None] - known).min(axis=1).max() < 1e-5 * known.max()
    weights = naive_weights(material, maps)
    for table in range(2):
        if weights[table].sum() > 0:
            expected = weights[table] / weights[table].sum() * columns * rows / (2 * np.pi)
            index = filled.density[:, 2].astype(int)
            np.testing.assert_allclose(filled.density[:, table], expected[index], rtol=2e-3, atol=1e-6)


@pytest.mark.statistical
@pytest.mark.parametrize("power", [1e-3, 1e-9, 1e-30])
def test_a_faint_bin_is_drawn_as_often_as_it_says(power: float) -> None:
    """One photon outshines the others, but table 2 leaves out their bins as well."""
    count, samples = 9, 400_000
    direction = every_bin(4, 4)[4 : 4 + count]
    filled = Filled(DIFFUSE, photon_maps(4, 4, direction, np.array([1.0, *[power] * (count - 1)])), count, samples)
    assert filled.occupied == count
    expected = samples * filled.density[:, 0] * filled.angle
    assert p_value(filled.counts(0), expected) > sidak(3)
    assert expected[expected > 0].min() > 5  # enough for the test to see each bin


@pytest.mark.parametrize("material", [DIFFUSE, SHARP])
@pytest.mark.parametrize(("columns", "rows"), [(2, 2), (32, 16), (7, 5), (32, 10), (13, 11), (64, 31), (1, 1)])
def test_full_rows_and_full_tables(material: int, columns: int, rows: int) -> None:
    """Rows without a free bin are never drawn from by table 2; a full table 1 leaves table 2 nothing."""
    direction = every_bin(columns, rows)
    for full_rows in range(1, rows + 1):
        chosen = direction[: full_rows * columns] if full_rows % 2 else direction[-full_rows * columns :]
        maps = photon_maps(columns, rows, chosen, np.ones(len(chosen)))
        filled = Filled(material, maps, len(chosen), 4000)
        assert filled.occupied == len(chosen)
        taken = filled.density[:, 0] > 0
        assert taken.sum() == len(chosen) * FINE * FINE
        if full_rows == rows:
            assert filled.sums[1] == 0
            continue
        assert (filled.density[:, 1] * filled.angle).sum() == pytest.approx(1, abs=2e-5)
        assert filled.counts(1)[taken].sum() <= 2  # rounding of an azimuth on the border of a bin


def test_one_free_bin_in_a_row() -> None:
    """All but one bin occupied: table 2 is that bin alone."""
    for columns, rows, free in ((32, 10, 5), (7, 5, 33), (16, 8, 0)):
        direction = np.delete(every_bin(columns, rows), free, axis=0)
        filled = Filled(DIFFUSE, photon_maps(columns, rows, direction, np.ones(len(direction))), len(direction), 4000)
        assert (filled.probability[1] == pytest.approx(1, abs=1e-5)) and (filled.density[:, 1] > 0).sum() == FINE**2


def test_clear_leaves_no_trace() -> None:
    maps = photon_maps(32, 16, *photons(50, 5, 0.3))
    filled = Filled(DIFFUSE, maps, 50, 1)
    assert np.count_nonzero(filled.work.weight) == filled.occupied > 5
    run_clear(filled.work, filled.occupied)
    assert not filled.work.weight.any()


@pytest.mark.parametrize(("columns", "rows"), [(32, 16), (7, 5), (1, 1), (3, 64)])
def test_bins_round_trip(columns: int, rows: int) -> None:
    u = np.random.default_rng(1).random((columns * rows * 200, 2), np.float32) * np.float32(0.998) + np.float32(0.001)
    out = np.empty(len(u), np.int64)
    run_round_trip(no_forecast((columns, rows)), u, out)
    assert (out == np.arange(len(u)) % (columns * rows)).all()


def test_splitting() -> None:
    """S halves every second rank, is one at deeper vertices, and ends where rank + 2 depth passes the largest rank."""
    maps = no_forecast()._replace(max_rank=4, splitting=8)
    assert [run_splitting(maps, rank, 0) for rank in range(7)] == [8, 8, 4, 4, 2, 0, 0]
    assert [run_splitting(maps, rank, 1) for rank in range(5)] == [1, 1, 1, 0, 0]
    assert [run_splitting(maps, 0, depth) for depth in range(4)] == [8, 1, 1, 0]
    assert run_splitting(maps._replace(max_rank=20), 20, 0) == 1
