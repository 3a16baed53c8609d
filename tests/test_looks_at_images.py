"""Looks at images of lamps: where they go, and that no image, right or wrong, alters what is seen."""

from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from chi_square import p_value
from lamp_scenes import BALL, HEAD, PASSES, PLAIN, REFLECTED, SIDE, WALL, Found, find, plain_looks
from z_test import ALPHA, block_means, compare

from causticmpi.estimators.lamps_in_sight import near_image, near_image_pdf
from causticmpi.kernels.embree import ray_buffer
from causticmpi.preprocess.lamp_images import STRAIGHT, LampImages, no_images
from causticmpi.preprocess.lamp_sight import (
    AXES,
    INVERSE,
    MOST_OWN,
    PEAK,
    PLACE,
    LampSight,
    looks_of,
    seen_in_passing,
    with_images,
)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Found]:
    made = find(BALL, tmp_path_factory.mktemp("ball"))
    yield made
    made.prepared.embree.close()


def of_size(images: LampImages, half: np.ndarray) -> LampImages:
    """Ellipses with their half axes so many times as long."""
    return images._replace(axes=images.axes * half)


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


def variance(films: np.ndarray) -> float:
    return float(films.var(axis=0).mean())


@pytest.fixture(scope="module")
def seen(ball: Found) -> np.ndarray:
    """Passes with looks at the images."""
    return ball.looks(ball.images)


@pytest.mark.statistical
@pytest.mark.parametrize("side", [1, 3])
def test_images_take_the_noise_and_leave_the_mean(ball: Found, side: int) -> None:
    ball = ball._replace(sight=looks_of(side * ball.sight.sides))
    seen = ball.looks(ball.images)
    plain = np.zeros((40, SIDE * SIDE, 3))
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    for index, film in enumerate(plain):
        part = index * PLAIN // 40, PLAIN // 40
        plain_looks(ball.prepared.traced, ball.camera, ray_buffer(), *part, SIDE, SIDE, 20, *none, film)
    plain = (plain / (PLAIN // 40)).reshape(40, SIDE, SIDE, 3)
    means, plain_means = block_means(seen, 8), block_means(plain, 8)
    assert compare(means, plain_means).p > ALPHA
    assert not compare(1.2 * means, plain_means).p > ALPHA
    assert variance(ball.looks(None)) > (10 if side == 1 else 5) * variance(seen)


def test_faint_images_are_met_as_often_as_bright_ones(ball: Found, seen: np.ndarray) -> None:
    """A look of an image's own meets it in one pass of three, by however many events; one of the grid, never."""
    faint = (ball.images.chance < 0.003) & (ball.images.events < STRAIGHT << 6)
    pixels = np.floor(ball.images.place[faint]).astype(int)
    assert len(pixels) > 3 and (ball.images.events[faint] >= STRAIGHT << 3).all()
    met, by_chance = (
        films[:, pixels[:, 1], pixels[:, 0]].any(axis=2).mean(axis=0) for films in (seen, ball.looks(None))
    )
    assert (met > 0.1).all() and (by_chance < 0.01).all(), (met, by_chance)


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
def test_a_look_at_an_image_counts_no_lamp_that_it_meets_otherwise(tmp_path: Path) -> None:
    """Beside the edge of a mirror, which cuts an image, a lamp behind it is seen directly."""
    mirror = (WALL % "mirror").replace("[2, ", "[0.3, ")
    behind = (WALL % "black, emission: 2").replace("-1]", "-1.2]")
    lamp = "  - {type: sphere, center: [0.44, 0.5, 1], radius: 0.02, material: black, emission: 30}\n"
    made = find(HEAD + mirror + behind + lamp, tmp_path)
    assert REFLECTED in with_images(made.sight, made.images, SIDE, SIDE).events
    means, others = (block_means(made.looks(images), 8) for images in (made.images, None))
    assert compare(means, others).p > ALPHA
    made.prepared.embree.close()


@pytest.mark.statistical
@pytest.mark.parametrize("degrees", [2, 0.7])
def test_chains_longer_than_any_name(tmp_path: Path, degrees: float) -> None:
    """Between two mirrors, so narrow a picture shows only what has gone to and fro, some by the roulette."""
    mirrors = WALL % "mirror"
    mirrors += "  - {type: quad, corners: [[-2, 2, 4], [2, 2, 4], [2, -2, 4], [-2, -2, 4]], material: mirror}\n"
    lamp = "  - {type: sphere, center: [0.5, 0.3, 0.5], radius: 0.1, material: black, emission: 30}\n"
    made = find(HEAD.replace("fov: 45", f"fov: {degrees}") + mirrors + lamp, tmp_path)
    plain, none = np.zeros((40, SIDE * SIDE, 3)), (np.zeros((0, 2)), np.zeros(0, np.int64))
    for index, film in enumerate(plain):
        plain_looks(made.prepared.traced, made.camera, ray_buffer(), 20 * index, 20, SIDE, SIDE, 60, *none, film)
    means = block_means(made.looks(made.images, 400), 8)
    verdict = compare(means, block_means(plain.reshape(40, SIDE, SIDE, 3) / 20, 8))
    assert verdict.p > ALPHA and means.mean() > 0.1, str(verdict)
    made.prepared.embree.close()


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
