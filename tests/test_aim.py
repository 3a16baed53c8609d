"""Aimed emission: the sampler follows its density, no power is lost or gained, wrong boxes are refused."""

from pathlib import Path

import msgspec
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, p_value, sidak
from rendering import REPOSITORY, make_config, prepare, scene_from
from z_test import ALPHA, compare

from causticmpi.config.load import load_config
from causticmpi.config.records import Box
from causticmpi.errors import InputError
from causticmpi.kernels import aim as kernel_aim
from causticmpi.kernels import vec
from causticmpi.preprocess.aim import PAYS, SHARE, aim_that_pays, emission_aim
from causticmpi.preprocess.photons import shoot_photons
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene

POINT = np.array([[0.3, -0.2, 0.4]], np.float32)
NORMAL = np.array([[0.48, 0.6, 0.64]], np.float32)
BOXES = {
    "three faces": ([1, 0.5, 1], [2, 2, 1.8]),
    "one face, near": ([-1, -1, 1], [1, 1, 2]),
    "flat": ([-1, 0.8, -1], [2, 0.8, 1]),
    "crosses the light's plane": ([0.5, -3, -3], [1, 3, 3]),
    "far": ([40, 30, 50], [42, 33, 51]),
}
COMPARISONS = 2 * len(BOXES)
CELLS = 24


@numba.njit
def run_sample(aim, p, u, out):
    for i in range(u.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = kernel_aim.sample_aimed(aim, vec.row(p, 0), u[i, 0], u[i, 1], u[i, 2])


@numba.njit
def run_emission(aim, p, n, u, out, weight):
    for i in range(u.shape[0]):
        d, weight[i] = kernel_aim.emission(aim, vec.row(p, 0), vec.row(n, 0), u[i, 0], u[i, 1], u[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = d


@numba.njit
def run_pdf(aim, p, direction, out):
    for i in range(direction.shape[0]):
        out[i] = kernel_aim.aimed_pdf(aim, vec.row(p, 0), vec.row(direction, i))


@numba.njit
def run_share(aim, p, n):
    return kernel_aim.aimed_share(aim, vec.row(p, 0), vec.row(n, 0))


def box(name: str) -> np.ndarray:
    return np.array([*BOXES[name][0], *BOXES[name][1], SHARE], np.float32)


def pdf(aim: np.ndarray, direction: np.ndarray) -> np.ndarray:
    out = np.empty(len(direction), np.float32)
    run_pdf(aim, POINT, np.ascontiguousarray(direction, np.float32), out)
    return out


def cells_towards(aim: np.ndarray) -> SphereCells:
    """Cells about the direction to the box's middle, fine where the box is seen."""
    corners = np.array(np.meshgrid(*zip(aim[:3], aim[3:6], strict=True))).reshape(3, -1).T - POINT
    axis = corners.mean(axis=0)
    axis /= np.linalg.norm(axis)
    edge = max(float((corners @ axis / np.linalg.norm(corners, axis=1)).min()), -0.999)
    return SphereCells(axis, np.concatenate([[-1], np.linspace(edge - 1e-4, 1, CELLS)]), CELLS)


@pytest.mark.statistical
@pytest.mark.parametrize("name", BOXES)
def test_sampler_follows_density(name: str) -> None:
    aim, points = box(name), 24
    out = np.empty((SAMPLES, 3), np.float32)
    run_sample(aim, POINT, np.random.default_rng(3).random((SAMPLES, 3), np.float32), out)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-5)
    assert (pdf(aim, out) > 0).mean() > 1 - 1e-5  # rounding at the rim
    cells = cells_towards(aim)
    directions, _ = cells.quadrature(points)
    expected = cells.integrate(pdf(aim, directions), points)
    assert expected.sum() == pytest.approx(1, abs=5e-3)  # the midpoint rule at the rim of the box
    # The rim is where the quadrature errs: cells that the rim cuts are left to the two assertions above.
    inside = (pdf(aim, directions) > 0).reshape(CELLS, points, CELLS, points).mean(axis=(1, 3))
    whole = inside == 1
    assert whole.any()
    counts, share = cells.counts(out)[whole], expected[whole]
    p = p_value(np.append(counts, SAMPLES - counts.sum()), SAMPLES * np.append(share, 1 - share.sum()))
    print(f"\n{name}: p = {p:.3f}, {whole.sum()} cells")
    assert p > sidak(COMPARISONS)


@pytest.mark.statistical
@pytest.mark.parametrize("name", BOXES)
def test_weights_give_the_natural_cosine_back(name: str) -> None:
    """Weighted by cos / density the mixture carries cos over every part of the hemisphere, as natural emission does."""
    aim = box(name)
    out, weight = np.empty((SAMPLES, 3), np.float32), np.empty(SAMPLES, np.float32)
    run_emission(aim, POINT, NORMAL, np.random.default_rng(4).random((SAMPLES, 3), np.float32), out, weight)
    cosine = out.astype(np.float64) @ NORMAL[0]
    assert weight.max() <= np.pi / (1 - SHARE) * 1.0001 and ((weight > 0) == (cosine > 0)).all()
    cells = SphereCells(NORMAL[0].astype(float), np.linspace(0, 1, 7), 12)
    x, y, z = cells.frame @ out[cosine > 0].astype(np.float64).T
    place = np.minimum((z * 6).astype(int), 5) * 12 + np.minimum(
        (np.arctan2(y, x) / (2 * np.pi) % 1 * 12).astype(int), 11
    )
    w = weight[cosine > 0].astype(np.float64)
    sums = np.bincount(place, weights=w, minlength=72) / SAMPLES
    error = np.sqrt(np.bincount(place, weights=w * w, minlength=72)) / SAMPLES
    exact = np.repeat(np.pi * np.diff(np.linspace(0, 1, 7) ** 2), 12) / 12
    assert np.abs((sums - exact) / error).max() < 4.5


def test_no_aim_from_inside_or_behind() -> None:
    assert run_share(box("far"), POINT, NORMAL) == np.float32(SHARE)
    assert run_share(box("far"), POINT, -NORMAL) == 0
    around = np.array([-1, -1, -1, 1, 1, 1, SHARE], np.float32)
    assert run_share(around, POINT, NORMAL) == 0
    assert run_share(kernel_aim.NATURAL, POINT, NORMAL) == 0


@pytest.fixture(scope="module")
def cornell() -> SceneData:
    return load_scene(REPOSITORY / "scenes" / "cornell.yaml")


def powers(scene: SceneData, aim: np.ndarray, batches: int, size: int) -> np.ndarray:
    """(batches, 3): caustic power per particle, over the points of the first `size` of each seed."""
    prepared = prepare(scene)
    found = []
    for seed in range(batches):
        points, emitted, _ = shoot_photons(prepared.traced, seed, size, aim)
        found.append(points.power.sum(axis=0, dtype=np.float64) / emitted)
    prepared.embree.close()
    return np.array(found)


@pytest.mark.statistical
@pytest.mark.parametrize("setting", ["auto", Box(min=(-1, -1, -1), max=(0, 0, 0))])
def test_power_is_that_of_natural_emission(cornell: SceneData, setting: str | Box) -> None:
    """All caustic paths, L D+ S+ D among them, whether the box holds both spheres or the half of one."""
    natural = powers(cornell, kernel_aim.NATURAL, 40, 5000)
    aimed = powers(cornell, emission_aim(setting, cornell), 40, 5000)
    verdict = compare(aimed, natural)
    print(f"\n{verdict}; {100 * (aimed.mean() / natural.mean() - 1):+.2f} %")
    assert verdict.p > ALPHA
    assert aimed.std(axis=0, ddof=1).max() / aimed.mean() / np.sqrt(40) < 0.007


def test_auto_holds_all_specular_surfaces(cornell: SceneData, tmp_path: Path) -> None:
    aim = emission_aim("auto", cornell)
    np.testing.assert_allclose(aim, [-0.77, -1, -0.65, 0.77, -0.3, 0.65, SHARE], atol=1e-6)
    assert not emission_aim("off", cornell).any()
    away = emission_aim("auto", scene_from(LAMP_ON_A_WALL, tmp_path))
    assert not away.any()  # behind the only light


@pytest.mark.parametrize(("room", "pays"), [(2.5, False), (20, True)])
def test_aim_is_taken_where_natural_emission_finds_few(room: float, pays: bool, tmp_path: Path) -> None:
    """A sphere that fills most of its room is found anyway, one that is lost in a hall is not."""
    scene = scene_from(SPHERE_IN_A_ROOM.format(half=room / 2, lamp=room / 2 - 0.3), tmp_path)
    traced = prepare(scene).traced
    aim = emission_aim("auto", scene)
    assert aim.any()
    taken = aim_that_pays(aim, traced, 1)
    np.testing.assert_array_equal(taken, aim if pays else kernel_aim.NATURAL)
    shot = [shoot_photons(traced, 2, 4000, way) for way in (kernel_aim.NATURAL, aim)]
    natural, aimed = (len(points.power) / rays for points, _, rays in shot)
    print(f"\n{aimed / natural:.1f} times as many points a ray")
    assert (aimed > PAYS * natural) == pays


def test_no_aim_no_trial(cornell: SceneData) -> None:
    assert not aim_that_pays(kernel_aim.NATURAL, prepare(cornell).traced, 1).any()


SPHERE_IN_A_ROOM = """
camera: {{eye: [0, 0, 0.9], target: [0, 0, 0]}}
materials:
  grey: {{type: diffuse, reflectance: 0.5}}
  glass: {{type: dielectric, ior: 1.5}}
shapes:
  - {{type: box, min: [-{half}, -{half}, -{half}], max: [{half}, {half}, {half}], material: grey}}
  - {{type: sphere, center: [0, {lamp}, 0], radius: 0.2, material: grey, emission: 9}}
  - {{type: sphere, center: [0, 0, 0], radius: 0.5, material: glass}}
"""
LAMP_ON_A_WALL = """
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials:
  black: {type: diffuse, reflectance: 0}
  glass: {type: dielectric, ior: 1.5}
shapes:
  - {type: quad, corners: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], material: black, emission: 1}
  - {type: sphere, center: [0, 0, -3], radius: 1, material: glass}
"""


def test_wrong_boxes_are_refused(cornell: SceneData, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no specular surface; allowed: .* write aim: auto"):
        emission_aim(Box(min=(-1, 0.5, -1), max=(1, 0.9, 1)), cornell)
    with pytest.raises(InputError, match="lies behind every light"):
        emission_aim(Box(min=(-1, -1, -4), max=(1, 1, -1)), scene_from(LAMP_ON_A_WALL, tmp_path))
    config = tmp_path / "c.yaml"
    config.write_text("scene: s.yaml\nforecast:\n  aim: {min: [0, 0, 0], max: [1, -1, 1]}\n")
    with pytest.raises(InputError, match=r"c.yaml:3: forecast.aim: found min .* allowed: min below max"):
        load_config(config)
    with pytest.raises(msgspec.ValidationError):
        make_config(forecast={"aim": "atuo"})
