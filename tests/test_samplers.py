"""Samplers of directions, points and lights against their densities."""

import math

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, heights_about_lobe, p_value, pair_p_value, sidak
from rendering import prepare, scene_from

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.kernels import vec, warp
from causticmpi.kernels.traced_scene import light_point, pick_light

COMPARISONS = 6 + 1 + 5
COSINE, SPHERE, LOBE = 0, 1, 2
SCENE = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials:
  black: {type: diffuse, reflectance: 0}
shapes:
  - {type: quad, corners: [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 1, 0]], material: black, emission: [1, 2, 3]}
  - {type: quad, corners: [[0, 0, 5], [3, 0, 5], [3, 2, 5], [0, 1, 5]], material: black}
  - {type: sphere, center: [5, -1, 2], radius: 0.3, material: black, emission: 4}
  - {type: sphere, center: [9, 0, 0], radius: 0.5, material: black, emission: [0, 0, 1]}
"""


@numba.njit
def run_warp(kind, exponent, u, out):
    for i in range(u.shape[0]):
        if kind == 0:
            d = warp.cosine_hemisphere(u[i, 0], u[i, 1])
        elif kind == 1:
            d = warp.uniform_sphere(u[i, 0], u[i, 1])
        else:
            d = warp.phong_lobe(u[i, 0], u[i, 1], exponent)
        out[i, 0], out[i, 1], out[i, 2] = d


@numba.njit
def run_pdf(kind, exponent, z, out):
    for i in range(z.shape[0]):
        if kind == 0:
            out[i] = warp.cosine_hemisphere_pdf(z[i])
        elif kind == 1:
            out[i] = warp.UNIFORM_SPHERE_PDF
        else:
            out[i] = warp.phong_lobe_pdf(z[i], exponent)


@numba.njit
def run_triangle(u, out):
    for i in range(u.shape[0]):
        out[i, 0], out[i, 1] = warp.triangle_barycentrics(u[i, 0], u[i, 1])


@numba.njit
def run_lights(scene, u, light, again, point, normal, offset):
    for i in range(u.shape[0]):
        light[i], again[i] = pick_light(scene, u[i, 2])
        p, n, offset[i] = light_point(scene, light[i], u[i, 0], u[i, 1])
        for c in range(3):
            point[i, c], normal[i, c] = p[c], n[c]


@numba.njit
def run_frames(normals, local, out, back):
    for i in range(normals.shape[0]):
        w = vec.to_world(vec.row(local, i), vec.row(normals, i))
        out[i, 0], out[i, 1], out[i, 2] = w
        back[i, 0], back[i, 1], back[i, 2] = vec.to_local(w, vec.row(normals, i))


def uniforms(seed: int, columns: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).random((SAMPLES, columns), np.float32)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("kind", "exponent"), [(COSINE, 0), (SPHERE, 0), (LOBE, 0), (LOBE, 1), (LOBE, 60), (LOBE, 1000)]
)
def test_warp_follows_pdf(kind: int, exponent: float) -> None:
    out = np.empty((SAMPLES, 3), np.float32)
    run_warp(kind, np.float32(exponent), uniforms(exponent), out)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-6)
    cells = SphereCells(np.array([0.0, 0, 1]), heights_about_lobe(exponent))
    z = np.ascontiguousarray(cells.quadrature(16)[0][:, 2], np.float32)
    density = np.empty(len(z), np.float32)
    run_pdf(kind, np.float32(exponent), z, density)
    expected = cells.integrate(density, 16)
    assert expected.sum() == pytest.approx(1, abs=1e-3)
    assert p_value(cells.counts(out), SAMPLES * expected) > sidak(COMPARISONS)


def test_corners_of_the_unit_square() -> None:
    """The least and greatest uniform numbers give unit directions, none of them in the surface itself."""
    edge = np.array([0, 2.0**-24, 0.5, 1 - 2.0**-24], np.float32)
    u = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    out = np.empty((len(u), 3), np.float32)
    for kind, exponent in ((COSINE, 0), (SPHERE, 0), (LOBE, 0), (LOBE, 1000)):
        run_warp(kind, np.float32(exponent), u, out)
        np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-6)
        assert kind == SPHERE or out[:, 2].min() > 0


def test_pdf_is_zero_below_the_horizon() -> None:
    z, out = np.linspace(-1, 0, 50, dtype=np.float32), np.empty(50, np.float32)
    for kind in (COSINE, LOBE):
        run_pdf(kind, np.float32(2), z, out)
        assert (out == 0).all()


@pytest.mark.statistical
def test_triangle_barycentrics_are_uniform() -> None:
    """Folding a uniform point of the square into the triangle is undone by its two independent uniform marginals."""
    out = np.empty((SAMPLES, 2), np.float32)
    run_triangle(uniforms(11), out)
    b, c = out.astype(np.float64).T
    assert b.min() >= 0 and c.min() >= 0 and (b + c).max() < 1 + 1e-6
    # For a uniform point of a triangle (1 - a)^2 and c / (1 - a) are independent and uniform.
    rest = b + c
    assert pair_p_value(np.minimum(rest**2, 1 - 1e-9), np.minimum(c / rest, 1 - 1e-9)) > sidak(COMPARISONS)


def test_frames() -> None:
    """to_world and to_local are inverse rotations for any normal, the poles included."""
    generator = np.random.default_rng(3)
    normals = naive.unit(generator.normal(size=(20000, 3))).astype(np.float32)
    normals[:4] = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [1e-4, 0, -1]]
    normals[4:1000] = naive.unit([0, 0, -1] + 1e-3 * generator.normal(size=(996, 3)))
    local = naive.unit(generator.normal(size=(20000, 3))).astype(np.float32)
    out, back = np.empty_like(local), np.empty_like(local)
    run_frames(normals, local, out, back)
    np.testing.assert_allclose(back, local, atol=3e-6)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=3e-6)
    np.testing.assert_allclose((out * normals).sum(axis=1), local[:, 2], atol=3e-6)


@pytest.fixture(scope="module")
def lights(tmp_path_factory: pytest.TempPathFactory) -> PreparedScene:
    return prepare(scene_from(SCENE, tmp_path_factory.mktemp("lights")))


@pytest.mark.statistical
def test_lights(lights: PreparedScene) -> None:
    """Choice by power; points uniform over triangles and spheres; pdf = choice / area."""
    scene = lights.traced
    count = SAMPLES
    light, again = np.empty(count, np.int64), np.empty(count, np.float32)
    point, normal, offset = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32), np.empty(count)
    run_lights(scene, uniforms(13, 3), light, again, point, normal, offset)
    area = np.array([3.0, 1.5, 4 * math.pi * 0.09, 4 * math.pi * 0.25])
    power = area * np.array([2, 2, 4, 1 / 3])
    choice = power / power.sum()
    assert len(scene.light_pdf) == 4
    np.testing.assert_allclose(scene.light_pdf, choice / area, rtol=1e-5)
    assert p_value(np.bincount(light, minlength=4), count * choice) > sidak(COMPARISONS)
    assert again.min() >= 0 and again.max() < 1
    assert (offset > 0).all()
    corners = lights.data.vertices[lights.data.triangles].astype(np.float64)
    for i in (0, 1):
        here = light == i
        (a, b, c) = corners[i]
        weights = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), (point[here] - a).T, rcond=None)[0]
        rest = np.clip(weights.sum(axis=0), 1e-9, 1)
        assert weights.min() > -1e-6 and np.abs(point[here, 2]).max() < 1e-6
        folded = pair_p_value(np.minimum(rest**2, 1 - 1e-9), np.clip(weights[1] / rest, 0, 1 - 1e-9))
        assert folded > sidak(COMPARISONS)
        np.testing.assert_allclose(normal[here], np.tile([0, 0, 1], (here.sum(), 1)), atol=1e-6)
    for i, (centre, radius) in ((2, ([5, -1, 2], 0.3)), (3, ([9, 0, 0], 0.5))):
        here = light == i
        np.testing.assert_allclose(point[here], centre + radius * normal[here].astype(float), atol=2e-6)
        cells = SphereCells(np.array([0.3, 0.2, 1]), np.linspace(-1, 1, 13))
        counts = cells.counts(naive.unit(normal[here]))
        assert p_value(counts, np.full(counts.shape, here.sum() / counts.size)) > sidak(COMPARISONS)


@pytest.mark.statistical
def test_choice_of_a_light_leaves_a_uniform_number(lights: PreparedScene) -> None:
    u = np.zeros((SAMPLES, 3), np.float32)
    u[:, 2] = (np.arange(SAMPLES) + 0.5) / SAMPLES
    light, again = np.empty(SAMPLES, np.int64), np.empty(SAMPLES, np.float32)
    rest = np.empty((SAMPLES, 3), np.float32)
    run_lights(lights.traced, u, light, again, rest, rest.copy(), np.empty(SAMPLES))
    for i in range(4):  # stratified numbers in, so stratified numbers out, to rounding
        sorted_numbers = np.sort(again[light == i].astype(np.float64))
        ideal = (np.arange(len(sorted_numbers)) + 0.5) / len(sorted_numbers)
        assert np.abs(sorted_numbers - ideal).max() < 2e-5
