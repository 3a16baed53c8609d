"""The interval of the estimated error: groups add up to what the film knows, and intervals hold the truth as stated."""

import math

import numpy as np
import pytest

from causticmpi.output.picture import RELMSE_FLOOR, estimated_relmse
from causticmpi.render.film import Film, resolve
from causticmpi.render.precision import CONFIDENCE, FEWEST_GROUPS, Precision, spread_factor

RUNS, SLOTS = 200, 64


MEAN, SPREAD = 3.0, 0.5


def run(random: np.random.Generator, passes: int) -> tuple[float, Precision]:
    """A picture of normal passes about MEAN whose deviation varies from pass to pass, as with shared virtual lights."""
    film, precision = Film(SLOTS, 2.0**-36), Precision()
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


def test_a_group_by_hand() -> None:
    """The variance of the second group's passes, relative to the mean of the first."""
    random = np.random.default_rng(2)
    values = random.exponential(1.0, (30, SLOTS, 6)).astype(np.float32)
    film, precision = Film(SLOTS, 2.0**-36), Precision()
    for n, value in enumerate(values, 1):
        film.add_pass(value.copy())
        if n in (20, 30):
            precision.take(film.sums, n, RELMSE_FLOOR)
    total = values[..., :3].astype(np.float64) + values[..., 3:]
    expected = (total[20:].var(axis=0, ddof=1) / (total[:20].mean(axis=0) ** 2 + RELMSE_FLOOR)).mean()
    assert precision.errors == [pytest.approx(expected, rel=1e-6)] and precision.passes == [10]
    assert precision.known is None and FEWEST_GROUPS > 1


@pytest.mark.statistical
def test_fireflies_do_not_make_the_error_look_small() -> None:
    """One pass in 200 is 100 times as bright. The picture's own mean in the denominator hides a quarter of the error;
    the mean of the passes before, which is mostly too dark, errs to the safe side."""
    random, passes, runs = np.random.default_rng(4), 256, 40
    found, own = [], []
    for _ in range(runs):
        film, precision = Film(SLOTS, 2.0**-36), Precision()
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
