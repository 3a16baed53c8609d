"""Images of lamps: they are where geometry says and where plain looks meet lamps, and no others."""

from pathlib import Path

import numba
import numpy as np
import pytest
from chi_square import perpendicular
from lamp_scenes import BALL, HEAD, PLAIN, REFLECTED, SIDE, WALL, find, plain_looks
from rendering import prepare, scene_from

from causticmpi.config.records import Film
from causticmpi.kernels.embree import ray_buffer
from causticmpi.preprocess.lamp_images import (
    FAINTEST,
    STRAIGHT,
    WIDE,
    LampImages,
    _follow,
    _slopes,
    _three,
    on_other_film,
)
from causticmpi.preprocess.lamp_sight import lamp_sight
from causticmpi.preprocess.lamps import MOST_LAMPS, lamps_of
from causticmpi.render.looks import SIGHT_SIDE
from causticmpi.render.pilot import find_lamps
from causticmpi.scene.tracing import camera_array

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


def distances(places: np.ndarray, events: np.ndarray, images: LampImages) -> np.ndarray:
    """How far (n,) each place is from the nearest image by the same events [half axes]."""
    away = np.linalg.solve(images.axes, (places[:, None] - images.place)[..., None])[..., 0]
    return np.where(events[:, None] == images.events, np.linalg.norm(away, axis=2), np.inf).min(axis=1, initial=np.inf)


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
        np.testing.assert_allclose(axes @ axes.T, WIDE * variance, atol=0.03 * WIDE * np.trace(variance))
    made.prepared.embree.close()


def test_a_mirror_that_is_all_but_black_shows_no_images(tmp_path: Path) -> None:
    made = find(PLANE.replace("reflectance: 0.9", f"reflectance: {FAINTEST / 2:.9f}"), tmp_path, 48, 36)
    assert made.images.events.tolist() == [STRAIGHT]
    made.prepared.embree.close()


@pytest.mark.statistical
def test_plain_looks_meet_lamps_in_known_images(tmp_path: Path) -> None:
    """By up to four events nearly always, and about as often as the images say."""
    places, events, film = np.zeros((1 << 17, 2)), np.zeros(1 << 17, np.int64), np.zeros((SIDE * SIDE, 3))
    ball = find(BALL, tmp_path)
    traced, images = ball.prepared.traced, ball.images
    met = plain_looks(traced, ball.camera, ray_buffer(), 0, PLAIN, SIDE, SIDE, 4, places, events, film)
    by_mirrors = events[:met] > STRAIGHT
    near = distances(places[:met], events[:met], images)[by_mirrors]
    assert len(near) > 300 and (near < 1.9).mean() > 0.95
    # The area of a square is 12 times the variance of its points, that of a ball's disk 4 pi times.
    share = 12 / WIDE * np.linalg.det(images.axes) * images.chance
    for name in np.unique(events[:met]):
        count, expected = (events[:met] == name).sum(), PLAIN * share[images.events == name].sum()
        assert abs(count - expected) < 4 * np.sqrt(expected) + 0.15 * expected, (bin(name), count, expected)


@pytest.mark.parametrize("alone", [True, False])
def test_an_image_is_found_once(tmp_path: Path, alone: bool) -> None:
    """However many places it is lit at that are far from its middle, over the distance of starts."""
    lamp = "  - {type: sphere, center: [-0.4, -0.3, 0.2], radius: 0.06, material: black, emission: 9}\n"
    made = find(HEAD + lamp if alone else BALL, tmp_path)
    images = made.images
    away = np.linalg.norm(np.linalg.solve(images.axes, (images.place[:, None] - images.place)[..., None]), axis=(2, 3))
    same = (images.events[:, None] == images.events) & (away < 1)
    np.testing.assert_array_equal(same, np.eye(len(same)))
    assert len(same) == 1 if alone else len(same) > 10
    made.prepared.embree.close()


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


ROOM = HEAD + WALL % "white"


def test_without_small_images_lamps_are_seen_as_before(tmp_path: Path) -> None:
    square = "[[-1, -1, %s], [1, -1, %s], [1, 1, %s], [-1, 1, %s]]"
    large = "  - {type: quad, corners: " + square.replace("%s", "-0.9") + ", material: black, emission: 9}\n"
    behind = "  - {type: sphere, center: [0, 0, 5], radius: 0.1, material: black, emission: 3}\n"
    for lamp, visible in ((large, True), (behind, False)):
        scene = scene_from(ROOM + lamp, tmp_path)
        prepared = prepare(scene)
        sight, images = find_lamps(scene, prepared.traced, Film(width=SIDE, height=SIDE), 1)
        assert not sight.knows_images and (sight.most > 0) == visible
        assert len(images.place) == 0 or visible
        before = lamp_sight(scene, camera_array(scene.camera, SIDE, SIDE), SIDE, SIDE, SIGHT_SIDE)
        assert not visible or np.array_equal(sight.sides, before.sides)
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
    alive, o, d, _, _, _, _ = _follow(traced, camera, rays, x, y, REFLECTED)
    known, three = _three(traced, camera, rays, x, y, REFLECTED, o, d)
    ahead, a, b, change = _slopes(three, middle, tangents)
    out[0], out[1], out[2], out[3] = change
    return alive and known and ahead


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


def test_no_image_of_a_lamp_whose_middle_lies_behind_the_eye(tmp_path: Path) -> None:
    """Such a lamp is lit where the search starts, yet no ray of the picture leads to its middle."""
    strip = "[[-0.1, 1, 20], [0.1, 1, 20], [0.1, 1, -0.9], [-0.1, 1, -0.9]]"
    made = find(HEAD + f"  - {{type: quad, corners: {strip}, material: black, emission: 9}}\n", tmp_path, 48, 36)
    assert len(made.images.place) == 0
    made.prepared.embree.close()


def test_a_lamp_that_chance_meets_has_few_images(tmp_path: Path) -> None:
    """A large one has no more than its middle's, however many starts are lit, and its reflections in a pane."""
    square = "[[-1, -1, %s], [1, -1, %s], [1, 1, %s], [-1, 1, %s]]"
    large = "  - {type: quad, corners: " + square.replace("%s", "-0.9") + ", material: black, emission: 9}\n"
    pane = "  - {type: quad, corners: " + square.replace("%s", "2") + ", material: glass}\n"
    for shapes, most in ((large, 1), (large + pane, 10)):
        made = find(HEAD + shapes, tmp_path, 48, 36)
        assert len(made.images.place) <= most
        made.prepared.embree.close()
