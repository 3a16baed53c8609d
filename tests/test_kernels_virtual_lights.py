"""Virtual lights: what is stored, one connection, whole tiles and few lights, each against plain sums in float64."""

import math

import naive
import numba
import numpy as np
import pytest
from rendering import prepare, scene_from
from test_embree import hits, sees

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.estimators import weak_singularities as ws
from causticmpi.estimators.virtual_lights import VirtualLights, empty_virtual_lights, trace_virtual_lights
from causticmpi.kernels import vec
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.emission import natural_emission
from causticmpi.kernels.material_kinds import PHONG

PATHS, BOUND = 40, 0.8
SCENE = """\
camera: {eye: [0, 0, 0.9], target: [0, 0, 0]}
materials:
  white: {type: diffuse, reflectance: [0.8, 0.7, 0.6]}
  gloss: {type: phong, diffuse: [0.3, 0.2, 0.1], specular: [0.4, 0.5, 0.6], exponent: 12}
  mirror: {type: mirror, reflectance: 0.9}
shapes:
  - {type: box, min: [-1, -1, -1], max: [1, 1, 1], material: white}
  - {type: quad, corners: [[-0.9, -0.95, 0.9], [0.9, -0.95, 0.9], [0.9, -0.95, -0.9], [-0.9, -0.95, -0.9]],
     material: gloss}
  - {type: quad, corners: [[-0.3, 0.9, -0.3], [0.3, 0.9, -0.3], [0.3, 0.9, 0.3], [-0.3, 0.9, 0.3]],
     material: white, emission: [5, 4, 3]}
  - {type: sphere, center: [0.4, -0.3, 0], radius: 0.3, material: mirror}
  - {type: sphere, center: [-0.4, -0.4, 0], radius: 0.25, material: gloss}
"""


@numba.njit
def run_connections(scene, lights, count, p, n, offset, wo, material, bound, value, far):
    for j in range(count):
        got, q = ws.connection(scene, lights, j, vec.row(p, 0), vec.row(n, 0), offset, vec.row(wo, 0), material, bound)
        for c in range(3):
            value[j, c], far[j, c] = got[c], q[c]


@numba.njit
def run_tile(scene, packet, lights, count, materials, glossy, bound):
    return ws.gather_tile(scene, packet, lights, count, materials, glossy, bound)


@numba.njit
def run_few(scene, packet, lights, count, few, p, n, offset, wo, material, bound, u):
    total, rays = np.zeros(3), 0
    for i in range(u.shape[0]):
        got, traced = ws.gather_few(
            scene,
            packet,
            lights,
            count,
            few,
            vec.row(p, 0),
            vec.row(n, 0),
            offset,
            vec.row(wo, 0),
            material,
            bound,
            u[i],
        )
        rays += traced
        for c in range(3):
            total[c] += got[c]
    return total / u.shape[0], rays


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> PreparedScene:
    return prepare(scene_from(SCENE, tmp_path_factory.mktemp("room")))


def trace(scene: PreparedScene, capacity: int = 4000, paths: int = PATHS, index: int = 0) -> tuple[VirtualLights, int]:
    lights = empty_virtual_lights(capacity)
    return lights, trace_virtual_lights(scene.traced, ray_buffer(), natural_emission(), 1, index, paths, lights)[0]


class Points:
    """Points seen from the middle of the room, moved off their surfaces: glossy ones alone or Lambertian ones."""

    def __init__(self, scene: PreparedScene, gloss: bool, count: int = 16) -> None:
        generator = np.random.default_rng(4)
        origin, direction = np.tile([0.0, 0.4, 0.5], (4000, 1)), naive.unit(generator.normal(size=(4000, 3)))
        primitive, t = hits(scene.embree, scene.traced.triangle_count, origin, direction)
        material = scene.traced.material[primitive]
        kind = scene.traced.kind[material]
        chosen = np.flatnonzero(kind == PHONG if gloss else kind == 0)[:count]
        p, surface = origin[chosen] + t[chosen, None] * direction[chosen], scene.traced.surface[primitive[chosen]]
        ball = primitive[chosen] >= scene.traced.triangle_count
        n = np.where(ball[:, None], naive.unit(p - surface[:, :3]), surface[:, :3])
        self.n = (n * -np.sign((n * direction[chosen]).sum(axis=1))[:, None]).astype(np.float32)
        self.offset = np.float32(4e-6)
        self.p = (p + self.offset * self.n).astype(np.float32)
        self.wo = -direction[chosen].astype(np.float32)
        self.material = material[chosen].astype(np.int64)


def brdf_of(scene: PreparedScene, material: int, n: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    traced = scene.traced
    exponent = float(traced.exponent[material]) if traced.kind[material] == PHONG else None
    n, wo, wi = (np.asarray(v, np.float64) for v in (n, wo, wi))
    return naive.brdf(traced.reflectance[material], traced.specular[material], exponent, n, wo, wi[None])[0]


def oracle(scene: PreparedScene, lights: VirtualLights, count: int, points: Points, i: int) -> tuple[np.ndarray, ...]:
    """Connections (count, 3) of point i in float64, before visibility, and whether each is visible."""
    value, far = np.zeros((count, 3)), np.zeros((count, 3))
    for j in range(count):
        m = lights.normal[j].astype(np.float64)
        far[j] = lights.point[j] + m * max(lights.offset[j], points.offset)
        d = far[j] - points.p[i]
        wi = d / np.linalg.norm(d)
        f_q, peak, material = np.ones(3), 1.0, lights.material[j]
        if material >= 0 and scene.traced.kind[material] == PHONG:
            f_q = brdf_of(scene, material, m, lights.arrival[j], -wi)
            kd, ks = scene.traced.reflectance[material].max(), scene.traced.specular[material].max()
            peak = max(1, kd + ks * (scene.traced.exponent[material] + 2) / 2)
        f_p = brdf_of(scene, points.material[i], points.n[i], points.wo[i], wi)
        w = naive.connection(f_p, f_q, points.n[i].astype(float), m, d, peak, BOUND)
        value[j] = w * lights.intensity[j]
    return value, sees(scene.embree, np.tile(points.p[i], (count, 1)), far)


def test_what_is_stored(scene: PreparedScene) -> None:
    lights, count = trace(scene)
    emitters = lights.material[:count] == -1
    assert emitters.sum() == PATHS and count > 2 * PATHS
    # The direct lights carry the radiance of the light over their density, shared by the paths: Le A in all.
    np.testing.assert_allclose(lights.intensity[:count][emitters].sum(axis=0), np.array([5, 4, 3]) * 0.36, rtol=1e-4)
    assert (np.abs(lights.point[:count][emitters][:, 1] - 0.9) < 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(lights.normal[:count], axis=1), 1, atol=1e-5)
    kinds = scene.traced.kind[lights.material[:count][~emitters]]
    assert (kinds <= PHONG).all() and set(kinds) == {0, PHONG}
    lit = (lights.normal[:count] * lights.arrival[:count]).sum(axis=1)
    assert (lit[~emitters] > 0).all() and (lights.offset[:count] > 0).all()
    peak = np.where(emitters | (scene.traced.kind[lights.material[:count]] != PHONG), 1, 0.3 + 0.6 * 14 / 2)
    np.testing.assert_allclose(lights.peak[:count], peak, rtol=1e-5)


def test_flux_of_the_first_bounce(scene: PreparedScene) -> None:
    """Radiosity summed over virtual lights is what every surface reflects: bounds from the albedos alone."""
    lights, count = trace(scene, 100_000, 4000)
    lambert = (lights.material[:count] >= 0) & (scene.traced.kind[lights.material[:count]] != PHONG)
    flux = math.pi * lights.intensity[:count][lambert].sum(axis=0, dtype=np.float64)
    source = math.pi * 0.36 * np.array([5, 4, 3])
    assert (flux > 0.3 * source).all() and (flux < source * np.array([4, 7 / 3, 1.5]) * 1.1).all()


@pytest.mark.parametrize("capacity", [0, 1, 37])
def test_small_room_still_counts(scene: PreparedScene, capacity: int) -> None:
    whole, count = trace(scene)
    little, same = trace(scene, capacity)
    assert same == count > capacity
    assert all(np.array_equal(a, b[:capacity]) for a, b in zip(little, whole, strict=True))
    other, _ = trace(scene, index=1)
    assert not np.array_equal(other.point, whole.point)


@pytest.mark.parametrize("gloss", [False, True])
def test_connection_against_oracle(scene: PreparedScene, gloss: bool) -> None:
    lights, count = trace(scene)
    points = Points(scene, gloss, 6)
    bounded = 0
    for i in range(6):
        value, far = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
        rows = (points.p[i : i + 1], points.n[i : i + 1])
        run_connections(
            scene.traced, lights, count, *rows, points.offset, points.wo[i : i + 1], points.material[i],
            np.float32(BOUND), value, far,
        )  # fmt: skip
        expected, _ = oracle(scene, lights, count, points, i)
        np.testing.assert_allclose(value, expected, rtol=2e-4, atol=1e-6 * expected.max())
        bounded += (expected > 0).any()
    assert bounded == 6


@pytest.mark.parametrize("gloss", [False, True])
def test_tile_against_oracle(scene: PreparedScene, gloss: bool) -> None:
    """The packet sums what the scalar sum does, visibility included; lanes out of use stay black."""
    lights, count = trace(scene)
    points = Points(scene, gloss)
    packet = ws.packet_buffer()
    for i in range(16):
        for c in range(3):
            packet[ws.POINT + 16 * c + i] = points.p[i, c]
            packet[ws.NORMAL + 16 * c + i] = points.n[i, c] if i not in (3, 11) else 0
            packet[ws.OUT + 16 * c + i] = points.wo[i, c]
        packet[ws.EPSILON + i] = points.offset
    packet[ws.SUM : ws.SUM + 48] = 99  # what an earlier tile left
    traced = run_tile(scene.traced, packet, lights, count, points.material, gloss, np.float32(BOUND))
    got = packet[ws.SUM : ws.SUM + 48].reshape(3, 16).T.astype(np.float64)
    shadow_rays, hidden = 0, 0
    for i in range(16):
        if i in (3, 11):
            assert (got[i] == 0).all()
            continue
        value, seen = oracle(scene, lights, count, points, i)
        shadow_rays += (value.max(axis=1) > 0).sum()
        hidden += (value[~seen].max(axis=1) > 0).sum()
        f = 1.0 if gloss else scene.traced.reflectance[points.material[i]] / math.pi
        np.testing.assert_allclose(got[i] * f, value[seen].sum(axis=0), rtol=1e-4)
    assert abs(traced - shadow_rays) <= 2 and hidden > 20


@pytest.mark.parametrize("few", [1, 3, 8, 64, 1000])
@pytest.mark.parametrize("gloss", [False, True])
def test_few_lights_estimate_the_sum(scene: PreparedScene, few: int, gloss: bool) -> None:
    """Averaged over evenly spaced random numbers the estimate is the whole sum: it is unbiased."""
    lights, count = trace(scene)
    points = Points(scene, gloss, 1)
    u = ((np.arange(20_000) + 0.5) / 20_000).astype(np.float32)
    mean, rays = run_few(
        scene.traced, ws.packet_buffer(), lights, count, few, points.p, points.n, points.offset, points.wo,
        points.material[0], np.float32(BOUND), u,
    )  # fmt: skip
    value, seen = oracle(scene, lights, count, points, 0)
    np.testing.assert_allclose(mean, value[seen].sum(axis=0), rtol=2e-3)
    assert rays <= len(u) * min(count, few + 1)
