"""The curvature of wavefronts against rays traced one by one in float64, and what photons say of those beside them."""

from typing import NamedTuple

import naive
import numba
import numpy as np
import pytest
from chi_square import perpendicular
from rendering import prepare, scene_from
from scipy.spatial import cKDTree
from test_embree import hits
from test_kernels_photons import periscope
from test_parallax import ENTRY, naive_turned

from causticmpi.kernels import wavefront
from causticmpi.preprocess.photons import shoot_photons

IOR = 1.5
SMALL = 1e-5
"""Step of the finite differences: their error is near 1e-10."""


class Event(NamedTuple):
    """What happens to a ray at a surface: a mirror or not; eta: ratio of indices; again: on the sphere before, from
    inside; radius: of a new sphere, infinite for a plane."""

    mirror: bool
    eta: float = 1.0
    radius: float = np.inf
    again: bool = False


class Surface(NamedTuple):
    """A sphere, or a plane through `place` with normal `normal`, which is a sphere's at the middle ray."""

    place: np.ndarray
    normal: np.ndarray
    radius: float


MIRROR_BALL, FLAT_MIRROR = [Event(True, radius=0.7)], [Event(True)]
GLASS_BALL = [Event(False, 1 / IOR, 0.4), Event(False, IOR, again=True)]
RAINBOW = [Event(False, 1 / IOR, 0.4), Event(True, again=True), Event(False, IOR, again=True)]
INTO_GLASS, PANE = [Event(False, 1 / IOR)], [Event(False, 1 / IOR), Event(False, IOR)]
CHAINS = {
    "mirror ball": MIRROR_BALL,
    "into a glass ball": GLASS_BALL[:1],
    "glass ball": GLASS_BALL,
    "rainbow": RAINBOW,
    "flat mirror": FLAT_MIRROR,
    "into glass": INTO_GLASS,
    "pane": PANE,
    "two mirror balls": 2 * MIRROR_BALL,
    "flat mirror, mirror ball": FLAT_MIRROR + MIRROR_BALL,
    "glass ball, flat mirror": GLASS_BALL + FLAT_MIRROR,
    "pane, glass ball": PANE + GLASS_BALL,
    "mirror ball, glass ball": MIRROR_BALL + GLASS_BALL,
    "rainbow, mirror ball": RAINBOW + MIRROR_BALL,
    "two flat mirrors": 2 * FLAT_MIRROR,
}


def meet(surface: Surface, p: np.ndarray, d: np.ndarray, far: bool) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray meets a surface, a sphere for the second time if `far`, and the normal there, outwards."""
    if np.isinf(surface.radius):
        return p + d * ((surface.place - p) @ surface.normal) / (d @ surface.normal), surface.normal
    centre = surface.place - surface.radius * surface.normal
    b, c = d @ (p - centre), (p - centre) @ (p - centre) - surface.radius**2
    t = -b + (1 if far else -1) * np.sqrt(b * b - c)
    hit = p + t * d
    return hit, (hit - centre) / surface.radius


def sent(event: Event, d: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Mirrored, or refracted by Snell's law: the part across the normal is eta times as long."""
    if event.mirror:
        return d - 2 * (d @ n) * n
    across = event.eta * (d - (d @ n) * n)
    return across + np.sign(d @ n) * np.sqrt(1 - across @ across) * n


def trace(surfaces: list[Surface], events: list[Event], p: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point of the ray behind the last surface, and its direction."""
    for surface, event in zip(surfaces, events, strict=True):
        p, n = meet(surface, p, d, event.again)
        d = sent(event, d, n)
    return p, d


class Chain(NamedTuple):
    """The middle ray of a chain: directions (k + 1, 3), lengths (k + 1,), normals (k, 3), curvatures of surfaces (k,),
    its surfaces and first point."""

    direction: np.ndarray
    length: np.ndarray
    normal: np.ndarray
    round_: np.ndarray
    surfaces: list[Surface]
    start: np.ndarray


def random_chain(events: list[Event], last: float, generator: np.random.Generator) -> Chain:
    """Surfaces put in the way of a ray one by one, at angles below 60 degrees; it ends `last` behind the last."""
    start = p = generator.normal(size=3)
    d = naive.unit(generator.normal(size=3))
    surfaces, directions, lengths, normals, rounds = [], [d], [], [], []
    for event in events:
        if event.again:
            hit, n = meet(surfaces[-1], p, d, True)
            surfaces.append(surfaces[-1])
        else:
            hit = p + generator.uniform(0.3, 1.5) * d
            slant = np.radians(generator.uniform(0, 60 if event.eta <= 1 else 35))
            n = -np.cos(slant) * d + np.sin(slant) * naive.unit(np.cross(d, generator.normal(size=3)))
            surfaces.append(Surface(hit, n, event.radius))
        lengths.append(np.linalg.norm(hit - p))
        normals.append(n)
        rounds.append(1 / surfaces[-1].radius)
        p, d = hit, sent(event, d, n)
        directions.append(d)
    lengths.append(last)
    return Chain(*(np.array(a) for a in (directions, lengths, normals, rounds)), surfaces, start)


def naive_curvature(events: list[Event], chain: Chain) -> np.ndarray:
    """(3, 3): the derivative of direction by place across the end of the middle ray, by rays a little aside."""
    p, d = trace(chain.surfaces, events, chain.start, chain.direction[0])
    end = p + chain.length[-1] * d
    across = np.stack(perpendicular(d))
    places, directions = [], []
    for tangent in perpendicular(chain.direction[0]):
        rays = []
        for sign in (1, -1):
            q, e = trace(chain.surfaces, events, chain.start, naive.unit(chain.direction[0] + sign * SMALL * tangent))
            rays.append((q + e * ((end - q) @ d) / (e @ d), e))
        places.append(across @ (rays[0][0] - rays[1][0]) / (2 * SMALL))
        directions.append(across @ (rays[0][1] - rays[1][1]) / (2 * SMALL))
    flat = np.array(directions).T @ np.linalg.inv(np.array(places).T)
    assert np.abs(flat - flat.T).max() < 1e-6 * max(1, np.abs(flat).max())  # Malus and Dupin
    return across.T @ flat @ across


@numba.njit
def run_chain(direction, length, normal, eta, round_, out):
    d = (direction[0, 0], direction[0, 1], direction[0, 2])
    m = wavefront.from_point(d, length[0])
    for i in range(len(eta)):
        after = (direction[i + 1, 0], direction[i + 1, 1], direction[i + 1, 2])
        n = (normal[i, 0], normal[i, 1], normal[i, 2])
        m = wavefront.spread(wavefront.bent(m, d, after, n, eta[i], round_[i]), after, length[i + 1])
        d = after
    for k in range(6):
        out[k] = m[k]


def curvature(events: list[Event], chain: Chain, kind: type) -> np.ndarray:
    """(3, 3), by the kernels in numbers of a kind."""
    out = np.zeros(6, kind)
    eta = np.array([event.eta for event in events], kind)
    arrays = (np.ascontiguousarray(a, kind) for a in (chain.direction, chain.length, chain.normal))
    run_chain(*arrays, eta, chain.round_.astype(kind), out)
    return out[ENTRY]


@pytest.mark.parametrize("last", [0.0, 1.3])
@pytest.mark.parametrize("name", CHAINS)
def test_against_rays_traced_one_by_one(name: str, last: float) -> None:
    events, compared = CHAINS[name], 0
    for seed in range(30):
        chain = random_chain(events, last, np.random.default_rng(seed))
        if np.isnan(chain.direction).any():  # total reflection in the glass
            continue
        expected = naive_curvature(events, chain)
        size = np.abs(expected).max()
        if size > 100:  # next to a focus
            continue
        compared += 1
        found = curvature(events, chain, np.float64)
        np.testing.assert_allclose(found, expected, atol=1e-5 * size)
        assert np.abs(found @ chain.direction[-1]).max() < 1e-9 * size
        np.testing.assert_allclose(curvature(events, chain, np.float32), expected, atol=2e-3 * size)
    assert compared >= 20


def test_a_flat_mirror_shows_the_light_behind_it() -> None:
    chain = random_chain(FLAT_MIRROR, 0.8, np.random.default_rng(1))
    d = chain.direction[-1]
    np.testing.assert_allclose(
        curvature(FLAT_MIRROR, chain, np.float64), (np.eye(3) - np.outer(d, d)) / chain.length.sum(), atol=1e-12
    )


def test_which_way_a_normal_points_does_not_matter() -> None:
    """A surface bends the other way seen from its other side."""
    for events in (MIRROR_BALL, GLASS_BALL[:1], PANE):
        chain = random_chain(events, 0.5, np.random.default_rng(2))
        turned = chain._replace(normal=-chain.normal, round_=-chain.round_)
        one, other = (curvature(events, c, np.float64) for c in (chain, turned))
        np.testing.assert_allclose(one, other, atol=1e-12)


@numba.njit
def run_focus(focus, across, t, out):
    d, n = (np.float32(0), np.float32(0), np.float32(1)), (np.float32(1), np.float32(0), across)
    z = np.float32(0)
    k = -np.float32(1) / focus
    m = wavefront.spread((k, z, z, k, z, z), d, t)
    for i in range(6):
        out[0, i] = m[i]
    b = wavefront.bent(m, d, (np.float32(0), np.float32(0), np.float32(1)), n, np.float32(1), np.float32(2))
    b = wavefront.spread(b, d, np.float32(1))
    for i in range(6):
        out[1, i] = b[i]


@pytest.mark.parametrize("across", [0.0, 1e-30, -1e-30, 1e-7, -1e-4, 0.5])
@pytest.mark.parametrize("focus", [0.5, 0.5000001, 0.5001, 1.0])
def test_focus_and_grazing_are_finite(focus: float, across: float) -> None:
    """At a focus, and at a surface that the ray only grazes, behind one or not."""
    out = np.full((2, 6), np.nan, np.float32)
    run_focus(np.float32(focus), np.float32(across), np.float32(0.5), out)
    assert np.isfinite(out).all()


@numba.njit
def run_touching(t, out):
    d, z, one = (np.float32(0), np.float32(0), np.float32(1)), np.float32(0), np.float32(1)
    m = wavefront.from_point(d, t)
    for k in range(6):
        out[0, k] = m[k]
    m = wavefront.spread(wavefront.bent(m, d, d, (z, z, one), one, np.float32(10)), d, t)
    for k in range(6):
        out[1, k] = m[k]


@pytest.mark.parametrize("t", [0.0, 1e-38, 1e-9])
def test_light_from_a_surface_that_touches_another_is_finite(t: float) -> None:
    out = np.full((2, 6), np.nan, np.float32)
    run_touching(np.float32(t), out)
    assert np.isfinite(out).all() and (out[:, 0] > 1e6).all()


ROOM = """\
camera: {eye: [0, 1, 4], target: [0, 0, 0]}
materials:
  black: {type: diffuse, reflectance: 0}
  mirror: {type: mirror, reflectance: 0.9}
  glass: {type: dielectric, ior: 1.5}
shapes:
  - {type: quad, corners: [[-3, 0, 3], [3, 0, 3], [3, 0, -3], [-3, 0, -3]], material: black}
  - {type: sphere, center: [0.8, 0.5, 0], radius: 0.4, material: mirror}
  - {type: sphere, center: [-0.8, 0.6, 0], radius: 0.4, material: glass}
  - {type: quad, corners: [[-0.3, 0.2, -0.8], [0.3, 0.2, -0.8], [0.3, 0.9, -1.0], [-0.3, 0.9, -1.0]], material: mirror}
  - type: quad
    corners: [[-0.0005, 2, 0.0005], [-0.0005, 2, -0.0005], [0.0005, 2, -0.0005], [0.0005, 2, 0.0005]]
    material: black
    emission: [30, 20, 10]
"""
"""A lamp as small as a point, and a floor that sends nothing on: all photons are L S+ D."""
BETTER = {"mirror ball": (40, 40), "glass ball": (5, 2), "flat mirror": (5, 5)}
"""How many times better turned directions tell that of the photon beside them, at least: in the best tenth and in the
median. Flat mirrors: as the lamp is no point. Glass: there light comes by several ways, and the photon beside may have
come by another."""


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.minimum(1, np.linalg.norm(naive.unit(a) - naive.unit(b), axis=1) / 2)))


def test_photons_tell_the_directions_beside_them(tmp_path) -> None:
    scene = prepare(scene_from(ROOM, tmp_path))
    points, _, _ = shoot_photons(scene.traced, 3, 60_000)
    floor = points.position[:, 1] < 1e-3
    triangles = len(scene.data.triangles)
    back, _ = hits(scene.embree, triangles, points.position + 1e-5 * points.normal, points.direction)
    assert np.isfinite(points.curvature).all()
    along = np.einsum("nij,nj->ni", points.curvature.astype(np.float64)[:, ENTRY], points.direction)
    size = np.abs(points.curvature).max(axis=1)
    assert np.quantile(np.abs(along).max(axis=1) / size, 0.99) < 1e-3
    for name, what in {"mirror ball": [triangles], "glass ball": [triangles + 1], "flat mirror": [2, 3]}.items():
        these = np.flatnonzero(floor & np.isin(back, what))
        place = points.position[these].astype(np.float64)
        _, near = cKDTree(place).query(place, k=2)
        step = place[near[:, 1]] - place
        own, there = points.direction[these].astype(np.float64), points.direction[these[near[:, 1]]]
        unturned = degrees(own, there)
        turned = degrees(naive_turned(own, points.curvature[these], step), there)
        for share, better in zip((0.1, 0.5), BETTER[name], strict=True):
            apart, left = np.quantile(unturned, share), np.quantile(turned, share)
            print(f"\n{name}, {len(these)} photons, {share}: {apart:.4f} degrees apart, turned {left:.4f}")
            assert better * left < apart
    scene.embree.close()


def test_light_from_a_diffuse_surface_comes_from_a_point(tmp_path) -> None:
    """A lamp and a white floor below a mirror: their images are where the curvature puts them."""
    scene = periscope(tmp_path, 0.5)
    points, _, _ = shoot_photons(scene.traced, 1, 30_000)
    p, d = points.position.astype(np.float64), points.direction.astype(np.float64)
    matrix = points.curvature.astype(np.float64)[:, ENTRY]
    far = 2 / np.trace(matrix, axis1=1, axis2=2)
    near = far < 6
    flat = (np.eye(3) - d[:, :, None] * d[:, None]) / far[:, None, None]
    np.testing.assert_allclose(matrix[near], flat[near], atol=1e-4)
    height = (p + d * far[:, None])[near, 1]
    # Rays begin a little off the surfaces of a scene so large.
    lamp, floor = np.abs(height - 1.5) < 5e-3, np.abs(height - 2) < 5e-3
    assert (lamp | floor).all() and lamp.sum() > 5000 and floor.sum() > 1000
    scene.embree.close()
