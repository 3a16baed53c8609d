"""Forecast photons: where they lie, where they came from, how much power they carry."""

import math

import naive
import numpy as np
import pytest
from rendering import REPOSITORY, prepare, scene_from
from test_embree import hits

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.preprocess.photons import MOST_PARTICLES_PER_PHOTON, CausticPoints, shoot_photons
from causticmpi.scene.load import load_scene

SIZE, HALF = 1e3, 0.05
PERISCOPE = f"""\
camera: {{eye: [0, 0.5, 4], target: [0, 0, 0]}}
materials:
  black: {{type: diffuse, reflectance: 0}}
  floor: {{type: diffuse, reflectance: FLOOR}}
  CEILING
shapes:
  - {{type: quad, corners: [[-{HALF}, 0.5, -{HALF}], [-{HALF}, 0.5, {HALF}], [{HALF}, 0.5, {HALF}],
     [{HALF}, 0.5, -{HALF}]], material: black, emission: [4, 2, 1]}}
  - {{type: quad, corners: [[-{SIZE}, 0, {SIZE}], [{SIZE}, 0, {SIZE}], [{SIZE}, 0, -{SIZE}], [-{SIZE}, 0, -{SIZE}]],
     material: floor}}
  - {{type: quad, corners: [[-{SIZE}, 1, -{SIZE}], [{SIZE}, 1, -{SIZE}], [{SIZE}, 1, {SIZE}], [-{SIZE}, 1, {SIZE}]],
     material: ceiling}}
"""
"""A lamp that shines up at a mirror; its image 1.5 above the floor lights the floor."""
SILVER, CHALK = "ceiling: {type: mirror, reflectance: [0.9, 0.5, 0]}", "ceiling: {type: diffuse, reflectance: 0.5}"
FLUX = math.pi * np.array([4, 2, 1]) * (2 * HALF) ** 2


def periscope(folder, floor: float = 0, ceiling: str = SILVER) -> PreparedScene:
    return prepare(scene_from(PERISCOPE.replace("FLOOR", str(floor)).replace("CEILING", ceiling), folder))


def shoot(scene: PreparedScene, count: int, seed: int = 1) -> tuple[CausticPoints, int, int]:
    return shoot_photons(scene.traced, ray_buffer(), seed, count)


@pytest.mark.statistical
def test_known_answer(tmp_path) -> None:
    """All light reaches the floor by way of the mirror: its flux, and its spread about the image of the lamp."""
    points, emitted, traced = shoot(periscope(tmp_path), 100_000)
    assert len(points.power) == 100_000 and traced >= 2 * emitted
    assert emitted == pytest.approx(100_000, abs=20)  # nearly none is lost over the rim
    np.testing.assert_allclose(points.power.sum(axis=0, dtype=np.float64) / emitted, FLUX * [0.9, 0.5, 0], rtol=3e-4)
    floor = points.position[:, 1] < 0.1
    assert np.abs(points.position[floor, 1]).max() < 1e-3
    assert (np.abs(points.position[~floor, 1] - 0.5) < 1e-5).all()  # on the back of the lamp
    assert np.abs(points.normal[floor] - [0, 1, 0]).max() < 1e-6
    # Seen from the floor, the direction back points at the image of the lamp.
    near = floor & (np.abs(points.position[:, [0, 2]]).max(axis=1) < 5)
    p, d = points.position[near].astype(np.float64), points.direction[near].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-5)
    image = p + d * ((1.5 - p[:, 1]) / d[:, 1])[:, None]
    assert np.abs(image[:, [0, 2]]).max() < HALF + 2e-2 and np.abs(np.mean(image[:, [0, 2]], axis=0)).max() < 1e-3
    # Share of the flux within radius r of a cosine emitter at height h: r^2 / (r^2 + h^2).
    radius = np.linalg.norm(points.position[floor][:, [0, 2]].astype(np.float64), axis=1)
    for r in (0.5, 1.0, 1.5, 3.0, 10.0):
        share = r * r / (r * r + 1.5**2)
        lamp = (~floor).sum() / len(floor)  # taken from the middle by the lamp's back
        assert abs((radius < r).sum() / len(floor) + lamp - share) < 4 * math.sqrt(share * (1 - share) / 1e5) + 5e-4


def test_points_after_the_first_bounce(tmp_path) -> None:
    """A white floor sends light up again: the mirror throws it back, rho times less each time round."""
    points, emitted, _ = shoot(periscope(tmp_path, 0.5), 200_000)
    total = points.power.sum(axis=0, dtype=np.float64) / emitted
    gain = np.array([0.9, 0.5, 0]) / (1 - 0.5 * np.array([0.9, 0.5, 0]))  # rho + rho a rho + …, lamp aside
    np.testing.assert_allclose(total, FLUX * gain, rtol=0.02)


def test_none_without_a_specular_surface(tmp_path) -> None:
    points, emitted, _ = shoot(periscope(tmp_path, 0.5, CHALK), 50)
    assert len(points.power) == 0 and emitted == 50 * MOST_PARTICLES_PER_PHOTON


def test_cornell() -> None:
    """Every point lies on a non-specular surface, on its lit side, and looks back at a specular one."""
    scene = prepare(load_scene(REPOSITORY / "scenes" / "cornell.yaml"))
    points, emitted, _ = shoot(scene, 30_000)
    assert len(points.power) == 30_000 < emitted and (points.power >= 0).all() and (points.power.max(axis=1) > 0).all()
    cosine = (points.normal * points.direction).sum(axis=1)
    assert cosine.min() > 0
    np.testing.assert_allclose(np.linalg.norm(points.direction, axis=1), 1, atol=1e-5)
    kind = scene.data.material_kind[scene.data.primitive_material]
    triangles = len(scene.data.triangles)
    below, _ = hits(scene.embree, triangles, points.position + 1e-5 * points.normal, -points.normal)
    back, _ = hits(scene.embree, triangles, points.position + 2e-6 * points.normal, points.direction)
    clear = cosine > 0.02
    assert (kind[below] < MIRROR).mean() > 0.9995 and (kind[back[clear]] >= MIRROR).mean() > 0.9995
    assert {6, 7} <= set(np.unique(back[clear] - triangles + 6))  # by way of both spheres
    distance, _ = naive.intersect(
        scene.data.vertices[scene.data.triangles],
        scene.data.spheres,
        points.position[:500] + 1e-3 * points.normal[:500],
        -points.normal[:500].astype(np.float64),
    )
    assert np.abs(distance[:, :triangles].min(axis=1) - 1e-3).max() < 1e-5
    scene.embree.close()


def test_same_seed_same_points(tmp_path) -> None:
    scene = periscope(tmp_path)
    a, b, c = shoot(scene, 500)[0], shoot(scene, 1000)[0], shoot(scene, 500, seed=2)[0]
    assert all(np.array_equal(x, y[:500]) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a.position, c.position)
