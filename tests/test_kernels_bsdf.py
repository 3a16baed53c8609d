"""Materials against plain oracles: values, energy, reciprocity, samplers against their pdf, Fresnel and Snell."""

import math

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, SphereCells, heights_about_lobe, p_value, sidak

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.material_kinds import DIELECTRIC, DIFFUSE, MIRROR, PHONG
from causticmpi.kernels.traced_scene import TracedScene

MATERIALS = [
    # kind, reflectance, specular, exponent, ior
    (DIFFUSE, (0.7, 0.5, 0.3), (0, 0, 0), 0, 1),
    (PHONG, (0.3, 0.2, 0.1), (0.4, 0.5, 0.6), 0, 1),
    (PHONG, (0.3, 0.2, 0.1), (0.4, 0.5, 0.6), 1, 1),
    (PHONG, (0.3, 0.2, 0.1), (0.4, 0.5, 0.6), 60, 1),
    (PHONG, (0.3, 0.2, 0.1), (0.4, 0.5, 0.6), 1000, 1),
    (PHONG, (0, 0, 0), (1, 1, 1), 0, 1),
    (PHONG, (0, 0, 0), (1, 1, 1), 60, 1),
    (MIRROR, (0.9, 0.8, 0.7), (0, 0, 0), 0, 1),
    (DIELECTRIC, (1, 1, 1), (0, 0, 0), 0, 1.5),
]
ROUGH = range(7)
WHITE_LOBES = (5, 6)
GLASS, SILVER = 8, 7
NORMAL = naive.unit([0.3, -0.5, 0.81]).astype(np.float32)
ANGLES = (0.0, 0.6, 1.2, 1.5)
COMPARISONS = len(ROUGH) * len(ANGLES)


def materials() -> TracedScene:
    """A scene that holds materials alone."""
    empty = {name: np.zeros((1, 4), np.float32) for name in TracedScene._fields}
    kind, kd, ks, exponent, ior = zip(*MATERIALS, strict=True)
    arrays = {
        "handle": 0,
        "triangle_count": 0,
        "kind": np.array(kind, np.int32),
        "reflectance": np.array(kd, np.float32),
        "specular": np.array(ks, np.float32),
        "exponent": np.array(exponent, np.float32),
        "ior": np.array(ior, np.float32),
    }
    return TracedScene(**(empty | arrays))


@numba.njit
def run_samples(scene, material, n, wo, u, wi, weight):
    for i in range(u.shape[0]):
        d, w = bsdf.sample_weight(scene, material, vec.row(n, 0), vec.row(wo, 0), u[i, 0], u[i, 1], u[i, 2])
        for c in range(3):
            wi[i, c], weight[i, c] = d[c], w[c]


@numba.njit
def run_values(scene, material, n, wo, wi, f, pdf):
    """f and pdf of pairs of directions; one row of `wo` serves all."""
    for i in range(wi.shape[0]):
        o = vec.row(wo, min(i, wo.shape[0] - 1))
        value = bsdf.evaluate(scene, material, vec.row(n, 0), o, vec.row(wi, i))
        f[i, 0], f[i, 1], f[i, 2] = value
        pdf[i] = bsdf.pdf(scene, material, vec.row(n, 0), o, vec.row(wi, i))


@numba.njit
def run_specular(scene, material, n, direction, u, out, weight, eta, refracted, chance):
    for i in range(u.shape[0]):
        d, w, eta[i], refracted[i], chance[i] = bsdf.scatter_specular(
            scene, material, vec.row(n, 0), vec.row(direction, i), u[i]
        )
        for c in range(3):
            out[i, c], weight[i, c] = d[c], w[c]


def values(material: int, wo: np.ndarray, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    wi = np.ascontiguousarray(wi, np.float32)
    f, pdf = np.empty((len(wi), 3), np.float32), np.empty(len(wi), np.float32)
    run_values(materials(), material, NORMAL[None], np.atleast_2d(wo).astype(np.float32), wi, f, pdf)
    return f, pdf


def samples(material: int, wo: np.ndarray, count: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    u = np.random.default_rng(material).random((count, 3), np.float32)
    wi, weight = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    run_samples(materials(), material, NORMAL[None], wo[None].astype(np.float32), u, wi, weight)
    return wi, weight


def tilted(angle: float, turn: float = 0.7) -> np.ndarray:
    """Unit direction at `angle` from the normal."""
    frame = SphereCells(NORMAL, np.array([-1.0, 1.0])).frame
    return np.array([math.sin(angle) * math.cos(turn), math.sin(angle) * math.sin(turn), math.cos(angle)]) @ frame


def share_of(material: int) -> float:
    _, kd, ks, *_ = MATERIALS[material]
    return max(ks) / (max(ks) + max(kd))


@pytest.mark.parametrize("material", ROUGH)
def test_values_against_oracle(material: int) -> None:
    generator = np.random.default_rng(1)
    wi = naive.unit(generator.normal(size=(3000, 3)))
    wi *= np.where(wi @ NORMAL < 0, -1, 1)[:, None]
    kind, kd, ks, exponent, _ = MATERIALS[material]
    for angle in ANGLES:
        wo = tilted(angle)
        wi[:500] = naive.unit(naive.mirrored(wo, NORMAL.astype(float)) + 0.03 * generator.normal(size=(500, 3)))
        f, pdf = values(material, wo, wi)
        oracle = naive.brdf(kd, ks, exponent if kind == PHONG else None, NORMAL.astype(float), wo, wi)
        # c^1000 magnifies the rounding of float32 a thousandfold
        np.testing.assert_allclose(f, oracle, rtol=1e-5 + 1e-6 * exponent, atol=1e-6)
        oracle = naive.brdf_pdf(share_of(material), exponent, NORMAL.astype(float), wo, wi)
        np.testing.assert_allclose(pdf, oracle, rtol=1e-5 + 1e-6 * exponent, atol=1e-6)


@pytest.mark.parametrize("material", ROUGH)
def test_reciprocity(material: int) -> None:
    generator = np.random.default_rng(2)
    a, b = (naive.unit(generator.normal(size=(5000, 3))) for _ in range(2))
    a, b = (w * np.where(w @ NORMAL < 0, -1, 1)[:, None] for w in (a, b))
    b[:2000] = naive.unit(naive.mirrored(a[:2000], NORMAL.astype(float)) + 0.1 * generator.normal(size=(2000, 3)))
    forward, back = values(material, a, b)[0], values(material, b, a)[0]
    np.testing.assert_allclose(forward, back, rtol=2e-5 + 1e-6 * MATERIALS[material][3], atol=1e-5)


@pytest.mark.statistical
@pytest.mark.parametrize("material", ROUGH)
@pytest.mark.parametrize("angle", ANGLES)
def test_sample_follows_pdf(material: int, angle: float) -> None:
    """Chi-square over cells about the mirror direction, which the horizon cuts, and the weight is f cos / pdf."""
    wo = tilted(angle)
    wi, weight = samples(material, wo)
    np.testing.assert_allclose(np.linalg.norm(wi, axis=1), 1, atol=1e-5)
    cells = SphereCells(naive.mirrored(wo, NORMAL.astype(float)), heights_about_lobe(MATERIALS[material][3]))
    directions, _ = cells.quadrature(12)
    expected = cells.integrate(values(material, wo, directions)[1], 12)
    assert expected.sum() == pytest.approx(1, abs=1e-3)
    assert p_value(cells.counts(wi), SAMPLES * expected) > sidak(COMPARISONS)
    few = slice(0, 20000)
    f, pdf = values(material, wo, wi[few])
    cosine = (wi[few] @ NORMAL)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = np.where(cosine > 0, f * cosine / pdf[:, None], 0)
    clear = np.abs(cosine[:, 0]) > 1e-4  # at the horizon the sign is rounding
    np.testing.assert_allclose(weight[few][clear], wanted[clear], rtol=2e-4 + 2e-6 * MATERIALS[material][3], atol=1e-6)


@pytest.mark.parametrize("material", ROUGH)
@pytest.mark.parametrize("angle", ANGLES)
def test_energy_is_not_made(material: int, angle: float) -> None:
    """Integral of f cos: at most the albedo, the albedo itself for Lambert and, head on, for the lobe."""
    wo = tilted(angle)
    kind, kd, ks, exponent, _ = MATERIALS[material]
    cells = SphereCells(naive.mirrored(wo, NORMAL.astype(float)), heights_about_lobe(exponent))
    directions, _ = cells.quadrature(12)
    f, _ = values(material, wo, directions)
    reflected = [cells.integrate(f[:, c] * np.maximum(directions @ NORMAL, 0), 12).sum() for c in range(3)]
    assert (np.array(reflected) <= np.array(kd) + np.array(ks) + 1e-3).all()
    if kind == DIFFUSE or angle == 0.0:
        np.testing.assert_allclose(reflected, np.array(kd) + np.array(ks), atol=2e-3)
    _, weight = samples(material, wo)
    error = 6 * weight.std(axis=0, dtype=np.float64) / math.sqrt(SAMPLES) + 2e-3  # the mean weight is the same integral
    assert (np.abs(weight.mean(axis=0, dtype=np.float64) - reflected) < error).all()


def specular(material: int, direction: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, ...]:
    n = len(u)
    direction = np.ascontiguousarray(np.broadcast_to(direction, (n, 3)), np.float32)
    out, weight = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    eta, refracted, chance = np.empty(n, np.float32), np.empty(n, np.bool_), np.empty(n, np.float32)
    choices = u.astype(np.float32)
    run_specular(materials(), material, NORMAL[None], direction, choices, out, weight, eta, refracted, chance)
    return out, weight, eta, refracted, chance


@pytest.mark.parametrize("ratio", [1 / 1.5, 1.5, 1 / 1.01, 2.4])
def test_fresnel_against_oracle(ratio: float) -> None:
    fresnel = numba.njit(lambda cosine, eta: bsdf.fresnel(cosine, eta))
    for angle in np.linspace(0, 1.57, 200):
        reflectance, inner = fresnel(np.float32(math.cos(angle)), np.float32(ratio))
        assert reflectance == pytest.approx(naive.fresnel(float(angle), ratio, 1), abs=2e-4 if ratio > 1 else 2e-5)
        sine = ratio * math.sin(angle)
        assert inner == pytest.approx(math.sqrt(max(0, 1 - sine * sine)), abs=2e-3)
        assert 0 <= reflectance <= 1 + 1e-6
        if sine > 1.0001:
            assert reflectance == 1 and inner == 0  # total internal reflection


@pytest.mark.statistical
@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.4, 0.7, 1.3])
def test_glass_scatters_by_snell_and_fresnel(inside: bool, angle: float) -> None:
    count = 200_000
    direction = -tilted(angle) if not inside else -tilted(math.pi - angle)
    out, weight, eta, refracted, chance = specular(GLASS, direction, np.random.default_rng(5).random(count))
    n_in, n_out = (1.5, 1.0) if inside else (1.0, 1.5)
    n = NORMAL.astype(float)
    reflectance = naive.fresnel(angle, n_in, n_out)
    assert (weight == 1).all()
    assert (eta[~refracted] == 1).all() and np.allclose(eta[refracted], n_in / n_out)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-5)
    assert np.abs(out[~refracted] - (direction - 2 * (direction @ n) * n)).max(initial=0) < 1e-5
    np.testing.assert_allclose(chance, np.where(refracted, 1 - reflectance, reflectance), atol=1e-5)
    share = 1 - refracted.mean()
    if reflectance == 1:
        assert share == 1
        return
    error = math.sqrt(reflectance * (1 - reflectance) / count)
    assert abs(share - reflectance) < 4.5 * error  # two-sided 7e-6 each
    through = out[refracted].astype(float)
    assert (np.sign(through @ n) == np.sign(direction @ n)).all()
    # Snell's law with its plane: n_in sin = n_out sin, and the tangential parts point the same way.
    tangential = n_in * (direction - (direction @ n) * n)
    assert np.abs(n_out * (through - (through @ n)[:, None] * n) - tangential).max() < 2e-5


def test_mirror() -> None:
    direction = -tilted(0.9)
    out, weight, eta, refracted, chance = specular(SILVER, direction, np.linspace(0, 0.999, 50))
    np.testing.assert_allclose(out, np.tile(naive.mirrored(-direction, NORMAL.astype(float)), (50, 1)), atol=1e-6)
    assert np.allclose(weight, [0.9, 0.8, 0.7]) and (eta == 1).all() and not refracted.any()
    assert (chance == 1).all()
