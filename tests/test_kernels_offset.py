"""Rays that leave a surface: never back into it, never through the wall of a closed scene, at any scale or place.

Tolerances found: at scales 1e-3, 1 and 1e5 about the origin no ray in 10^6 goes wrong. In a scene moved by 100 times
its size no ray hits the surface it left, and 2 in 10^6, which start within rounding of an edge, get out.
"""

import numba
import numpy as np
import pytest
from rendering import prepare, scene_from
from test_embree import hits

from causticmpi.distributed.prepare import PreparedScene
from causticmpi.kernels import rng, vec, warp
from causticmpi.kernels.embree import EmbreeScene, intersect, ray_buffer
from causticmpi.kernels.eye_path import facing
from causticmpi.kernels.traced_scene import hit_point
from causticmpi.kernels.vec import INFINITY, ZERO

STEPS = 1_000_000
TEXT = """\
camera: {{eye: [0, 0, 4], target: [0, 0, 0]}}
materials: {{grey: {{type: diffuse, reflectance: 0.5}}}}
shapes:
  - {{type: box, min: [{a[0]}, {a[1]}, {a[2]}], max: [{b[0]}, {b[1]}, {b[2]}], material: grey, emission: 1}}
  - {{type: sphere, center: [{c[0]}, {c[1]}, {c[2]}], radius: {r}, material: grey}}
"""


@numba.njit
def run_walk(scene, rays, start, steps):
    """Bounce about by uniform directions above each surface. Returns steps that left the scene, and that hit the same
    triangle, or the same sphere from outside, at once."""
    escaped, again, hits = 0, 0, 0
    origin, last = vec.row(start, 0), np.int64(-1)
    n = (ZERO, ZERO, ZERO)
    for i in range(steps):
        key = rng.make_key(1, rng.CAMERA, 0, i)
        u, v = rng.uniform2(key, 0)
        direction = warp.uniform_sphere(u, v)
        if vec.dot(direction, n) < ZERO:
            direction = vec.neg(direction)
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        if primitive < 0:
            escaped += 1
            origin, last, n = vec.row(start, 0), np.int64(-1), (ZERO, ZERO, ZERO)
            continue
        hits += 1
        again += primitive == last
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        n = facing(n, direction)
        origin = vec.along(p, n, offset)
        last = primitive
    return escaped, again, hits


@numba.njit
def run_into_sphere(scene, rays, ball, start, ratio, slant):
    """Rays from `start` that hit the sphere go on inside it, from a point below its surface, then once more.

    ratio, slant (steps, 2): the chords found over those from the surface itself (1 is right, 0 is acne, -1 a miss or
    another surface), and the cosine of the ray with the surface. Returns the rows filled.
    """
    s = scene.surface[ball]
    radius = s[3]
    centre = (s[0], s[1], s[2])
    found = 0
    for i in range(ratio.shape[0]):
        key = rng.make_key(2, rng.CAMERA, 0, i)
        u, v = rng.uniform2(key, 0)
        origin = vec.row(start, 0)
        toward = vec.along(centre, warp.uniform_sphere(u, v), radius)
        direction = vec.normalize(vec.sub(toward, origin))
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
        if primitive != ball:
            continue
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        for k in range(2):
            inward = vec.neg(n)
            u, v = rng.uniform2(key, 1 + k)
            direction = vec.to_world(warp.cosine_hemisphere(u, v), inward)
            origin = vec.along(p, inward, offset)
            primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
            slant[found, k] = vec.dot(direction, inward)
            ratio[found, k] = t / (vec.TWO * radius * slant[found, k]) if primitive == ball else np.float32(-1)
            if primitive != ball:
                break
            p, n, offset = hit_point(scene, primitive, origin, direction, t)
        found += 1
    return found


def scene_at(folder, scale: float, shift: float) -> PreparedScene:
    centre = scale * np.array([shift, -0.7 * shift, 0.3 * shift])
    numbers = {"a": centre - scale, "b": centre + scale, "c": centre + scale * np.array([0.2, 0.1, -0.3])}
    lists = {k: [float(x) for x in v] for k, v in numbers.items()}
    return prepare(scene_from(TEXT.format(**lists, r=0.5 * scale), folder))


def start_of(scene: PreparedScene) -> np.ndarray:
    low, high = (f(scene.data.vertices, axis=0).astype(np.float64) for f in (np.min, np.max))
    return (low + 0.05 * (high - low))[None].astype(np.float32)


PLACES = [
    (1e-3, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (1e5, 0.0, 0.0),
    (1e-3, 100.0, 1e-5),
    (1.0, 100.0, 1e-5),
    (1e5, 100.0, 1e-5),
]


@pytest.mark.parametrize(("scale", "shift", "leaks"), PLACES)
def test_no_acne_and_no_leak(tmp_path, scale: float, shift: float, leaks: float) -> None:
    scene = scene_at(tmp_path, scale, shift)
    escaped, again, hits = run_walk(scene.traced, ray_buffer(), start_of(scene), STEPS)
    assert again == 0
    assert escaped <= leaks * STEPS and hits > 0.99 * STEPS
    scene.embree.close()


@pytest.mark.parametrize(("scale", "shift", "leaks"), PLACES)
def test_inside_of_a_sphere(tmp_path, scale: float, shift: float, leaks: float) -> None:
    """A ray that enters a sphere crosses it: the next hit is the far side, a chord away."""
    scene = scene_at(tmp_path, scale, shift)
    ratio, slant = np.ones((2, 100_000, 2), np.float32)
    ball = scene.traced.triangle_count
    found = run_into_sphere(scene.traced, ray_buffer(), ball, start_of(scene), ratio, slant)
    ratio, slant = ratio[:found], slant[:found]
    assert found > 50_000
    # A start below the surface makes a grazing chord longer, never shorter.
    assert ratio.min() > (0.99 if shift == 0 else 0.9)
    assert np.abs(ratio - 1)[slant > 0.1].max() < (1e-3 if shift == 0 else 0.1)
    scene.embree.close()


@pytest.mark.parametrize(("watertight", "leaks"), [(True, 0.0), (False, 1e-5)])
def test_random_rays_in_a_closed_box_never_miss(tmp_path, watertight: bool, leaks: float) -> None:
    """Nor do those that aim at edges and corners, where triangles meet, if Embree is watertight."""
    scene = scene_at(tmp_path, 1.0, 0.0)
    scene.embree.close()
    data = scene.data
    closed = EmbreeScene(data.vertices, data.triangles, data.spheres, watertight=watertight)
    generator = np.random.default_rng(1)
    origin = generator.uniform(-0.999, 0.999, (STEPS, 3))
    direction = generator.normal(size=(STEPS, 3))
    direction[:10] = np.eye(3)[generator.integers(0, 3, 10)]
    corners = generator.choice([-1.0, 1.0], (STEPS // 10, 3))
    corners[: STEPS // 11, 0] = generator.uniform(-1, 1, STEPS // 11)
    direction[-len(corners) :] = corners - origin[-len(corners) :]
    primitive, _ = hits(closed, len(data.triangles), origin, direction)
    assert (primitive[: -len(corners)] < 0).mean() <= leaks
    assert not watertight or (primitive >= 0).all()
    closed.close()
