"""Looks for lamps at some pixels and in passing at others: the mean stays, and a pilot finds where they pay."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from lamp_scenes import BALL, HEAD, SIDE, WALL, Found, find
from program_tools import CORNELL
from rendering import make_config
from z_test import ALPHA, block_means, compare

from causticmpi.config.load import load_config
from causticmpi.config.records import Film
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import Forecasting, prepare_method, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess.forecast import no_forecast
from causticmpi.preprocess.lamp_images import no_images
from causticmpi.preprocess.lamp_sight import (
    LARGER,
    MOST_SIDE,
    LampSight,
    at_most,
    lamp_sight,
    looks_of,
    seen_in_passing,
    sides_on_other_film,
    with_images,
    with_larger_lamps,
)
from causticmpi.render.looks import (
    AMOUNTS,
    AT_RANDOM,
    EVEN,
    LARGER_PASSES,
    MOST_LOOKS,
    MOSTLY,
    OFTEN,
    SIGHT_SIDE,
    SURE,
    LampPasses,
    LampTrial,
    LookNeeds,
    try_looks,
)
from causticmpi.render.looks import PASSES as TRIED
from causticmpi.render.methods import make_method
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array
from causticmpi.stability.scenes import build, write_scene

SLOTS = SIDE * SIDE
PASSES = 3000
LAMP = "  - {type: sphere, center: %s, radius: %s, material: black, emission: %s}\n"
# Lamps of a pixel's size and more, directly and in a mirror: none of the glints that a thousand looks do not meet.
PLAIN = (
    HEAD
    + WALL % "black"
    + "  - {type: quad, corners: [[-1, -0.9, 0], [0.2, -0.9, 0], [0.2, 0, -0.6], [-1, 0, -0.6]], material: mirror}\n"
    + "  - type: quad\n    corners: [[-1, 1.5, 1], [1, 1.5, 1], [1, 1.5, 0.5], [-1, 1.5, 0.5]]\n"
    + "    material: black\n    emission: 3\n"
    + LAMP % ([0.6, 0.5, 0], 0.2, [5, 20, 80])
    + LAMP % ([0.5, -0.6, 0.2], 0.06, [30, 20, 10])
)
# One lamp of each colour: a sphere and a quad in sight, and a third for the test to place.
COLOURS = (
    HEAD
    + WALL % "black"
    + LAMP % ([-0.5, 0.5, 0], 0.03, [10, 0, 0])
    + "  - type: quad\n    corners: [[0.47, -0.53, 0], [0.53, -0.53, 0], [0.53, -0.47, 0], [0.47, -0.47, 0]]\n"
    + "    material: black\n    emission: [0, 0, 20]\n"
)


@pytest.fixture(scope="module", params=["plain", "images"])
def black(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Found]:
    """A scene of black walls: lamps without images, or a glass ball and images of lamps in it."""
    with_ball = request.param == "images"
    text = BALL.replace(WALL % "white", WALL % "black") if with_ball else PLAIN
    made = find(text, tmp_path_factory.mktemp(request.param))
    assert len(made.images.place) or not with_ball
    yield made if with_ball else made._replace(images=no_images())
    made.prepared.embree.close()


def varied(found: Found) -> LampSight:
    """Sides of 0 to 4 at random."""
    return with_images(looks_of(np.random.default_rng(5).integers(0, 5, SLOTS)), found.images, SIDE, SIDE)


def traced(found: Found, sight: LampSight, first: int, passes: int) -> np.ndarray:
    """L_d of whole passes of `iws` (passes, SLOTS, 3): between black walls, of lamps alone."""
    common = (
        make_config(method="iws", seed=1),
        found.prepared.traced,
        found.camera,
        no_forecast(),
        found.prepared.extent,
    )
    method, pixels = make_method(*common, None, sight), pixel_order((0, 0, SIDE, SIDE), SIDE)
    films = np.zeros((passes, SLOTS, 6), np.float32)
    for index, film in enumerate(films, first):
        method.begin_pass(index)
        method.trace(pixels, film)
    return films[..., :3]


@pytest.mark.statistical
def test_sides_that_vary_leave_the_mean(black: Found) -> None:
    sight = varied(black)
    single = black.looks_by(with_images(looks_of(np.ones(SLOTS)), black.images, SIDE, SIDE), PASSES)
    films = traced(black, sight, PASSES, PASSES)
    means, others = (block_means(f.reshape(PASSES, SIDE, SIDE, 3), 8) for f in (films, single))
    verdict = compare(means, others)
    assert verdict.p > ALPHA, str(verdict)
    assert not compare(1.2 * means, others).p > ALPHA
    for side in range(5):
        own = sight.sides == side
        mean, other = films[:, own].mean(axis=(1, 2)), single[:, own].mean(axis=(1, 2))
        if side == 0 and sight.knows_images:  # all that shows a lamp shows an image, and has looks
            assert own.any() and not mean.any() and not other.any()
            continue
        verdict = compare(mean[:, None], other[:, None])
        assert own.any() and other.any() and verdict.p > ALPHA / 5, f"side {side}: {verdict}"
        if side > 1 and not sight.knows_images:
            assert films[:, own].var(axis=0).mean() * side**2 < 1.05 * single[:, own].var(axis=0).mean()
    more = sight.sides > 1
    assert films[:, more].var(axis=0).mean() < 0.7 * single[:, more].var(axis=0).mean()


def test_lamps_are_seen_in_passing_where_there_are_no_looks_and_only_there(black: Found) -> None:
    sight = varied(black)
    whole, looks = traced(black, sight, 0, 40), black.looks_by(sight, 40)
    none = sight.sides == 0
    assert 0.1 < none.mean() < 0.3
    assert not looks[:, none].any() and whole[:, none].any() != sight.knows_images
    np.testing.assert_array_equal(whole[:, ~none], looks[:, ~none])


def larger_and_real(text: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the picture (3,), of larger lamps and of the real ones, averaged over passes."""
    found = find(text, folder)
    everywhere, data = looks_of(np.ones(SLOTS)), found.prepared.data
    larger = found.looks_by(with_larger_lamps(everywhere, data), 400)
    real = found.looks_by(lamp_sight(data, found.camera, SIDE, SIDE, 4), 1500)
    found.prepared.embree.close()
    return larger.mean(axis=0).sum(axis=0), real.mean(axis=0).sum(axis=0)


@pytest.mark.statistical
def test_larger_lamps_are_so_many_times_as_wide(tmp_path: Path) -> None:
    behind = LAMP % ([1.2, 1.2, -2.5], 0.03, [0, 50, 0])
    larger, real = larger_and_real(COLOURS + behind, tmp_path)
    assert larger[1] == real[1] == 0
    # The ellipse of the variance of a square is by pi / 3 larger than the square.
    np.testing.assert_allclose(larger[[0, 2]] / real[[0, 2]], LARGER**2 * np.array([1, np.pi / 3]), rtol=0.04)


def test_what_is_close_before_a_lamp_does_not_hide_a_larger_one(tmp_path: Path) -> None:
    """It would stand out."""
    inside = LAMP % ([0.4, 0.4, -1.15], 0.03, [0, 50, 0])
    larger, real = larger_and_real(COLOURS + inside, tmp_path)
    assert real[1] == 0 and larger[1] > 0


@pytest.mark.parametrize("swapped", [False, True])
def test_the_brightest_of_larger_lamps_wins(tmp_path: Path, swapped: bool) -> None:
    dim, bright = LAMP % ([0, 0, 0], 0.08, [2, 2, 0]), LAMP % ([0.3, 0.1, -0.3], 0.02, [0, 0, 3])
    films = []
    for text in (dim, bright, bright + dim if swapped else dim + bright):
        found = find(HEAD + WALL % "black" + text, tmp_path)
        films.append(found.looks_by(with_larger_lamps(looks_of(np.ones(SLOTS)), found.prepared.data), 20))
        found.prepared.embree.close()
    alone, over, both = films
    lit = np.asarray(over.any(axis=2))
    assert (lit & alone.any(axis=2)).sum() > 20 and (alone.any(axis=2) & ~lit).any()
    np.testing.assert_array_equal(both, np.where(lit[..., None], over, alone))


def needs_of(**changes: object) -> LookNeeds:
    chance = np.random.default_rng(3)
    made: dict[str, object] = {
        "errors": chance.exponential(size=SLOTS) ** 3,
        "powers": chance.uniform(AT_RANDOM, EVEN, SLOTS),
        "least": (chance.random(SLOTS) < 0.2).astype(np.uint8),
        "each": 0.003, "images": 0.4, "most": 10**9,
    }  # fmt: skip
    return LookNeeds(**{**made, **changes})  # type: ignore[arg-type]


def test_sides_of_least_error_and_price() -> None:
    needs = needs_of()
    for amount in (0.5, 4.0, 30.0):
        price = needs.errors.mean() * (SIGHT_SIDE / amount) ** 2
        taken = needs.sides(amount)
        assert taken.dtype == np.uint8 and len(np.unique(taken)) > 2
        for error, power, least, side in zip(needs.errors, needs.powers, needs.least, taken, strict=True):
            costs = [error * (SIGHT_SIDE / max(1, s)) ** power + price * s**2 for s in range(MOST_SIDE + 1)]
            assert side == max(least, np.argmin(costs))
    even = needs_of(errors=np.full(SLOTS, 0.3), powers=np.full(SLOTS, AT_RANDOM))
    for side in range(2, MOST_SIDE + 1):
        assert (even.sides(side**2) == side).all()


def test_more_looks_leave_less_error_and_cost_rays() -> None:
    needs = needs_of()
    made = [needs.sides(amount) for amount in AMOUNTS]
    errors, rays = [needs.error(sides) for sides in made], [needs.rays(sides) for sides in made]
    assert (np.diff(errors) <= 0).all() and (np.diff(rays) >= 0).all() and errors[-1] < 0.2 * errors[0]
    none, one = np.zeros(SLOTS, np.uint8), np.ones(SLOTS, np.uint8)
    assert needs.rays(none) == needs.images
    assert needs.error(none) == needs.error(one) == pytest.approx((needs.errors * 2**needs.powers).mean())
    assert needs.error(2 * one) == pytest.approx(needs.errors.mean())
    assert needs.rays(7 * one) == pytest.approx(needs.images + 49 * SLOTS * needs.each)


@pytest.mark.parametrize("most", [10**9, 4 * SLOTS, 0])
@pytest.mark.parametrize("error, rays", [(0.1, 30.0), (1.0, 2.0), (50.0, 2.0)])
def test_the_best_sides_are_those_of_least_error_times_cost(most: int, error: float, rays: float) -> None:
    needs = needs_of(most=most)
    allowed = [s for s in map(needs.sides, AMOUNTS) if (s.astype(int) ** 2).sum() <= most] + [needs.least]
    scores = [(error + needs.error(sides)) * (rays + needs.rays(sides)) for sides in allowed]
    score, sides = needs.best(error, rays)
    assert score == pytest.approx(min(scores), rel=1e-12)
    assert score == pytest.approx((error + needs.error(sides)) * (rays + needs.rays(sides)), rel=1e-12)
    assert (sides >= needs.least).all() and sides.shape == (SLOTS,) and sides.dtype == np.uint8
    assert (sides.astype(int) ** 2).sum() <= max(most, needs.least.sum())


def test_looks_where_they_cost_little_beside_the_rest() -> None:
    needs = needs_of()
    dear, cheap = (int(np.square(needs.best(0.1, rays)[1], dtype=int).sum()) for rays in (0.1, 1000.0))
    assert needs.least.sum() <= dear < cheap / 2
    assert (needs.best(1e9, 2.0)[1] == needs.least).all()
    quiet = needs_of(errors=np.zeros(SLOTS))
    assert (quiet.best(0.1, 30.0)[1] == quiet.least).all()


SHAPE = 6, 9
COUNT = SHAPE[0] * SHAPE[1]


def trial_of(power: float = 2.5, **changes: object) -> LampTrial:
    """In columns 0 to 2 lamps are met often and in part mostly, elsewhere seldom; larger ones in columns 5 to 7."""
    chance = np.random.default_rng(11)
    column = np.arange(COUNT) % SHAPE[1]
    met = np.where(column < 3, np.where(column < 2, MOSTLY, OFTEN), OFTEN - 1)
    mean, variance, larger = (chance.uniform(0.5, 3, (COUNT, 3)) for _ in range(3))
    larger[(column < 5) | (column > 7)] = 0
    single = np.where(met >= MOSTLY, 2.0**power, 77.0)[:, None] * variance
    none, seen = np.zeros((COUNT, 3)), column != 7
    made: dict[str, object] = {
        "shape": SHAPE,
        "grid": LampPasses(mean, variance, met, 0.3 + 4 * 0.01 * seen.sum()),
        "single": LampPasses(mean, single, met, 0.3 + 0.01 * seen.sum()),
        "larger": LampPasses(larger, none, met, 1.0),
        "seen": seen,
        "least": (column == 8).astype(np.uint8),
    }
    return LampTrial(**{**made, **changes})  # type: ignore[arg-type]


REST, FLOOR = np.random.default_rng(4).uniform(0.2, 1, (COUNT, 3)), 0.01


def blurred(values: np.ndarray) -> np.ndarray:
    """Means of 3 x 3 pixels, those at the border repeated."""
    around = np.pad(values.reshape(*SHAPE, 3), ((1, 1), (1, 1), (0, 0)), "edge")
    parts = [around[y : y + SHAPE[0], x : x + SHAPE[1]] for y in range(3) for x in range(3)]
    return np.mean(parts, axis=0).reshape(-1, 3)


def test_needs_are_measured_where_lamps_are_met_and_foretold_elsewhere() -> None:
    trial = trial_of()
    often, needs = trial.grid.met >= OFTEN, trial.needs(REST, FLOOR)
    shares = blurred(trial.larger.mean) * trial.seen[:, None]
    level = np.where(often[:, None], trial.grid.mean, shares * trial.grid.mean[~often].sum() / shares[~often].sum())
    np.testing.assert_allclose(trial.level, level)
    level2 = (REST + level) ** 2 + FLOOR
    own = (trial.grid.variance / level2).mean(axis=1)
    np.testing.assert_allclose(needs.errors[often], own[often])
    assert needs.errors[~often].sum() == pytest.approx(own[~often].sum())
    root = np.sqrt((shares / np.sqrt(level2)).mean(axis=1))
    foretold = root * own[~often].sum() / root[~often].sum()
    np.testing.assert_allclose(needs.errors[~often], foretold[~often], atol=1e-6)
    column = np.arange(COUNT) % SHAPE[1]
    assert not needs.errors[column == 7].any() and (needs.errors[(column == 4) | (column == 8)] > 0).all()
    assert needs.least is trial.least and needs.most == MOST_LOOKS * trial.seen.sum()
    assert needs.each == pytest.approx(0.01) and needs.images == pytest.approx(0.3)


@pytest.mark.parametrize("power, taken", [(0.5, AT_RANDOM), (2.4, 2.4), (5.0, EVEN)])
def test_the_power_of_the_side_is_measured_where_lamps_are_mostly_met(power: float, taken: float) -> None:
    trial = trial_of(power)
    needs, mostly = trial.needs(REST, FLOOR), trial.grid.met >= MOSTLY
    np.testing.assert_allclose(needs.powers[mostly], taken)
    assert (needs.powers[~mostly] == AT_RANDOM).all() and 0 < mostly.sum() < (trial.grid.met >= OFTEN).sum()


def test_nothing_met_needs_nothing() -> None:
    made, none = trial_of(), np.zeros((COUNT, 3))
    blind = LampPasses(none, none, np.zeros(COUNT, np.int64), 1.0)
    for larger in (blind, made.larger):
        needs = trial_of(grid=blind, single=blind, larger=larger).needs(REST, FLOOR)
        assert not needs.errors.any() and (needs.powers == AT_RANDOM).all()
        assert (needs.best(1.0, 9.0)[1] == made.least).all()


@pytest.mark.parametrize("faint", [0.0, 1e-20])
def test_what_larger_lamps_do_not_tell_is_as_measured(faint: float) -> None:
    """A lamp whose middle is hidden is none of them: where it is met seldom no pixel, or hardly any, has a share."""
    made = trial_of()
    often = made.grid.met >= OFTEN
    larger = np.where(often[:, None], 2.0, np.zeros((COUNT, 3)))
    around = blurred(larger).any(axis=1)
    larger[np.flatnonzero(~often & ~around)[0]] = faint
    seen = often | ~around  # a pixel beside those that are often met would share with them
    trial = trial_of(larger=LampPasses(larger, 0 * larger, made.grid.met, 1.0), seen=seen)
    needs = trial.needs(REST, FLOOR)
    own = (made.grid.variance / ((REST + trial.level) ** 2 + FLOOR)).mean(axis=1)
    assert needs.errors[~often].sum() == pytest.approx(own[~often].sum())
    assert needs.errors.max() <= max(own.max(), own[~often].sum())
    if not faint:
        np.testing.assert_allclose(needs.errors, own)


GLINTS = (3, 4, 5, 6)
"""Columns of pixels where lamps are seldom met."""


@pytest.mark.parametrize("pixels, promised", [(20, 2), (20, 320), (1, 2)])
def test_glints_too_rare_to_be_met_are_looked_for_as_larger_lamps_tell(pixels: int, promised: int) -> None:
    """As far as these are sure of it, as the sum of one pixel is not, and as real lamps do not belie them: none of the
    hits that they promised came."""
    grid = trial_of().grid
    often = grid.met >= OFTEN
    blind = LampPasses(grid.mean * often[:, None], grid.variance * often[:, None], grid.met * often, 1.0)
    glint = np.flatnonzero(np.isin(np.arange(COUNT) % SHAPE[1], GLINTS))[:pixels]
    larger, variance = np.zeros((2, COUNT, 3))
    larger[glint], variance[glint] = 1.0, 700.0
    met = np.zeros(COUNT, np.int64)
    met[glint] = promised / pixels * (LARGER_PASSES * LARGER**2) / (TRIED * SIGHT_SIDE**2)
    trial = trial_of(grid=blind, larger=LampPasses(larger, variance, met, 1.0))
    errors = trial.needs(REST, FLOOR).errors[~often]
    told = (variance / ((REST + trial.level) ** 2 + FLOOR)).mean(axis=1)[~often] / (LARGER * SIGHT_SIDE) ** 2
    least = told.sum() - SURE * np.sqrt(np.square(told).sum())
    assert errors.sum() == pytest.approx(max(0.0, least) * min(1.0, OFTEN / promised), rel=0.05)
    assert (errors.sum() > 0) == (pixels > 1)


def test_a_trial_finds_what_the_looks_find(black: Found) -> None:
    sight = with_images(looks_of(SIGHT_SIDE * black.sight.sides), black.images, SIDE, SIDE)
    common = black.prepared.data, black.prepared.traced, black.camera
    trial = try_looks(*common, sight, Film(width=SIDE, height=SIDE), 1)
    wide = black.looks_by(with_larger_lamps(at_most(sight, 1), black.prepared.data), 100)
    np.testing.assert_array_equal(trial.seen, sight.sides > 0)
    np.testing.assert_array_equal(trial.least, np.diff(sight.first) > 0 if sight.knows_images else np.zeros(SLOTS))
    ratio = trial.larger.mean.sum() / wide.mean(axis=0).sum()
    assert ratio == pytest.approx(1, abs=5 / np.sqrt(LARGER_PASSES * SLOTS))
    needs = trial.needs(np.zeros((SLOTS, 3)), FLOOR)
    assert needs.rays(trial.seen.astype(np.uint8)) == pytest.approx(trial.single.rays)
    bright = trial.grid.met == trial.grid.met.max()
    assert trial.grid.met.max() >= MOSTLY and not trial.grid.mean[~trial.seen].any()
    np.testing.assert_allclose(trial.grid.mean[bright].sum(), trial.single.mean[bright].sum(), rtol=0.5)
    _, sides = needs.best(0.1, 30.0)
    assert sides.any() and not sides[~trial.seen].any() and (sides >= trial.least).all()
    none = try_looks(*common, seen_in_passing(), Film(width=SIDE, height=SIDE), 1)
    assert not none.seen.any() and not none.least.any() and not none.needs(np.zeros((SLOTS, 3)), FLOOR).errors.any()


def test_a_trial_knows_the_variance_of_a_pass(tmp_path: Path) -> None:
    """A single look sees all of the only lamp or nothing."""
    found = find(HEAD + LAMP % ([0, 0, 0], 0.25, [7, 7, 7]), tmp_path)
    sight = looks_of(SIGHT_SIDE * found.sight.sides)
    single = try_looks(
        found.prepared.data, found.prepared.traced, found.camera, sight, Film(width=SIDE, height=SIDE), 1
    ).single
    found.prepared.embree.close()
    chance = single.met / TRIED
    assert ((chance > 0) & (chance < 1)).sum() > 10
    np.testing.assert_allclose(single.mean, 7 * chance[:, None].repeat(3, axis=1))
    np.testing.assert_allclose(single.variance[:, 1], 49 * chance * (1 - chance) * TRIED / (TRIED - 1), atol=1e-9)


def test_sides_on_another_film() -> None:
    sides = np.random.default_rng(6).integers(0, 9, (5, 8)).astype(np.uint8)

    def on(width: int, height: int) -> np.ndarray:
        moved = sides_on_other_film(sides.ravel(), (8, 5), (width, height))
        assert moved.shape == (width * height,) and moved.dtype == np.uint8
        return moved.reshape(height, width)

    np.testing.assert_array_equal(on(8, 5), sides)
    np.testing.assert_array_equal(on(16, 10), sides.repeat(2, axis=0).repeat(2, axis=1))
    np.testing.assert_array_equal(on(12, 5), np.pad(sides, ((0, 0), (2, 2)), "edge"))
    np.testing.assert_array_equal(on(4, 5), sides[:, 2:6])
    np.testing.assert_array_equal(on(20, 10), np.pad(on(16, 10), ((0, 0), (2, 2)), "edge"))
    x, y = (
        np.abs(((np.arange(b) + 0.5 - b / 2) / 9)[:, None] - (np.arange(a) + 0.5 - a / 2) / 5).argmin(axis=1)
        for a, b in ((8, 14), (5, 9))
    )
    np.testing.assert_array_equal(on(14, 9), sides[np.ix_(y, x)])


def prepared_for(scene: Path, *settings: str) -> Forecasting:
    config = load_config(CORNELL, [f"scene={scene}", "forecast.photons=20000", *settings])
    made = share_scene(SerialWorld(), load_scene(scene))
    camera = camera_array(made.data.camera, config.film.width, config.film.height)
    return prepare_method(SerialWorld(), config, made, camera, Stopwatch())[1]


def test_a_pilot_chooses_the_same_sides_again(tmp_path: Path) -> None:
    scene = write_scene(build("box", {"light": 0.1}), tmp_path / "box.yaml")
    once, again = (prepared_for(scene, "film.width=128", "film.height=96") for _ in range(2))
    assert once.plan is not None and again.plan is not None and len(np.unique(once.plan.sides)) > 2
    np.testing.assert_array_equal(once.plan.sides, again.plan.sides)
    np.testing.assert_array_equal(once.sight.sides, again.sight.sides)
    assert once.sight.sides.shape == (128 * 96,)
