"""Directions as seen from another place, and the cones around them, against their definitions in float64."""

import math

import naive
import numba
import numpy as np
import pytest

from causticmpi.preprocess import parallax
from causticmpi.preprocess.parallax import ALIKE, CURVATURE, FEWEST, HEIGHT, MOST_TURN, NARROWEST, POWER, ROWS

WIDEST_HEIGHT, NARROWEST_HEIGHT = 1 - math.cos(parallax.WIDEST), 1 - math.cos(NARROWEST)
ENTRY = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where the entries of a symmetric matrix stand in its six numbers."""
SURE = 1e-4
"""Decisions nearer to their border than this, relatively, may fall either way in float32."""


@numba.njit
def run_turned(direction, curvature, step, out):
    for i in range(len(out)):
        d = (direction[i, 0], direction[i, 1], direction[i, 2])
        m = (curvature[i, 0], curvature[i, 1], curvature[i, 2], curvature[i, 3], curvature[i, 4], curvature[i, 5])
        out[i, 0], out[i, 1], out[i, 2] = parallax.turned(d, m, (step[i, 0], step[i, 1], step[i, 2]))


@numba.njit
def run_settle(photon, offset, count, companions, work):
    parallax.settle(photon, offset, count, companions, work)


def turned(direction: np.ndarray, curvature: np.ndarray, step: np.ndarray) -> np.ndarray:
    out = np.zeros((len(direction), 3), np.float32)
    run_turned(*(np.ascontiguousarray(a, np.float32) for a in (direction, curvature, step)), out)
    return out


def naive_turned(direction: np.ndarray, curvature: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Of all photons (n, …) in float64: d is the way of the light, -direction; it turns by D step."""
    turn = np.einsum("nij,nj->ni", curvature.astype(np.float64)[:, ENTRY], step.astype(np.float64))
    known = (turn**2).sum(axis=1) < float(MOST_TURN) ** 2
    return naive.unit(direction - np.where(known[:, None], turn, 0))


def naive_reach(direction: np.ndarray, companions: int) -> np.ndarray:
    """1 - cosine to the companions-th closest of the other directions: (n,)."""
    chords = ((direction[:, None] - direction[None]) ** 2).sum(axis=2) / 2
    np.fill_diagonal(chords, np.inf)
    return np.sort(chords, axis=1)[:, companions - 1]


def naive_settle(
    direction: np.ndarray, curvature: np.ndarray, offset: np.ndarray, companions: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Directions (n, 3) and heights (n,) of the cones of photons (n, …); which of them were turned, 1, or not, 0, or
    perhaps, -1, as it makes no difference (n,); and which of it all is sure (n,)."""
    count = len(direction)
    own = direction.astype(np.float64)
    if count < FEWEST:
        return own, np.full(count, WIDEST_HEIGHT), np.ones(count, int), np.ones(count, bool)
    other = naive_turned(own, curvature, offset)
    companions = min(companions, count - 1)
    mine, theirs = naive_reach(own, companions), naive_reach(other, companions)
    better = theirs < mine
    clear = np.abs(theirs - mine) > SURE * (mine + theirs)
    alright = clear | (np.linalg.norm(own - other, axis=1) < 2e-7)
    kept = np.where(better[:, None], other, own)
    height = np.clip(np.minimum(mine, theirs), NARROWEST_HEIGHT, WIDEST_HEIGHT)
    chords = ((kept[:, None] - kept[None]) ** 2).sum(axis=2) / 2
    alike = chords <= float(ALIKE) * height[:, None]
    sure = (np.abs(chords - float(ALIKE) * height[:, None]) > SURE * chords).all(axis=1) & alright.all()
    mean = np.exp((alike * np.log(height)).sum(axis=1) / alike.sum(axis=1))
    return kept, mean, np.where(clear, better, -1), sure


def settled(direction: np.ndarray, curvature: np.ndarray, offset: np.ndarray, companions: int) -> np.ndarray:
    """(n, ROWS): the photons of a place, as `settle` leaves them; behind them there is rubbish, which it must leave."""
    count = len(direction)
    photon = np.full((ROWS, count + 5), 9, np.float32)
    photon[:3, :count], photon[CURVATURE:, :count], photon[POWER, :count] = direction.T, curvature.T, np.arange(count)
    there = np.full((3, count + 5), np.nan, np.float32)
    there[:, :count] = offset.T
    run_settle(photon, there, count, companions, np.full((5, count + 5), 7, np.float32))
    assert (photon[:, count:] == 9).all() and photon[POWER, :count].tolist() == list(range(count))
    return photon[:, :count].T


def from_images(image: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions from places (n, 3) to images of a point (n, 3), and the curvature (n, 6) of light from there."""
    way = image - place
    far = np.linalg.norm(way, axis=1)
    direction = naive.unit(way)
    matrix = (np.eye(3) - direction[:, :, None] * direction[:, None]) / far[:, None, None]
    return direction.astype(np.float32), matrix[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)


def test_a_point_is_seen_where_it_is() -> None:
    """To first order: what is left of the error after the turn falls with the square of the step."""
    generator = np.random.default_rng(1)
    place = generator.normal(size=(1000, 3))
    image = place + 3 * naive.unit(generator.normal(size=(1000, 3)))
    direction, curvature = from_images(image, place)
    way = naive.unit(generator.normal(size=(1000, 3)))
    left = []
    for size in (0.4, 0.2, 0.1):
        step = (size * way).astype(np.float32)
        there = naive.unit(image - place - step)
        found = turned(direction, curvature, step)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=3e-7)
        np.testing.assert_allclose(found, naive_turned(direction, curvature, step), atol=3e-7)
        error = np.linalg.norm(found - there, axis=1)
        assert np.median(error) < 0.1 * np.median(np.linalg.norm(direction - there, axis=1))
        left.append(np.median(error))
    assert 3.5 < left[0] / left[1] < 4.5 and 3.5 < left[1] / left[2] < 4.5


def test_a_direction_is_turned_by_so_much_and_not_more() -> None:
    direction = np.tile(np.float32([0, 0, 1]), (6, 1))
    turn = np.float32([0.999 * MOST_TURN, 1.001 * MOST_TURN, 1e6, np.nan, np.inf, 0])
    curvature = np.zeros((6, 6), np.float32)
    curvature[:, 0] = turn
    found = turned(direction, curvature, np.tile(np.float32([1, 0, 0]), (6, 1)))
    np.testing.assert_allclose(found[0], naive.unit([-turn[0], 0, 1]), atol=1e-6)
    assert np.array_equal(found[1:], direction[1:])


SETTLE_CASES = [
    # photons, companions, spread of their directions, curvature
    (FEWEST, 2, 0.3, 1.0),
    (5, 4, 0.1, 1.0),
    (5, 9, 0.1, 1.0),  # more than there are
    (20, 4, 0.5, 2.0),
    (50, 4, 0.02, 0.3),
    (50, 1, 0.1, 0.1),
    (50, 4, 3.0, 5.0),
    (16, 5, 1e-3, 1e-2),
]


@pytest.mark.parametrize("case", SETTLE_CASES, ids=str)
def test_cones_against_the_definition(case: tuple[int, int, float, float]) -> None:
    count, companions, spread, strength = case
    told, turns = 0.0, 0.0
    for seed in range(40):
        generator = np.random.default_rng(seed)
        direction = naive.unit([0.3, 0.8, -0.2] + spread * generator.normal(size=(count, 3))).astype(np.float32)
        curvature = (strength * generator.normal(size=(count, 6))).astype(np.float32)
        offset = (0.1 * generator.normal(size=(count, 3))).astype(np.float32)
        wanted, height, better, sure = naive_settle(direction, curvature, offset, companions)
        found = settled(direction, curvature, offset, companions)
        assert (found[:, HEIGHT] >= 0.999 * NARROWEST_HEIGHT).all()
        assert (found[:, HEIGHT] <= 1.001 * WIDEST_HEIGHT).all()
        np.testing.assert_allclose(found[sure, HEIGHT], height[sure], rtol=2e-3)
        if sure.any():
            np.testing.assert_allclose(found[:, :3], wanted, atol=3e-7)
            assert (found[better == 0, CURVATURE:] == 0).all()
            assert np.array_equal(found[better == 1, CURVATURE:], curvature[better == 1])
            turns += (better == 1).mean() / 40
        told += sure.mean() / 40
    assert told > 0.85 and 0.03 < turns < 0.97


@pytest.mark.parametrize("count", range(FEWEST))
def test_few_photons_have_the_widest_cones(count: int) -> None:
    """As they were: directions and curvature are kept, for they may be turned yet."""
    generator = np.random.default_rng(count)
    direction, curvature, offset = (generator.normal(size=(count, n)).astype(np.float32) for n in (3, 6, 3))
    found = settled(direction, curvature, offset, 2)
    np.testing.assert_allclose(found[:, HEIGHT], WIDEST_HEIGHT, rtol=1e-6)
    assert np.array_equal(found[:, :3], direction) and np.array_equal(found[:, CURVATURE:], curvature)


def test_repeated_photons() -> None:
    """Those of a cell may be drawn several times: each finds itself among the others, at no distance."""
    generator = np.random.default_rng(3)
    direction = naive.unit([0, 0, 1] + 0.2 * generator.normal(size=(4, 3))).astype(np.float32)
    nothing = np.zeros((16, 6), np.float32)
    four = np.repeat(direction, 4, axis=0)
    found = settled(four, nothing, nothing[:, :3], 3)
    np.testing.assert_allclose(found[:, HEIGHT], NARROWEST_HEIGHT, rtol=1e-5)
    found = settled(four, nothing, nothing[:, :3], 4)  # the fourth is another direction
    _, height, _, _ = naive_settle(four, nothing, nothing[:, :3], 4)
    np.testing.assert_allclose(found[:, HEIGHT], height, rtol=1e-3)
    assert (found[:, HEIGHT] > 100 * NARROWEST_HEIGHT).all()
    alone = settled(np.repeat(direction[:1], 16, axis=0), nothing, nothing[:, :3], 11)
    np.testing.assert_allclose(alone[:, HEIGHT], NARROWEST_HEIGHT, rtol=1e-5)


def test_photons_of_one_image_agree() -> None:
    """All point at one point, from places around: turned they are one direction, unturned they are not."""
    generator = np.random.default_rng(4)
    place = 0.02 * generator.normal(size=(50, 3)) * [1, 0, 1]
    image = np.tile([1.0, 7.0, -2.0], (50, 1))
    direction, curvature = from_images(image, place)
    found = settled(direction, curvature, -place.astype(np.float32), 4)
    np.testing.assert_allclose(found[:, HEIGHT], NARROWEST_HEIGHT, rtol=1e-5)
    # What is left is of the second order, (0.06 / 7)^2, and seldom so much.
    np.testing.assert_allclose(found[:, :3], np.tile(naive.unit(image[0]), (50, 1)), atol=1e-4)
    unturned = settled(direction, 0 * curvature, -place.astype(np.float32), 4)
    assert (unturned[:, HEIGHT] > 2 * NARROWEST_HEIGHT).all()


def test_the_wrong_curvature_is_not_followed() -> None:
    """Light from afar, whose photons say that it comes from close by: each keeps its own direction."""
    generator = np.random.default_rng(5)
    direction = naive.unit([0, 0, 1] + 1e-4 * generator.normal(size=(30, 3))).astype(np.float32)
    curvature = (0.5 * generator.normal(size=(30, 6))).astype(np.float32)
    found = settled(direction, curvature, (0.1 * generator.normal(size=(30, 3))).astype(np.float32), 4)
    assert np.array_equal(found[:, :3], direction) and (found[:, CURVATURE:] == 0).all()
