"""The interval of the estimated error: groups add up to what the film knows, and intervals hold the truth as stated."""

import math

import numpy as np
import pytest

from causticmpi.output.picture import RELMSE_FLOOR, estimated_relmse
from causticmpi.render.film import Film, resolve
from causticmpi.render.precision import CONFIDENCE, FEWEST_GROUPS, Precision, spread_factor

RUNS, SLOTS, WIDTH = 200, 64, 8


MEAN, SPREAD = 3.0, 0.5


def run(random: np.random.Generator, passes: int) -> tuple[float, Precision]:
    """A picture of normal passes about MEAN whose deviation varies from pass to pass, as with shared virtual lights."""
    film, precision = Film(SLOTS, 2.0**-36), Precision(WIDTH)
    for _ in range(passes):
        deviation = math.exp(SPREAD * random.normal())
        one = np.zeros((SLOTS, 6), np.float32)
        one[:, :3] = MEAN + deviation * random.normal(size=(SLOTS, 3))
        film.add_pass(one)
        film.passes += 1
        if precision.due(film.passes):
            precision.take(film.sums, film.passes, RELMSE_FLOOR)
    diffusive, caustic, variance = resolve(film.sums, film.passes)
    return estimated_relmse(diffusive + caustic, variance), precision


def test_groups_say_what_the_film_says() -> None:
    """Where noise is low the mean's own error does not matter: both estimates agree, but for the first group."""
    estimate, precision = run(np.random.default_rng(1), 500)
    done = precision.first + sum(precision.passes)
    assert precision.error is not None and len(precision.passes) >= 12 and done <= 500 < 1.2 * done
    assert precision.error == pytest.approx(estimate * 500 / done, rel=0.1)


def level_by_hand(before: np.ndarray) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) from passes (n, HEIGHT, WIDTH, 3): each mean drawn to that of its square, as noise has it."""
    mean, noise = before.mean(axis=0), before.var(axis=0, ddof=1) / len(before)
    made = np.zeros_like(mean)
    for y, x in np.ndindex(mean.shape[:2]):
        square = np.s_[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
        around, own = mean[square].mean(axis=(0, 1)), (mean[y, x] - mean[square].mean(axis=(0, 1))) ** 2
        explained = np.maximum(noise[y, x], noise[square].mean(axis=(0, 1)))
        made[y, x] = around + (mean[y, x] - around) * own / (own + explained)
    return made


@pytest.mark.parametrize("width", [WIDTH, 1, SLOTS])
def test_a_group_by_hand(width: int) -> None:
    """The variance of the second group's passes, relative to the level of the first."""
    random = np.random.default_rng(2)
    values = random.exponential(1.0, (30, SLOTS, 6)).astype(np.float32)
    film, precision = Film(SLOTS, 2.0**-36), Precision(width)
    for n, value in enumerate(values, 1):
        film.add_pass(value.copy())
        if n in (20, 30):
            precision.take(film.sums, n, RELMSE_FLOOR)
    total = (values[..., :3].astype(np.float64) + values[..., 3:]).reshape(30, SLOTS // width, width, 3)
    expected = (total[20:].var(axis=0, ddof=1) / (level_by_hand(total[:20]) ** 2 + RELMSE_FLOOR)).mean()
    assert precision.errors == [pytest.approx(expected, rel=1e-6)] and precision.passes == [10]
    assert precision.known is None and FEWEST_GROUPS > 1


def test_a_group_with_traced_light_by_hand() -> None:
    """Light paths have squares of their own: variances and noise add up."""
    random = np.random.default_rng(5)
    eye = random.exponential(1.0, (30, SLOTS, 6)).astype(np.float32)
    light = random.exponential(0.5, (30, SLOTS, 3)).astype(np.float32)
    film, precision = Film(SLOTS, 2.0**-36, light=True), Precision(WIDTH)
    for n in range(30):
        film.add_pass(eye[n].copy())
        film.add_light(light[n].copy())
        if n + 1 in (20, 30):
            precision.take(film.sums, n + 1, RELMSE_FLOOR)
    parts = [(eye[..., :3].astype(np.float64) + eye[..., 3:]), light.astype(np.float64)]
    parts = [part.reshape(30, SLOTS // WIDTH, WIDTH, 3) for part in parts]
    variance = sum(part[20:].var(axis=0, ddof=1) for part in parts)
    mean = sum(part[:20].mean(axis=0) for part in parts)
    noise = sum(part[:20].var(axis=0, ddof=1) for part in parts) / 20
    # Two passes of the same mean and noise as 20 of the two parts together.
    alike = np.stack([mean - np.sqrt(noise), mean + np.sqrt(noise)])
    expected = (variance / (level_by_hand(alike) ** 2 + RELMSE_FLOOR)).mean()
    assert precision.errors == [pytest.approx(expected, rel=1e-6)]


@pytest.mark.statistical
def test_a_level_from_few_passes_does_not_make_the_error_look_large() -> None:
    """One pass in five shows light: 1 / R^2 of a mean of few passes is too large by more than half."""
    random, passes = np.random.default_rng(6), 64
    found, plain = [], []
    for _ in range(RUNS):
        film, precision = Film(SLOTS, 2.0**-36), Precision(WIDTH)
        values = np.where(random.random((passes, SLOTS, 3)) < 0.2, 5.0, 0.0)
        for value in values:
            film.add_pass(np.concatenate([value, np.zeros_like(value)], axis=1).astype(np.float32))
            film.passes += 1
            if precision.due(film.passes):
                precision.take(film.sums, film.passes, RELMSE_FLOOR)
        found.append(np.average(precision.errors, weights=precision.passes))
        ends = np.cumsum([precision.first, *precision.passes])
        errors = [
            (values[a:b].var(axis=0, ddof=1) / (values[:a].mean(axis=0) ** 2 + RELMSE_FLOOR)).mean()
            for a, b in zip(ends, ends[1:], strict=False)
        ]
        plain.append(np.average(errors, weights=precision.passes))
    truth = 5.0**2 * 0.2 * 0.8 / (1 + RELMSE_FLOOR)
    print(
        f"\nestimate {np.mean(found) / truth:.2f}, by each pixel's own level {np.mean(plain) / truth:.2f} of the truth"
    )
    assert truth < np.mean(found) < 1.4 * truth
    assert np.mean(plain) > 2 * truth


@pytest.mark.statistical
def test_fireflies_do_not_make_the_error_look_small() -> None:
    """One pass in 200 is 100 times as bright. The picture's own mean in the denominator hides a quarter of the error;
    the mean of the passes before, which is mostly too dark, errs to the safe side."""
    random, passes, runs = np.random.default_rng(4), 256, 40
    found, own = [], []
    for _ in range(runs):
        film, precision = Film(SLOTS, 2.0**-36), Precision(WIDTH)
        for _ in range(passes):
            one = np.zeros((SLOTS, 6), np.float32)
            one[:, :3] = np.where(random.random((SLOTS, 1)) < 1 / 200, 100, 1)
            film.add_pass(one)
            film.passes += 1
            if precision.due(film.passes):
                precision.take(film.sums, film.passes, RELMSE_FLOOR)
        diffusive, caustic, variance = resolve(film.sums, film.passes)
        own.append(estimated_relmse(diffusive + caustic, variance))
        assert precision.error is not None
        found.append(precision.error * (precision.first + sum(precision.passes)) / passes)
    mean = 1 + 99 / 200
    truth = 99**2 * (1 / 200) * (1 - 1 / 200) / passes / (mean**2 + RELMSE_FLOOR)
    print(f"\nestimate {np.mean(found) / truth:.2f}, by its own mean {np.mean(own) / truth:.2f} of the truth")
    assert np.mean(own) < 0.75 * truth
    assert truth < np.mean(found) < 2 * truth


@pytest.mark.statistical
def test_coverage_where_errors_of_groups_are_normal() -> None:
    """Of 200 intervals so many hold the truth as 95 % allows within 3.3 standard errors."""
    random, passes = np.random.default_rng(3), 200
    truth = math.exp(2 * SPREAD**2) / passes / (MEAN**2 + RELMSE_FLOOR)
    held = 0
    for _ in range(RUNS):
        _, precision = run(random, passes)
        assert precision.known is not None
        estimate, factor = precision.known
        estimate *= (precision.first + sum(precision.passes)) / passes
        held += abs(math.log(estimate / truth)) <= math.log(factor)
    print(f"\n{held} of {RUNS} hold the truth")
    assert abs(held / RUNS - CONFIDENCE) < 3.3 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) / RUNS)


def test_no_interval_from_few_groups_and_none_needed_without_noise() -> None:
    assert spread_factor(np.ones(FEWEST_GROUPS - 1), np.ones(FEWEST_GROUPS - 1)) is None
    assert spread_factor(np.ones(8), np.ones(8)) == 1.0
    assert spread_factor(np.zeros(8), np.ones(8)) == 1.0
