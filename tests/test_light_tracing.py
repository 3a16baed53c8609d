"""Light tracing, guided emission and the cells of the forecast: each against a plain oracle, and errors are found."""

import itertools
from pathlib import Path

import msgspec
import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, p_value, pair_p_value, sidak
from rendering import make_config, prepare, render_passes, scene_from
from test_chains import assert_stand_for, chain_names, naive_chains, naive_represent
from test_kernels_bsdf import materials
from test_mixture import DIFFUSE, NORMAL, OUT, SOFT, Place, naive_weights
from test_packed_photons import DIRECTION_ERROR, REAL_ERROR
from test_parallax import naive_settle, naive_turned
from z_test import ALPHA, compare

from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import prepare_method
from causticmpi.distributed.world import SerialWorld
from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators.mixture_rays import mixture_work
from causticmpi.kernels import camera as camera_room
from causticmpi.kernels import emission, vec
from causticmpi.kernels.emission import emission_guide, natural_emission
from causticmpi.kernels.particle_waves import GROUP
from causticmpi.preprocess import cells
from causticmpi.preprocess.cells import COARSER, DRAWN, KEPT, KNOWN, LEVELS, build_cells, cell_edge
from causticmpi.preprocess.chains import part_chains
from causticmpi.preprocess.forecast import no_forecast
from causticmpi.preprocess.packed_photons import packed_photons, unpacked_photons
from causticmpi.preprocess.parallax import CURVATURE, HEIGHT, POWER
from causticmpi.preprocess.photons import CausticPoints
from causticmpi.render import rounds
from causticmpi.render.film import Film
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

LIGHTS = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials:
  black: {type: diffuse, reflectance: 0}
shapes:
  - {type: quad, corners: [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 1, 0]], material: black, emission: [1, 2, 3]}
  - {type: sphere, center: [5, -1, 2], radius: 0.3, material: black, emission: 4}
"""
# A small light over a mirror sphere on a floor: a bright caustic in plain sight.
OPEN = """\
camera: {eye: [0, 2.5, 2.5], target: [0, 0, 0], fov: 50}
materials:
  white: {type: diffuse, reflectance: 0.7}
  gloss: {type: phong, diffuse: 0.3, specular: 0.4, exponent: 30}
  black: {type: diffuse, reflectance: 0}
  mirror: {type: mirror, reflectance: 0.9}
shapes:
  - {type: quad, corners: [[-2, 0, 2], [0, 0, 2], [0, 0, -2], [-2, 0, -2]], material: white}
  - {type: quad, corners: [[0, 0, 2], [2, 0, 2], [2, 0, -2], [0, 0, -2]], material: gloss}
  - {type: sphere, center: [0, 0.5, 0], radius: 0.4, material: mirror}
  - type: quad
    corners: [[-1, 2, 0.2], [-1, 2, -0.2], [-0.6, 2, -0.2], [-0.6, 2, 0.2]]
    material: black
    emission: 300
"""
LANE = 2
"""Of the vertex whose cell is asked."""
STEP = np.float32([0.06, -0.05, 0.07])
"""The way from the middle of its cell to it."""
COMPARISONS = 3 + 2
PASSES = 12000


@numba.njit
def run_emit(scene, guide, u, point, direction, power, flux):
    for i in range(len(u)):
        p, _, _, e, d, f = emission.emit(scene, guide, u[i, 0], u[i, 1], u[i, 2], u[i, 3], u[i, 4])
        point[i, 0], point[i, 1], point[i, 2] = p
        direction[i, 0], direction[i, 1], direction[i, 2] = d
        power[i], flux[i] = vec.luminance(e), vec.luminance(f)


@numba.njit
def run_reshape(guide, group, u, out, share):
    for i in range(len(u)):
        out[i, 0], out[i, 1], share[i] = emission.reshape(guide, group, u[i, 0], u[i, 1])


@numba.njit
def run_film_position(camera, x, y, d, out):
    for i in range(len(x)):
        _, direction = camera_room.primary_ray(camera, x[i], y[i])
        a, b, depth = camera_room.film_position(camera, vec.scale(direction, d[i]))
        out[i, 0], out[i, 1], out[i, 2] = a, b, depth


@numba.njit
def run_cells(maps, p, n, out):
    for i in range(len(p)):
        out[i] = cells.cell_of(maps, vec.row(p, i), vec.row(n, i))


@numba.njit
def run_weigh_cell(scene, maps, work, cell, p, n, wo, material):
    return cm.weigh_cell(scene, maps, work, LANE, cell, Place(vec.row(p, 0), vec.row(n, 0), vec.row(wo, 0), material))


@numba.njit
def run_sample_cell(work, u, out):
    for i in range(len(u)):
        axis, height = cm.choose_cone(work, LANE, u[i, 0])
        out[i, 0], out[i, 1], out[i, 2] = cm.in_cone(axis, height, u[i, 1], u[i, 2])


@numba.njit
def run_cell_pdf(work, direction, out):
    for i in range(len(direction)):
        out[i] = cm.cones_pdf(work, LANE, vec.row(direction, i))


def uniform(count: int, columns: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random((count, columns), np.float32)


def density(groups: int, side: int) -> np.ndarray:
    return np.random.default_rng(side).exponential(size=(groups, side, side)) + 0.05


@pytest.mark.parametrize("side", [1, 3, 16])
def test_a_guide_draws_what_it_says(side: int) -> None:
    """Counts by cell against the density; and 1 / share is that density at every point drawn."""
    wanted = density(2, side)
    guide, out, share = emission_guide(wanted), np.zeros((SAMPLES, 2), np.float32), np.zeros(SAMPLES, np.float32)
    run_reshape(guide, 1, uniform(SAMPLES, 2), out, share)
    assert out.min() >= 0 and out.max() < 1
    i, j = np.minimum((out.astype(np.float64) * side).astype(int), side - 1).T
    probability = wanted[1] / wanted[1].sum()
    if side > 1:
        assert p_value(np.bincount(i * side + j, minlength=side**2), SAMPLES * probability) > sidak(COMPARISONS)
    assert pair_p_value(*((out.astype(np.float64) * side) % 1).T) > sidak(COMPARISONS)
    # A point within rounding of a border belongs to either cell.
    close = np.isclose(1 / share, probability[i, j] * side**2, rtol=1e-3)
    assert close.mean() > 1 - 1e-4


def test_guided_emission_keeps_every_sum(tmp_path: Path) -> None:
    """Power of virtual lights and flux of particles, by direction and place, are those of natural emission."""
    scene = prepare(scene_from(LIGHTS, tmp_path)).traced
    groups = len(scene.light_cdf)

    def sums(guide: emission.EmissionGuide, seed: int) -> np.ndarray:
        point, direction = np.zeros((SAMPLES, 3), np.float32), np.zeros((SAMPLES, 3), np.float32)
        power, flux = np.zeros(SAMPLES, np.float32), np.zeros(SAMPLES, np.float32)
        run_emit(scene, guide, uniform(SAMPLES, 5, seed), point, direction, power, flux)
        assert np.allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-5)
        ball = point[:, 2] > 0.5
        parts = [
            f * mask for f in (power, flux) for mask in (ball, ~ball, ball & (point[:, 0] > 5.1), point[:, 1] > 0.7)
        ]
        parts += [flux * (direction[:, 0] > 0.6), flux * ball * (direction[:, 1] > 0.5) * (point[:, 2] > 2.1)]
        return np.stack(parts, axis=1).astype(np.float64).reshape(1024, -1, len(parts)).mean(axis=1)

    natural, guided = sums(natural_emission(), 1), sums(emission_guide(density(groups, 8)), 2)
    verdict = compare(natural, guided)
    assert verdict.p > ALPHA, verdict
    unweighted = guided * np.linspace(1, 1.1, guided.shape[1])
    assert compare(natural, unweighted).p < 1e-6, "the test must see errors of some percent"


def test_film_position_is_the_inverse_of_primary_rays(tmp_path: Path) -> None:
    scene = scene_from(OPEN, tmp_path)
    camera = camera_array(scene.camera, 64, 48)
    u = uniform(1000, 3)
    out = np.zeros((1000, 3), np.float32)
    x, y, d = u[:, 0] * 64, u[:, 1] * 48, 0.1 + 5 * u[:, 2]
    run_film_position(camera, x, y, d, out)
    np.testing.assert_allclose(out[:, :2], np.stack([x, y], axis=1), atol=2e-3)
    forward = naive.unit(np.subtract(scene.camera.target, scene.camera.eye))
    assert (out[:, 2] > 0).all() and (out[:, 2] <= d * (1 + 1e-5)).all()
    middle = np.zeros((1, 3), np.float32)
    run_film_position(camera, np.float32([32]), np.float32([24]), np.float32([2]), middle)
    np.testing.assert_allclose(middle[0], [32, 24, 2 * np.linalg.norm(forward)], rtol=1e-4)


def config(**forecast: object) -> object:
    return make_config(
        method="iws+cf",
        film={"width": 16, "height": 16},
        iws={"paths": 16},
        forecast={"photons": 5000, "clusters": 16, "neighbours": 20, **forecast},
    )


@pytest.fixture(scope="module")
def open_scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return scene_from(OPEN, tmp_path_factory.mktemp("open"))


@pytest.mark.statistical
def test_drawn_caustics_are_those_the_eye_finds(open_scene: SceneData) -> None:
    """L_c with light paths against L_c by the forecast alone, diffuse and glossy floor: blocks of 4 x 4 pixels."""

    def blocks(light_tracing: bool, seed: int) -> np.ndarray:
        made = msgspec.structs.replace(config(light_tracing=light_tracing), seed=seed)
        films = render_passes(open_scene, made, PASSES)[..., 3:].astype(np.float64)
        return films.reshape(PASSES, 4, 4, 4, 4, 3).mean(axis=(2, 4)).reshape(PASSES, -1)

    drawn, found = blocks(True, 1), blocks(False, 2)
    verdict = compare(drawn, found)
    assert found.mean() > 0.01 and verdict.p > ALPHA, verdict
    assert compare(drawn * 1.1, found).p < 1e-6, "the test must see ten percent"


def test_gloss_is_left_to_the_forecast(open_scene: SceneData) -> None:
    prepared = prepare(open_scene)
    camera = camera_array(open_scene.camera, 16, 16)
    method, made = prepare_method(SerialWorld(), config(), prepared, camera, Stopwatch())
    assert method.light_paths == int(made.guides.paths_per_pixel * 256) > 0
    light = np.zeros((256, 3), np.float32)
    rays = method.trace_light(0, 0, method.light_paths, light)
    assert rays > method.light_paths
    right = light.reshape(16, 16, 3)[:, 9:]
    assert light.sum() > 0 and right.sum() < 0.02 * light.sum()  # the right half of the floor is glossy
    with pytest.raises(ValueError, match="1 slots for the 256 pixels"):  # whatever a kernel hit beyond it would break
        method.trace_light(0, 0, method.light_paths, light[:1])
    prepared.embree.close()


def test_bits_do_not_depend_on_how_a_pass_is_divided(open_scene: SceneData) -> None:
    prepared = prepare(open_scene)
    camera = camera_array(open_scene.camera, 16, 16)
    method, _ = prepare_method(SerialWorld(), config(), prepared, camera, Stopwatch())
    method.light_paths = 9 * GROUP + 77
    films = []
    for cuts in ([], [1], [4], [1, 2, 3, 7], range(1, 10)):
        film, rays = np.zeros((256, 3), np.float32), 0
        borders = [0, *(GROUP * cut for cut in cuts), method.light_paths]
        for first, last in itertools.pairwise(borders):
            rays += method.trace_light(3, first, last, film)
        films.append((rays, film.tobytes()))
    assert film.any() and len(set(films)) == 1
    other = np.zeros((256, 3), np.float32)
    method.trace_light(4, 0, method.light_paths, other)
    assert other.tobytes() != films[0][1]
    prepared.embree.close()


def test_batches_of_light_paths_begin_with_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the clock says."""
    calls: list[tuple[int, int]] = []

    class Light:
        light_paths = 50 * GROUP + 5

        def trace_light(self, pass_index: int, first: int, last: int, film: np.ndarray) -> int:
            calls.append((first, last))
            return 0

    stretches = itertools.cycle([0.9, 0.31, 1.7, 0.26, 3.3])
    monkeypatch.setattr(rounds, "_stretch", lambda seconds: next(stretches))
    pixels = np.zeros((16, 4), np.int64)
    batches = rounds.Batches(Light(), pixels, 16)  # type: ignore[arg-type]
    for index in range(3):
        assert batches.trace([rounds.Share(index, 0, 0, light=True)], Film(16, 2.0**-40), lambda: False)
    starts = [first for first, _ in calls]
    assert len(calls) > 12 and all(first % GROUP == 0 for first in starts)
    assert sum(last - first for first, last in calls) == 3 * Light.light_paths


def test_what_the_eye_does_not_see_costs_nothing(open_scene: SceneData) -> None:
    away = msgspec.structs.replace(open_scene.camera, target=(0.0, 5.0, 2.6))
    prepared = prepare(open_scene)
    method, _ = prepare_method(SerialWorld(), config(), prepared, camera_array(away, 16, 16), Stopwatch())
    assert method.light_paths == 0
    prepared.embree.close()


def points(count: int = 4000) -> CausticPoints:
    """Caustic points on a floor and a wall, their directions in a lobe that turns with the place; power (n,)."""
    generator = np.random.default_rng(5)
    position = generator.random((count, 3)).astype(np.float32) * [2, 0, 2] - np.float32([1, 0, 1])
    normal = np.tile(np.float32([0, 1, 0]), (count, 1))
    wall = np.arange(count) % 4 == 0
    position[wall] = position[wall][:, [1, 0, 2]]
    normal[wall] = 1, 0, 0
    direction = naive.unit(normal + 0.3 * position + 0.2 * generator.normal(size=(count, 3)))
    power, curvature = generator.exponential(size=count), generator.normal(size=(count, 6))
    floats = (a.astype(np.float32) for a in (position, normal, direction, power, curvature))
    return CausticPoints(*floats, chain_names(count, 17))


def test_cells_hold_the_photons_around() -> None:
    """Against a plain grid: the smallest level with enough photons answers, with DRAWN of its own, drawn in equal steps
    of power; turned to their middle, and with cones as wide as COMPANIONS other photons ask for. Behind them photons
    that stand for the chains of which fewer than KNOWN are among them."""
    found_points = points()
    position, normal, direction, power, curvature, _ = found_points
    facing, chains = naive_chains(found_points)
    edge = cell_edge(0.1, 20)
    maps = no_forecast()._replace(**build_cells(found_points, part_chains(found_points), edge))
    found = np.zeros(len(position), np.int64)
    run_cells(maps, position, normal, found)
    assert (found >= 0).mean() > 0.9
    sides = [np.float32(edge) * COARSER**level for level in range(LEVELS)]
    keys = [np.concatenate([np.floor(position / side), normal], axis=1) for side in sides]
    photons, compared, turns, stood, held = unpacked_photons(maps.cell_photon), [], [], [], []
    for i in range(0, len(position), 37):
        alike = [np.flatnonzero((key == key[i]).all(axis=1)) for key in keys]
        side, members = next(pair for pair in zip(sides, alike, strict=True) if len(pair[1]) >= cells.FEWEST)
        marks = power[members].sum(dtype=np.float64) * (np.arange(DRAWN) + 0.5) / DRAWN
        drawn = members[np.searchsorted(np.cumsum(power[members].astype(np.float64)), marks)]
        middle = position[drawn].mean(axis=0, dtype=np.float64)
        np.testing.assert_allclose(maps.cell[found[i]], middle, atol=1e-6)
        often = int(np.ceil(DRAWN / min(len(members), DRAWN)))
        others = min(DRAWN - 1, often * (1 + cells.COMPANIONS) - 1)
        wanted, height, turned, sure = naive_settle(
            direction[drawn], curvature[drawn], middle - position[drawn], others
        )
        kept = photons[found[i]].T[:DRAWN]
        each = power[members].sum(dtype=np.float64) / DRAWN
        np.testing.assert_allclose(kept[:, POWER], each, rtol=2 * REAL_ERROR)
        np.testing.assert_allclose(kept[sure, HEIGHT], height[sure], rtol=2e-3 + REAL_ERROR)
        if sure.any():
            np.testing.assert_allclose(kept[:, :3], wanted, atol=1e-6 + DIRECTION_ERROR)
            np.testing.assert_allclose(kept[turned == 1, CURVATURE:], curvature[drawn[turned == 1]], rtol=REAL_ERROR)
        compared.append(sure.mean())
        turns.append((turned == 1).mean())
        around = chains[facing[i]], drawn, maps.cell[found[i]], KNOWN, float(side) ** 2, KEPT - DRAWN
        expected = naive_represent(found_points, *around)
        held.append(len(expected))
        behind = photons[found[i], :, DRAWN:].T
        stood.append(assert_stand_for(behind[: held[-1]], expected, REAL_ERROR, 1e-6 + DIRECTION_ERROR))
        assert (behind[held[-1] :] == 0).all()
    assert np.mean(compared) > 0.85 and 0.05 < np.mean(turns) < 0.95
    assert np.mean(stood) > 0.85 and 0.05 < (np.array(held) == KEPT - DRAWN).mean() < 0.95
    nowhere = np.zeros(1, np.int64)
    run_cells(maps, np.float32([[50, 50, 50]]), np.float32([[0, 1, 0]]), nowhere)
    assert nowhere[0] == -1


def axes_of(photon: np.ndarray) -> np.ndarray:
    """Directions (n, 3) of a cell's photons (ROWS, n) at the place a STEP from it."""
    photon = photon.T
    return naive_turned(photon[:, :3].astype(np.float64), photon[:, CURVATURE:], np.tile(STEP, (len(photon), 1)))


@pytest.mark.parametrize("material", [DIFFUSE, SOFT])
@pytest.mark.parametrize("degrees", [1.0, 20.0])
def test_directions_of_a_cell(degrees: float, material: int) -> None:
    """By power, cosine and BRDF, and those of no photon never."""
    made, generator = points(), np.random.default_rng(9)
    maps = no_forecast()._replace(**build_cells(made, part_chains(made), 0.5))
    photon = unpacked_photons(maps.cell_photon)
    count = KEPT - 3
    photon[1, :, count:] = 0
    photon[1, POWER, :count] = generator.exponential(size=count)
    photon[1, HEIGHT, :count] = 1 - np.cos(np.radians(np.linspace(degrees, degrees / 2, count)))
    photon[1, CURVATURE:, :count] = generator.normal(size=(6, count))
    maps = maps._replace(cell_photon=packed_photons(photon))
    photon = unpacked_photons(maps.cell_photon)[1, :, :count]
    work = mixture_work(maps)
    assert run_weigh_cell(materials(), maps, work, 1, (maps.cell[1] + STEP)[None], NORMAL[None], OUT[None], material)
    axes = axes_of(photon)
    assert np.abs(axes - photon[:3].T).max() > 0.05
    weight = naive_weights(material, axes, photon[POWER])
    assert 1 < (weight == 0).sum() < count / 2
    wanted = np.append(np.cumsum(weight), np.full(KEPT - count, weight.sum()))
    np.testing.assert_allclose(work.cdf[LANE, :KEPT], wanted, atol=2e-6 * weight.sum())
    heights, axes, weight = photon[HEIGHT, weight > 0], axes[weight > 0], weight[weight > 0] / weight.sum()
    out = np.zeros((SAMPLES, 3), np.float32)
    run_sample_cell(work, uniform(SAMPLES, 3), out)
    grid = SphereCells(axes.mean(axis=0), np.cos(np.radians(np.linspace(180, 0, 91))), columns=32)
    quadrature, _ = grid.quadrature(16)
    found = np.zeros(len(quadrature), np.float32)
    run_cell_pdf(work, quadrature.astype(np.float32), found)
    expected = grid.integrate(found, 16)
    assert abs(expected.sum() - 1) < 2e-3
    t = 1 - quadrature @ axes.T
    h = heights.astype(np.float64)
    np.testing.assert_allclose(found, (weight * h * (2 + h) / (4 * np.pi * (h + t) ** 2)).sum(axis=1), rtol=2e-3)
    assert p_value(grid.counts(out), SAMPLES * expected / expected.sum()) > sidak(4)
