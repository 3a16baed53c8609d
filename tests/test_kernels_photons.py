"""Forecast photons: where they lie, where they came from, how much power they carry."""

import math

import naive
import numba
import numpy as np
import pytest
from rendering import REPOSITORY, prepare, scene_from
from test_embree import hits

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.kernels import bsdf, particles, rng, vec
from causticmpi.kernels.aim import NATURAL, emission
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.particle_waves import GROUP
from causticmpi.kernels.traced_scene import hit_point, is_specular, light_point, pick_light
from causticmpi.preprocess import photons
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
    return shoot_photons(scene.traced, seed, count)


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


# All materials, and lights of both kinds.
MIXED = """\
camera: {eye: [0, 1, 4], target: [0, 0, 0]}
materials:
  white: {type: diffuse, reflectance: [0.7, 0.8, 0.6]}
  gloss: {type: phong, diffuse: 0.3, specular: 0.4, exponent: 30}
  mirror: {type: mirror, reflectance: 0.9}
  glass: {type: dielectric, ior: 1.5}
  black: {type: diffuse, reflectance: 0}
shapes:
  - {type: quad, corners: [[-2, 0, 2], [0, 0, 2], [0, 0, -2], [-2, 0, -2]], material: white}
  - {type: quad, corners: [[0, 0, 2], [2, 0, 2], [2, 0, -2], [0, 0, -2]], material: gloss}
  - {type: quad, corners: [[-2, 0, -2], [2, 0, -2], [2, 3, -2], [-2, 3, -2]], material: white}
  - {type: sphere, center: [0.6, 0.5, 0], radius: 0.4, material: mirror}
  - {type: sphere, center: [-0.6, 0.5, 0], radius: 0.4, material: glass}
  - {type: sphere, center: [1, 2, 0], radius: 0.2, material: black, emission: 30}
  - type: quad
    corners: [[-1, 2, 0.2], [-1, 2, -0.2], [-0.6, 2, -0.2], [-0.6, 2, 0.2]]
    material: black
    emission: [30, 20, 10]
"""


@numba.njit
def tell_chain(scene, shape, rays, origin, direction, key, told):
    """The events of a flight of `particles.walk_to_surface`: twice the shape, and 1 more if it reflects; -1 behind
    the last."""
    told[:] = -1
    for event in range(len(told)):
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, vec.INFINITY)
        if primitive < 0:
            return
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        material = scene.material[primitive]
        if not is_specular(scene.kind[material]):
            return
        choice, _ = rng.uniform2(key, event)
        out, _, _, _, _ = bsdf.scatter_specular(scene, material, n, direction, choice)
        image = vec.sub(direction, vec.scale(n, 2 * vec.dot(n, direction)))
        told[event] = 2 * shape[primitive] + (vec.dot(image, out) > 1 - 1e-5)
        origin = vec.along(p, n, offset if vec.dot(out, n) > 0 else -offset)
        direction = out


@numba.njit
def shoot_one_by_one(scene, shape, rays, seed, aim, found, chain):
    """Caustic points by the walk of `particles`: position, normal, direction, power; chain (n, 1 + most events): the
    first entry is 0 if it starts at the light. Returns (emitted, rays)."""
    stored, particle, traced = 0, 0, 0
    while stored < len(found):
        key = rng.make_key(seed, rng.PHOTON, 0, particle)
        u, v = rng.uniform2(key, particles.EMIT_POINT)
        w, choice = rng.uniform2(key, particles.EMIT_CHOICE)
        light, _ = pick_light(scene, u)
        p, n, offset = light_point(scene, light, w, v)
        u, v = rng.uniform2(key, particles.EMIT_DIRECTION)
        direction, weight = emission(aim, p, n, choice, u, v)
        flux = vec.scale(vec.row(scene.light_radiance, light), weight / scene.light_pdf[light])
        origin = vec.along(p, n, offset)
        bounce = 0
        while vec.max3(flux) > 0:
            told = chain[min(stored, len(found) - 1)]
            if stored < len(found):
                told[0] = min(bounce, 1)
                chain_key = rng.subkey(rng.subkey(key, bounce), 1)
                tell_chain(scene, shape, rays, origin, direction, chain_key, told[1:])
            u, v = particles.scatter_uniforms(key, bounce)
            at, origin, direction, flux, more = particles.next_vertex(
                scene, rays, origin, direction, flux, key, bounce, u, v
            )
            traced += more
            bounce += 1
            if at.primitive >= 0 and at.events > 0 and stored < len(found):
                for c in range(3):
                    found[stored, 0, c], found[stored, 1, c] = at.p[c], at.n[c]
                    found[stored, 2, c], found[stored, 3, c] = at.back[c], at.flux[c]
                stored += 1
        particle += 1
    return particle, traced


@pytest.mark.parametrize("aim", [NATURAL, np.float32([-1, 0.1, -0.4, -0.2, 0.9, 0.4, 0.7])])
def test_waves_are_particles_one_by_one(tmp_path, aim: np.ndarray) -> None:
    """Same points in the same order, until rounding sends a path elsewhere."""
    scene = prepare(scene_from(MIXED, tmp_path))
    found, chain = np.zeros((3000, 4, 3), np.float32), np.zeros((3000, 2), np.int64)
    emitted, traced = shoot_one_by_one(scene.traced, scene.data.primitive_shape, ray_buffer(), 5, aim, found, chain)
    points, emitted_in_waves, traced_in_waves = shoot_photons(scene.traced, 5, len(found), aim)
    assert abs(emitted - emitted_in_waves) <= 5
    assert 0.99 * traced < traced_in_waves < 1.02 * traced + 8 * GROUP  # the last group is traced to its end
    scale = np.abs(found).max(axis=(0, 2))
    differs = (np.abs(np.stack(points[:4], axis=1) - found) > 1e-3 * scale[:, None]).any(axis=(1, 2))
    assert differs.mean() < 0.01, differs.nonzero()
    scene.embree.close()


SPECULAR = """\
  - {type: box, min: [-0.2, 0.1, 0.8], max: [0.2, 0.5, 1.2], material: glass}
  - {type: quad, corners: [[-2, 0, 2], [-2, 0, -2], [-2, 2, -2], [-2, 2, 2]], material: mirror}
  - {type: quad, corners: [[-0.4, 1, 1], [0.4, 1, 1], [0.4, 1.2, -1], [-0.4, 1.2, -1]], material: glass}
"""


def test_chains_have_the_same_name_if_they_are_the_same(tmp_path) -> None:
    """And only then: begun at a light or not, by the same shapes in turn, reflected or let through alike."""
    scene = prepare(scene_from(MIXED + SPECULAR, tmp_path))
    found, chain = np.zeros((20_000, 4, 3), np.float32), np.zeros((20_000, 41), np.int64)
    shape = scene.data.primitive_shape
    shoot_one_by_one(scene.traced, shape, ray_buffer(), 5, NATURAL, found, chain)
    points, _, _ = shoot_photons(scene.traced, 5, len(found))
    alike = (np.abs(points.position - found[:, 0]) < 1e-3).all(axis=1)
    assert alike.mean() > 0.95
    names, chains = points.chain[alike].tolist(), [tuple(c[c >= 0].tolist()) for c in chain[alike]]
    told, different = set(zip(names, chains, strict=True)), set(chains)
    assert len(set(names)) == len(different) == len(told) > 100
    # There are chains that differ in nothing but where they begin, what happens last, or the order.
    assert any((1, *c[1:]) in different for c in different if c[0] == 0)
    assert any((*c[:-1], c[-1] + 1) in different for c in different if c[-1] % 2 == 0)
    assert any((c[0], *c[:0:-1]) in different for c in different if c[1:] != c[:0:-1])
    scene.embree.close()


def test_a_group_with_more_points_than_there_is_room_for(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rooms = periscope(tmp_path), []
    right, emitted, traced = shoot(scene, 3000)
    make = photons._room
    monkeypatch.setattr(photons, "_room", lambda n: rooms.append(n) or make(n if len(rooms) > 1 else 7))
    again, emitted_again, traced_again = shoot(scene, 3000)
    assert len(rooms) == 2 and emitted_again == emitted and traced_again > traced
    assert all(np.array_equal(a, b) for a, b in zip(right, again, strict=True))


def test_same_seed_same_points(tmp_path) -> None:
    scene = periscope(tmp_path)
    a, b, c = shoot(scene, 500)[0], shoot(scene, 1000)[0], shoot(scene, 500, seed=2)[0]
    assert all(np.array_equal(x, y[:500]) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a.position, c.position)
