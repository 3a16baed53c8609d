"""Embree from inside kernels against brute force, and what its thread pool must not do to the other ranks."""

import subprocess
import sys

import naive
import numba
import numpy as np
import pytest
from rendering import REPOSITORY, prepare

from causticmpi.kernels import embree, vec
from causticmpi.kernels.embree import EmbreeScene, ray_buffer
from causticmpi.scene.load import load_scene

RAYS = 4000


@numba.njit
def run_intersect(handle, triangle_count, rays, origin, direction, tfar, primitive, t):
    for i in range(origin.shape[0]):
        primitive[i], t[i] = embree.intersect(
            handle, triangle_count, rays, vec.row(origin, i), vec.row(direction, i), tfar
        )


@numba.njit
def run_visible(handle, rays, origin, target, out):
    for i in range(origin.shape[0]):
        out[i] = embree.visible(handle, rays, vec.row(origin, i), vec.row(target, i))


@numba.njit
def run_packets(handle, triangle_count, rays, origin, direction, primitive, t, neighbours=False):
    """The rays 16 at a time, every fifth lane out of use."""
    for first in range(0, origin.shape[0], 16):
        for i in range(16):
            for c in range(3):
                rays[embree.RAY16 + 16 * c + i] = origin[first + i, c]
                rays[embree.RAY16 + 16 * (4 + c) + i] = direction[first + i, c]
            rays[embree.RAY16 + 16 * embree.TNEAR + i] = 0
            rays[embree.RAY16 + 16 * embree.TFAR + i] = -1 if i % 5 == 0 else np.inf
        if neighbours:
            embree.intersect_neighbours(handle, triangle_count, rays)
        else:
            embree.intersect_packet(handle, rays)
        for i in range(16):
            primitive[first + i], t[first + i] = embree.lane_hit(triangle_count, rays, i)


def hits(scene: EmbreeScene, triangles: int, origin: np.ndarray, direction: np.ndarray, tfar: float = np.inf) -> tuple:
    primitive, t = np.empty(len(origin), np.int64), np.empty(len(origin), np.float32)
    rays = (np.ascontiguousarray(a, np.float32) for a in (origin, direction))
    run_intersect(scene.handle, triangles, ray_buffer(), *rays, np.float32(tfar), primitive, t)
    return primitive, t


def sees(scene: EmbreeScene, origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    out = np.empty(len(origin), np.bool_)
    run_visible(scene.handle, ray_buffer(), *(np.ascontiguousarray(a, np.float32) for a in (origin, target)), out)
    return out


class Soup:
    """Random triangles and spheres, some of which overlap."""

    def __init__(self, triangles: int, spheres: int, seed: int = 1) -> None:
        generator = np.random.default_rng(seed)
        self.vertices = np.repeat(generator.uniform(-1, 1, (triangles, 3)), 3, axis=0).astype(np.float32)
        self.vertices += generator.normal(size=self.vertices.shape).astype(np.float32) * np.float32(0.2)
        self.triangles = np.arange(3 * triangles, dtype=np.int32).reshape(-1, 3)
        centre, radius = generator.uniform(-1, 1, (spheres, 3)), generator.uniform(0.02, 0.3, (spheres, 1))
        self.spheres = np.concatenate([centre, radius], axis=1).astype(np.float32)


def cornell() -> Soup:
    data = load_scene(REPOSITORY / "scenes" / "cornell.yaml")
    soup = Soup(0, 0)
    soup.vertices, soup.triangles, soup.spheres = data.vertices, data.triangles, data.spheres
    return soup


SOUPS = {
    "cornell": cornell(),
    "both": Soup(300, 30),
    "triangles": Soup(50, 0),
    "spheres": Soup(0, 20),
    "one": Soup(1, 1),
}


@pytest.fixture(params=SOUPS)
def soup(request: pytest.FixtureRequest) -> Soup:
    return SOUPS[request.param]


@pytest.fixture
def built(soup: Soup):
    scene = EmbreeScene(soup.vertices, soup.triangles, soup.spheres)
    assert scene.bytes > 0
    yield scene
    scene.close()


def rays(count: int = RAYS) -> tuple[np.ndarray, np.ndarray]:
    """Origins in and about the unit cube; directions of any length, a tenth of them along an axis."""
    generator = np.random.default_rng(2)
    origin, direction = generator.uniform(-1.2, 1.2, (count, 3)), generator.normal(size=(count, 3))
    direction[: count // 10] = np.eye(3)[generator.integers(0, 3, count // 10)]
    return origin.astype(np.float32), direction.astype(np.float32)


def test_a_ray_in_a_packet_does_not_know_its_neighbours(soup: Soup, built: EmbreeScene) -> None:
    """The same bits whoever is in the other lanes, so that paths may share packets with those of any pixel."""
    origin, direction = rays()
    chosen = np.random.default_rng(4).permutation(RAYS)
    answers = []
    for order in (np.arange(RAYS), chosen):
        primitive, t = np.empty(RAYS, np.int64), np.empty(RAYS, np.float32)
        run_packets(built.handle, len(soup.triangles), ray_buffer(), origin[order], direction[order], primitive, t)
        back = np.argsort(order)
        used = (np.arange(RAYS) % 16 % 5 != 0)[back]
        answers.append((primitive[back], t[back], used))
    both = answers[0][2] & answers[1][2]
    assert both.sum() > RAYS // 2
    for a, b in zip(answers[0][:2], answers[1][:2], strict=True):
        assert a[both].tobytes() == b[both].tobytes()


def test_rays_taken_for_neighbours_hit_the_same(soup: Soup, built: EmbreeScene) -> None:
    """The same bits from the traversal for coherent rays, even if these are not."""
    answers = []
    for neighbours in (False, True):
        primitive, t = np.empty(RAYS, np.int64), np.empty(RAYS, np.float32)
        run_packets(built.handle, len(soup.triangles), ray_buffer(), *rays(), primitive, t, neighbours)
        answers.append((primitive.tobytes(), t.tobytes()))
    assert len(soup.triangles) <= embree.COARSE
    assert answers[0] == answers[1] and primitive.max() >= 0


def test_intersect_against_brute_force(soup: Soup, built: EmbreeScene) -> None:
    """Primitives are numbered triangles first; t is in units of the direction; spheres are hit from inside as well."""
    origin, direction = rays()
    primitive, t = hits(built, len(soup.triangles), origin, direction)
    oracle_t, depth = naive.intersect(soup.vertices[soup.triangles], soup.spheres, origin, direction)
    nearest = oracle_t.argmin(axis=1)
    least = oracle_t.min(axis=1)
    row = np.arange(len(origin))
    # Where a ray grazes an edge, or two surfaces are equally far, float32 may decide otherwise.
    second = (
        np.partition(np.where(np.isfinite(oracle_t), oracle_t, 1e30), 1, axis=1)[:, 1]
        if oracle_t.shape[1] > 1
        else least
    )
    clear = (np.abs(depth).min(axis=1) > 1e-5) & ((second - least > 1e-5) | ~np.isfinite(least)) & (least > 1e-5)
    assert clear.mean() > 0.8
    expected = np.where(np.isfinite(least), nearest, -1)
    assert np.array_equal(primitive[clear], expected[clear])
    hit = clear & (primitive >= 0)
    assert hit.any() and (~hit).any()
    np.testing.assert_allclose(t[hit], least[hit], rtol=3e-4, atol=3e-6)
    if len(soup.spheres) > 1:
        chosen = soup.spheres[np.maximum(nearest - len(soup.triangles), 0)]
        ball = hit & (nearest >= len(soup.triangles))
        inside = np.linalg.norm(origin - chosen[:, :3], axis=1) < chosen[:, 3]
        assert (ball & inside).sum() > 5 and (ball & ~inside).sum() > 5
    assert (t[primitive < 0] == np.inf).all() and row.size == RAYS


def test_visible_against_brute_force(soup: Soup, built: EmbreeScene) -> None:
    origin, target = rays()[0], rays(RAYS)[0][::-1].copy()
    direction = target.astype(np.float64) - origin
    oracle_t, depth = naive.intersect(soup.vertices[soup.triangles], soup.spheres, origin, direction)
    clear = (
        (np.abs(depth).min(axis=1) > 1e-5) & (np.abs(oracle_t - 1).min(axis=1) > 1e-4) & (oracle_t.min(axis=1) > 1e-4)
    )
    seen = sees(built, origin, target)
    assert np.array_equal(seen[clear], (oracle_t.min(axis=1) >= 1)[clear])
    assert clear.mean() > 0.9 and seen.any() and not seen.all()


def test_packets_hit_what_single_rays_hit(soup: Soup, built: EmbreeScene) -> None:
    """Lanes out of use miss; the others find the same surface but where two are within rounding."""
    origin, direction = rays()
    single, single_t = hits(built, len(soup.triangles), origin, direction)
    primitive, t = np.empty(RAYS, np.int64), np.empty(RAYS, np.float32)
    run_packets(built.handle, len(soup.triangles), ray_buffer(), origin, direction, primitive, t)
    used = np.arange(RAYS) % 16 % 5 != 0
    assert (primitive[~used] == -1).all() and (t[~used] == np.inf).all()
    same = primitive == single
    assert same[used].mean() > 0.998 and (single[used] >= 0).any()
    both = used & same
    np.testing.assert_allclose(t[both], single_t[both], rtol=3e-4, atol=3e-6)


def test_reach_limits_the_ray() -> None:
    soup = SOUPS["both"]
    scene = EmbreeScene(soup.vertices, soup.triangles, soup.spheres)
    origin, direction = rays()
    primitive, t = hits(scene, len(soup.triangles), origin, direction)
    near, near_t = hits(scene, len(soup.triangles), origin, direction, 0.2)
    within = t < 0.2
    assert np.array_equal(near[within], primitive[within]) and (near[~within] == -1).all()
    assert within.any() and (near_t[~within] == np.float32(0.2)).all()
    scene.close()


def test_buffers_are_kept_alive() -> None:
    """Embree reads its buffers when tracing: unpadded arrays are copied, so their owner may drop or change them."""
    soup = Soup(50, 5)
    scene = EmbreeScene(soup.vertices, soup.triangles, soup.spheres)
    before = hits(scene, 50, *rays())
    soup.vertices[:] = 0
    soup.triangles[:] = 0
    soup.spheres[:] = 0
    after = hits(scene, 50, *rays())
    assert np.array_equal(before[0], after[0]) and np.array_equal(before[1], after[1])
    scene.close()
    scene.close()  # closing twice is harmless


def test_scenes_give_their_memory_back() -> None:
    soup = Soup(2000, 100)
    before = embree.device().bytes
    scenes = [EmbreeScene(soup.vertices, soup.triangles, soup.spheres) for _ in range(3)]
    assert embree.device().bytes - before == sum(s.bytes for s in scenes) and min(s.bytes for s in scenes) > 2000 * 16
    for scene in scenes:
        scene.close()
    assert embree.device().bytes <= before + 4096
    assert embree.device() is embree.device() and embree.device().version.startswith("4.")


def test_prepared_scene_is_embree_of_the_same_primitives() -> None:
    """`surface` rows follow the numbering of the hits."""
    prepared = prepare(load_scene(REPOSITORY / "scenes" / "cornell.yaml"))
    origin, direction = rays()
    primitive, t = hits(prepared.embree, prepared.traced.triangle_count, origin, direction)
    hit = primitive >= 0
    point = origin[hit] + t[hit, None] * direction[hit].astype(np.float64)
    surface = prepared.traced.surface[primitive[hit]]
    ball = primitive[hit] >= prepared.traced.triangle_count
    distance = np.linalg.norm(point[ball] - surface[ball, :3], axis=1)
    np.testing.assert_allclose(distance, surface[ball, 3], atol=1e-5)
    corner = prepared.data.vertices[prepared.data.triangles[primitive[hit][~ball], 0]]
    assert np.abs(((point[~ball] - corner) * surface[~ball, :3]).sum(axis=1)).max() < 1e-5
    prepared.embree.close()


IDLE = """\
import os, time
import numpy as np
cores = os.sched_getaffinity(0)
from causticmpi.kernels import embree
generator = np.random.default_rng(0)
v = generator.random((3000, 3), np.float32)
t = np.arange(3000, dtype=np.int32).reshape(-1, 3)
s = generator.random((10, 4), np.float32)
for _ in range(2):
    scenes = [embree.EmbreeScene(v, t, s) for _ in range(4)]
    for scene in scenes[1:]:
        scene.close()
    embree.device.cache_clear()  # a second device is what set the worker spinning
kept = embree.EmbreeScene(v, t, s)
began = time.process_time()
time.sleep(0.5)
print(time.process_time() - began, len(os.listdir("/proc/self/task")), os.sched_getaffinity(0) == cores)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_no_worker_thread_spins() -> None:
    """An idle process uses no processor time, and its affinity is as it was: the cores belong to the ranks."""
    done = subprocess.run([sys.executable, "-c", IDLE], capture_output=True, text=True, cwd=REPOSITORY, check=True)
    seconds, _, same = done.stdout.split()
    assert float(seconds) < 0.1 and same == "True"
