"""Images of lamps: where they are found, how looks are sent to them, and that no image alters what is seen."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest
from chi_square import p_value, perpendicular
from rendering import prepare, scene_from
from z_test import ALPHA, block_means, compare

from causticmpi.config.records import Film
from causticmpi.distributed.prepare import PreparedScene
from causticmpi.estimators.lamps_in_sight import near_image, near_image_pdf, see_lamps, sight_work
from causticmpi.kernels import rng, vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import emitted, scatter_along_eye_path
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import hit_point
from causticmpi.kernels.vec import INFINITY, WHITE
from causticmpi.preprocess.lamp_images import (
    CORNERS,
    STRAIGHT,
    LampImages,
    _slopes,
    _three,
    find_images,
    no_images,
    on_other_film,
)
from causticmpi.preprocess.lamp_sight import (
    AXES,
    INVERSE,
    MOST_OWN,
    PEAK,
    PLACE,
    LampSight,
    lamp_sight,
    seen_in_passing,
    with_images,
)
from causticmpi.preprocess.lamps import MOST_LAMPS, lamps_of
from causticmpi.render.pilot import SIGHT_SIDE, find_lamps
from causticmpi.scene.tracing import camera_array

HEAD = """\
camera: {eye: [0, 0, 3], target: [0, 0, 0], fov: 45}
materials:
  white: {type: diffuse, reflectance: 0.7}
  black: {type: diffuse, reflectance: 0}
  glass: {type: dielectric, ior: 1.5}
  mirror: {type: mirror, reflectance: 0.9}
shapes:
"""
WALL = "  - {type: quad, corners: [[-2, -2, -1], [2, -2, -1], [2, 2, -1], [-2, 2, -1]], material: %s}\n"
# A glass ball, two lamps beside the picture and one in it.
BALL = (
    HEAD.replace("[0, 0, 3], target: [0, 0, 0], fov: 45", "[0.3, 0, 3], target: [0.3, 0, 0], fov: 20")
    + WALL % "white"
    + """\
  - {type: sphere, center: [0.3, 0, 0], radius: 0.4, material: glass}
  - type: quad
    corners: [[-0.8, 0.7, 0.5], [-0.76, 0.7, 0.5], [-0.76, 0.74, 0.48], [-0.8, 0.74, 0.48]]
    material: black
    emission: 30
  - {type: sphere, center: [0.95, 0.75, -0.5], radius: 0.03, material: black, emission: [5, 20, 80]}
  - {type: sphere, center: [0.1, 0.42, 0.2], radius: 0.007, material: black, emission: [8, 2, 4]}
"""
)
# Two lamps before a mirror, of which the first turns its dark side to the eye, one behind it, and one behind a wall.
CORNERS_OF_LAMP = np.array([[0.2, 0.3, 0.4], [0.22, 0.36, 0.44], [0.34, 0.32, 0.44], [0.32, 0.26, 0.4]])
MIDDLE_OF_BALL, RADIUS = np.array([-0.4, -0.3, 0.2]), 0.03
PLANE = (
    HEAD
    + WALL % "mirror"
    + f"""\
  - {{type: quad, corners: {CORNERS_OF_LAMP.tolist()}, material: black, emission: 30}}
  - {{type: sphere, center: {MIDDLE_OF_BALL.tolist()}, radius: {RADIUS}, material: black, emission: 9}}
  - {{type: sphere, center: [0.1, 0.1, -1.5], radius: 0.03, material: black, emission: 9}}
  - {{type: sphere, center: [0.6, -0.3, -0.3], radius: 0.03, material: black, emission: 9}}
  - {{type: quad, corners: [[0.2, -0.6, 0], [0.9, -0.6, 0], [0.9, 0, 0], [0.2, 0, 0]], material: white}}
"""
)
SIDE = 24
WHOLE = (0, 0, SIDE, SIDE)
REFLECTED = 2 * STRAIGHT + 1
PASSES = 4000
PLAIN = 20000
"""Plain looks at a pixel."""


class Found(NamedTuple):
    """A scene ready to trace, its camera, where lamps may be seen without looks at images, and their images."""

    prepared: PreparedScene
    camera: np.ndarray
    sight: LampSight
    images: LampImages

    def looks(self, images: LampImages | None, passes: int = PASSES) -> np.ndarray:
        """Lamps as so many passes see them: (passes, SIDE, SIDE, 3)."""
        sight = self.sight if images is None else with_images(self.sight, images, SIDE, SIDE)
        return self.looks_by(sight, passes).reshape(passes, SIDE, SIDE, 3)

    def looks_by(self, sight: LampSight, passes: int, window: tuple[int, int, int, int] = WHOLE) -> np.ndarray:
        """(passes, pixels of the window, 3)."""
        pixels, work = pixel_order(window, SIDE), sight_work(sight.side)
        films = np.zeros((passes, (window[2] - window[0]) * (window[3] - window[1]), 6), np.float32)
        for index, film in enumerate(films):
            see_lamps(self.prepared.traced, self.camera, work, sight, pixels, 1, index, film)
        assert not films[..., 3:].any()
        return films[..., :3]


def find(text: str, folder: Path, width: int = SIDE, height: int = SIDE) -> Found:
    scene = scene_from(text, folder)
    prepared, camera = prepare(scene), camera_array(scene.camera, width, height)
    sight = lamp_sight(scene, camera, width, height, 1)
    return Found(prepared, camera, sight, find_images(scene, prepared.traced, camera, width, sight.mask))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Found]:
    made = find(BALL, tmp_path_factory.mktemp("ball"))
    yield made
    made.prepared.embree.close()


@numba.njit
def plain_looks(traced, camera, rays, first, count, width, height, most, places, events, film):
    """Looks number first … at random places of every pixel, whose specular events are chosen by chance. Adds to film
    (pixels, 3); places (n, 2), events (n,): of those that meet a lamp by at most `most` events. Returns n."""
    met = 0
    for pixel in range(width * height):
        for look in range(first, first + count):
            key = rng.make_key(99, rng.CAMERA, look, pixel)
            u, v = rng.uniform2(key, 0)
            x, y = np.float32(pixel % width) + u, np.float32(pixel // width) + v
            origin, direction = primary_ray(camera, x, y)
            throughput, name = WHITE, 1
            for bounce in range(most + 1):
                primitive, t = intersect(traced.handle, traced.triangle_count, rays, origin, direction, INFINITY)
                if primitive < 0:
                    break
                p, n, offset = hit_point(traced, primitive, origin, direction, t)
                if traced.kind[traced.material[primitive]] < MIRROR:
                    light = vec.mul(emitted(traced, primitive, n, direction), throughput)
                    for c in range(3):
                        film[pixel, c] += light[c]
                    if vec.max3(light) > 0 and met < places.shape[0]:
                        places[met, 0], places[met, 1], events[met] = x, y, name
                        met += 1
                    break
                before, choice = vec.dot(direction, n), rng.uniform2(key, 1 + bounce)[0]
                origin, direction, throughput = scatter_along_eye_path(
                    traced, primitive, n, p, offset, direction, throughput, choice
                )
                name = 2 * name + (before * vec.dot(direction, n) < 0)
    return met


def of_size(images: LampImages, half: np.ndarray) -> LampImages:
    """Ellipses with their half axes so many times as long."""
    return images._replace(axes=images.axes * half)


def distances(places: np.ndarray, events: np.ndarray, images: LampImages) -> np.ndarray:
    """How far (n,) each place is from the nearest image by the same events [half axes]."""
    away = np.linalg.solve(images.axes, (places[:, None] - images.place)[..., None])[..., 0]
    return np.where(events[:, None] == images.events, np.linalg.norm(away, axis=2), np.inf).min(axis=1, initial=np.inf)


@numba.njit
def run_near_image(image, row, u, out):
    for i in range(u.shape[0]):
        out[i, 0], out[i, 1] = near_image(image, row, u[i, 0], u[i, 1])


@numba.njit
def run_near_image_pdf(image, row, places, out):
    for i in range(places.shape[0]):
        out[i] = near_image_pdf(image, row, places[i, 0], places[i, 1])


def ellipses(place: list, half: list, angle: float = 0.0, events: int = REFLECTED, chance: float = 0.1) -> LampImages:
    """Images of one shape."""
    c, s, count = np.cos(angle), np.sin(angle), len(place)
    axes = np.array([[c, -s], [s, c]]) * half
    return LampImages(
        np.array(place, np.float64), np.tile(axes, (count, 1, 1)), np.full(count, events), np.full(count, chance)
    )


@pytest.mark.statistical
def test_looks_near_an_image_lie_as_their_density_says(ball: Found) -> None:
    sight = with_images(ball.sight, ellipses([[5.3, 7.6]], [0.4, 0.05], 0.6), SIDE, SIDE)
    row = int(np.flatnonzero(np.abs(sight.image[:, PLACE : PLACE + 2] - [5.3, 7.6]).max(axis=1) < 1e-6)[0])
    sampled = np.empty((1 << 19, 2), np.float32)
    run_near_image(sight.image, row, np.random.default_rng(3).random(sampled.shape, np.float32), sampled)
    edges, fine = np.linspace(-0.8, 0.8, 17), 64
    counts = np.histogram2d(*(sampled.astype(np.float64) - [5.3, 7.6]).T, bins=[edges, edges])[0]
    steps = (np.arange(16 * fine) + 0.5) / (16 * fine) * 1.6 - 0.8
    places = np.stack(np.meshgrid(5.3 + steps, 7.6 + steps, indexing="ij"), axis=-1).reshape(-1, 2)
    density = np.empty(len(places))
    run_near_image_pdf(sight.image, row, places, density)
    expected = density.reshape(16, fine, 16, fine).sum(axis=(1, 3)) * (1.6 / 16 / fine) ** 2
    outside = len(sampled) - counts.sum()
    p = p_value(np.append(counts, outside), len(sampled) * np.append(expected, 1 - expected.sum()))
    assert p > ALPHA, p


def on_film(camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Film positions (n, 2) of points (n, 3)."""
    eye, corner, right, down = camera.astype(np.float64)
    at = np.linalg.solve(np.stack([right, down, corner], axis=1), (points - eye).T)
    return (at[:2] / at[2]).T


def test_images_in_a_plane_mirror_are_where_geometry_says(tmp_path: Path) -> None:
    """Each lamp that can be seen has one, as large as its points' variance; none is dark or hidden."""
    made = find(PLANE, tmp_path, 48, 36)
    u = (np.arange(32) + 0.5) / 32
    across, along = np.meshgrid(u, u)
    a, b, _, d = CORNERS_OF_LAMP
    quad = a + across.reshape(-1, 1) * (b - a) + along.reshape(-1, 1) * (d - a)
    radius, angle = RADIUS * np.sqrt(across.reshape(-1, 1)), 2 * np.pi * along.reshape(-1, 1)

    def disk(middle: np.ndarray) -> np.ndarray:
        right, down = perpendicular((middle - [0, 0, 3]) / np.linalg.norm(middle - [0, 0, 3]))
        return middle + radius * (np.cos(angle) * right + np.sin(angle) * down)

    turned = np.array([1, 1, -1])
    behind = MIDDLE_OF_BALL * turned - [0, 0, 2]
    expected = [(quad * turned - [0, 0, 2], REFLECTED), (disk(MIDDLE_OF_BALL), STRAIGHT), (disk(behind), REFLECTED)]
    assert len(made.images.place) == len(expected)
    for points, events in expected:
        places = on_film(made.camera, points)
        variance = np.cov(places.T)
        away = np.linalg.norm(
            np.linalg.solve(made.images.axes, (places.mean(axis=0) - made.images.place)[..., None]), axis=1
        )
        nearest = int(away.argmin())
        assert away[nearest] < 0.05 and made.images.events[nearest] == events and made.images.chance[nearest] == 1
        axes = made.images.axes[nearest]
        np.testing.assert_allclose(axes @ axes.T, CORNERS * variance, atol=0.03 * CORNERS * np.trace(variance))
    made.prepared.embree.close()


@pytest.mark.statistical
def test_plain_looks_meet_lamps_in_known_images(ball: Found) -> None:
    """By up to four events nearly always, and about as often as the images say."""
    places, events, film = np.zeros((1 << 17, 2)), np.zeros(1 << 17, np.int64), np.zeros((SIDE * SIDE, 3))
    traced, images = ball.prepared.traced, ball.images
    met = plain_looks(traced, ball.camera, ray_buffer(), 0, PLAIN, SIDE, SIDE, 4, places, events, film)
    by_mirrors = events[:met] > STRAIGHT
    near = distances(places[:met], events[:met], images)[by_mirrors]
    assert len(near) > 300 and (near < 1.5).mean() > 0.95
    # A square fills 4 / 6 of the box around its ellipse, the disk of a ball pi / 6.
    share = 2 * np.linalg.det(images.axes) * images.chance
    for name in np.unique(events[:met]):
        count, expected = (events[:met] == name).sum(), PLAIN * share[images.events == name].sum()
        assert abs(count - expected) < 4 * np.sqrt(expected) + 0.15 * expected, (bin(name), count, expected)


def variance(films: np.ndarray) -> float:
    return float(films.var(axis=0).mean())


@pytest.fixture(scope="module")
def seen(ball: Found) -> np.ndarray:
    """Passes with looks at the images."""
    return ball.looks(ball.images)


@pytest.mark.statistical
def test_images_take_the_noise_and_leave_the_mean(ball: Found, seen: np.ndarray) -> None:
    plain = np.zeros((40, SIDE * SIDE, 3))
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    for index, film in enumerate(plain):
        part = index * PLAIN // 40, PLAIN // 40
        plain_looks(ball.prepared.traced, ball.camera, ray_buffer(), *part, SIDE, SIDE, 20, *none, film)
    plain = (plain / (PLAIN // 40)).reshape(40, SIDE, SIDE, 3)
    means, plain_means = block_means(seen, 8), block_means(plain, 8)
    assert compare(means, plain_means).p > ALPHA
    assert not compare(1.2 * means, plain_means).p > ALPHA
    assert variance(ball.looks(None)) > 10 * variance(seen)


def strong(images: LampImages) -> np.ndarray:
    """Images (n,) that even looks of the grid meet often enough to be counted."""
    return (images.events > STRAIGHT) & (2 * np.linalg.det(images.axes) * images.chance > 2e-3)


def slipped(images: LampImages) -> LampImages:
    return images._replace(place=images.place + images.axes @ [0.5, -0.6])


def far(images: LampImages) -> LampImages:
    return images._replace(place=images.place + np.where(strong(images)[:, None], [0.3, -0.4], 0.0))


def misnamed(images: LampImages) -> LampImages:
    return images._replace(events=images.events ^ strong(images))


def doubled(images: LampImages) -> LampImages:
    return LampImages(*(np.concatenate([array, array]) for array in images))


def upright(images: LampImages) -> LampImages:
    """Half axes, the same for all, along the borders of pixels."""
    return images._replace(axes=np.broadcast_to(np.diag([0.1, 0.2]), images.axes.shape))


WRONG = {
    "wide": lambda images: of_size(images, np.array([2.0, 2.0])),
    "narrow": lambda images: of_size(images, np.array([0.6, 0.6])),
    "long": lambda images: of_size(images, np.array([3.0, 0.7])),
    "upright": upright, "slipped": slipped, "far": far, "misnamed": misnamed, "doubled": doubled,
}  # fmt: skip


@pytest.mark.statistical
@pytest.mark.parametrize("how", WRONG)
def test_wrong_images_leave_the_mean(ball: Found, seen: np.ndarray, how: str) -> None:
    wrong = ball.looks(WRONG[how](ball.images))
    verdict = compare(block_means(seen, 8), block_means(wrong, 8))
    assert verdict.p > ALPHA, str(verdict)


@pytest.mark.statistical
@pytest.mark.parametrize("column", [PEAK, AXES])
def test_a_wrong_density_is_noticed(ball: Found, seen: np.ndarray, column: int) -> None:
    """The test above can fail."""
    sight = with_images(ball.sight, ball.images, SIDE, SIDE)
    lie = sight.image.copy()
    lie[:, column : column + (4 if column == AXES else 1)] *= 0.7
    lie.flags.writeable = False
    films = ball.looks_by(sight._replace(image=lie), PASSES).reshape(seen.shape)
    assert not compare(block_means(seen, 8), block_means(films, 8)).p > ALPHA


def test_a_crop_has_the_looks_of_the_whole(ball: Found) -> None:
    sight = with_images(ball.sight, ball.images, SIDE, SIDE)
    whole = ball.looks_by(sight, 50).reshape(50, SIDE, SIDE, 3)
    crop = ball.looks_by(sight, 50, (8, 4, 24, 20)).reshape(50, 16, 16, 3)
    np.testing.assert_array_equal(crop, whole[:, 4:20, 8:24])
    assert crop.any()
    odd = ball.looks_by(sight, 50, (7, 3, 19, 22)).reshape(50, 19, 12, 3)
    np.testing.assert_allclose(odd, whole[:, 3:22, 7:19], rtol=1e-5)


def test_images_of_a_small_film_are_those_of_a_large_one(tmp_path: Path) -> None:
    small, large = find(BALL, tmp_path, 32, 24), find(BALL, tmp_path, 81, 60)
    moved = on_other_film(small.images, (32, 24), (81, 60))
    # An ellipse tells little of an image by more events, where a small difference of place makes a large one.
    clear = (small.images.events < STRAIGHT << 5) & (np.linalg.norm(small.images.axes, axis=1).min(axis=1) > 0.01)
    assert clear.sum() > 5
    for place, axes, events in zip(moved.place[clear], moved.axes[clear], moved.events[clear], strict=True):
        away = np.linalg.norm(np.linalg.solve(large.images.axes, (place - large.images.place)[..., None]), axis=(1, 2))
        same = np.where(events == large.images.events, away, np.inf).argmin()
        assert away[same] < 0.2
        covariance = large.images.axes[same] @ large.images.axes[same].T
        np.testing.assert_allclose(axes @ axes.T, covariance, atol=0.1 * np.trace(covariance))
    small.prepared.embree.close(), large.prepared.embree.close()


def rows_of(images: LampImages, width: int = 6, height: int = 5) -> tuple[LampSight, np.ndarray]:
    """Looks at images, and the pixel of each row."""
    sight = with_images(seen_in_passing(), images, width, height)
    assert len(sight.first) == width * height + 1 and sight.first[0] == 0
    assert (np.diff(sight.first) >= 0).all() and sight.first[-1] == len(sight.image) == len(sight.events)
    assert (np.diff(sight.first) <= MOST_OWN).all()
    return sight, np.repeat(np.arange(width * height), np.diff(sight.first))


def test_the_strongest_images_of_a_pixel_are_kept() -> None:
    count = MOST_OWN + 5
    images = ellipses([[2.5, 3.5]] * count, [0.1, 0.01])
    strength = np.random.default_rng(2).permutation(count)
    images = images._replace(
        events=100 + strength,
        chance=0.001 * np.where(strength % 2, 4.0, 1.0) * (1 + strength),
        axes=images.axes / np.sqrt(np.where(strength % 2, 4.0, 1.0))[:, None, None],
    )
    sight, pixels = rows_of(images)
    assert set(pixels) == {3 * 6 + 2}
    assert sight.events.tolist() == [100 + i for i in range(count - 1, count - 1 - MOST_OWN, -1)]
    axes, inverse = sight.image[:, AXES : AXES + 4].reshape(-1, 2, 2), sight.image[:, INVERSE : INVERSE + 4]
    np.testing.assert_allclose(axes @ inverse.reshape(-1, 2, 2), np.tile(np.eye(2), (MOST_OWN, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(sight.image[:, PEAK] * np.pi * np.abs(np.linalg.det(axes)), 1, rtol=1e-5)


def test_images_at_the_border_name_no_pixel_outside() -> None:
    """Nor do they come back in at the other side."""
    places = [[-0.02, 2.5], [5.98, 1.0], [3.0, -0.02], [2.5, 5.02], [0.02, 0.02], [-9.0, 2.0], [40.0, 40.0]]
    sight, pixels = rows_of(ellipses(places, [0.3, 0.1])._replace(events=np.arange(len(places)) + 10))
    for place, name in zip(places, range(10, 10 + len(places)), strict=True):
        own = pixels[sight.events == name]
        far = np.maximum(np.abs(own % 6 + 0.5 - place[0]), np.abs(own // 6 + 0.5 - place[1]))
        assert (far < 1.5).all() and (len(own) > 0) == (name < 15)


def test_a_long_image_has_its_part_in_each_pixel_that_it_crosses() -> None:
    angle, place = 0.4, np.array([3.1, 2.4])
    sight, pixels = rows_of(ellipses([place], [1.9, 0.05], angle))
    along = np.array([np.cos(angle), np.sin(angle)])
    crossed = np.unique(np.floor(place + np.linspace(-1.9, 1.9, 400)[:, None] * along).astype(int) @ [1, 6])
    assert len(crossed) >= 5 and set(crossed) <= set(pixels) and len(pixels) < 3 * len(crossed)
    middle = sight.image[:, PLACE : PLACE + 2] - place
    np.testing.assert_allclose(middle @ [-along[1], along[0]], 0, atol=1e-5)
    assert np.abs(middle @ along).max() < 1.9 and np.ptp(middle @ along) > 2
    corner = np.stack([pixels % 6, pixels // 6], axis=1) + 0.5
    crossing = np.isin(pixels, crossed)
    assert np.linalg.norm(sight.image[:, PLACE : PLACE + 2] - corner, axis=1)[crossing].max() < 1


def test_a_large_likely_image_is_left_to_the_grid() -> None:
    assert not with_images(seen_in_passing(), ellipses([[3, 3]], [0.5, 0.3], chance=1.0), 6, 5).knows_images
    assert with_images(seen_in_passing(), ellipses([[3, 3]], [0.5, 0.3], chance=0.1), 6, 5).knows_images
    assert not with_images(seen_in_passing(), no_images(), 6, 5).knows_images


ROOM = HEAD + WALL % "white"


def test_without_small_images_lamps_are_seen_as_before(tmp_path: Path) -> None:
    large = "  - {type: quad, corners: [[-1, 1, 1], [-1, 1, 0], [1, 1, 0], [1, 1, 1]], material: black, emission: 3}\n"
    behind = "  - {type: sphere, center: [0, 0, 5], radius: 0.1, material: black, emission: 3}\n"
    for lamp, visible in ((large, True), (behind, False)):
        scene = scene_from(ROOM + lamp, tmp_path)
        prepared = prepare(scene)
        sight, images = find_lamps(scene, prepared.traced, Film(width=SIDE, height=SIDE), 1)
        assert not sight.knows_images and sight.in_passing == (not visible)
        assert len(images.place) == 0 or visible
        before = lamp_sight(scene, camera_array(scene.camera, SIDE, SIDE), SIDE, SIDE, SIGHT_SIDE)
        assert not visible or (sight.side == SIGHT_SIDE and np.array_equal(sight.mask, before.mask))
        prepared.embree.close()


def test_of_many_lamps_the_strongest_are_looked_for(tmp_path: Path) -> None:
    count = MOST_LAMPS + 6
    order = np.random.default_rng(5).permutation(count)
    lamps = [
        f"  - {{type: sphere, center: [{-1 + 0.08 * i}, 0.5, 0], radius: {0.01 if k % 2 else 0.02}, material: black,"
        f" emission: {(1 + k) * (4 if k % 2 else 1)}}}\n"
        for i, k in enumerate(order)
    ]
    made = lamps_of(scene_from(ROOM + "".join(lamps), tmp_path))
    kept = np.flatnonzero(order >= count - MOST_LAMPS)
    assert made.shape.tolist() == (1 + kept).tolist()
    np.testing.assert_allclose(made.middle, np.stack([-1 + 0.08 * kept, 0 * kept + 0.5, 0 * kept], axis=1), atol=1e-6)


def test_a_lamp_cut_by_the_edge_of_a_mirror_has_an_image(tmp_path: Path) -> None:
    """Its middle is not to be had in the mirror: the image is where it is lit."""
    lamp = "  - {type: sphere, center: [0.45, 0.5, 1], radius: 0.1, material: black, emission: 3}\n"
    mirror = (WALL % "mirror").replace("[2, ", "[0.28, ")
    made = find(HEAD + mirror + lamp, tmp_path)
    assert REFLECTED in made.images.events
    made.prepared.embree.close()


@numba.njit
def run_slopes(traced, camera, rays, x, y, middle, tangents, out):
    known, three, _ = _three(traced, camera, rays, x, y, REFLECTED)
    ahead, a, b, change = _slopes(three, middle, tangents)
    out[0], out[1], out[2], out[3] = change
    return known and ahead


def test_derivatives_at_a_rim_are_those_beside_it(tmp_path: Path) -> None:
    """There the next place to the right, or below, is another surface's."""
    made = find(PLANE, tmp_path, 48, 36)
    rim = on_film(made.camera, np.array([[2.0, -2.0, -1.0]]))[0]
    middle, tangents = (0.5, 0.5, 1.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    slopes = np.zeros((3, 4))
    for place, out in zip(rim - [[0.2, 0.2], [0.01, 0.2], [0.2, 0.01]], slopes, strict=True):
        assert run_slopes(made.prepared.traced, made.camera, ray_buffer(), *place, middle, tangents, out)
    np.testing.assert_allclose(slopes[1:], np.tile(slopes[0], (2, 1)), atol=0.03 * np.abs(slopes[0]).max())
    made.prepared.embree.close()
