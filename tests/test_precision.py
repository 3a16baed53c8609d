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
    """The mean of the groups' errors is that of all passes, but for the variance between groups and early means."""
    estimate, precision = run(np.random.default_rng(1), 500)
    done = sum(precision.passes)
    mean = float(np.average(precision.errors, weights=precision.passes)) / done
    assert len(precision.passes) >= 15 and done <= 500 < 1.2 * done
    assert mean == pytest.approx(estimate * 500 / done, rel=0.1)


def test_a_group_alone_is_the_film_alone() -> None:
    random = np.random.default_rng(2)
    film, precision = Film(SLOTS, 2.0**-36), Precision()
    for _ in range(20):
        film.add_pass(random.exponential(1.0, (SLOTS, 6)).astype(np.float32))
        film.passes += 1
    precision.take(film.sums, 20, RELMSE_FLOOR)
    diffusive, caustic, variance = resolve(film.sums, 20)
    assert precision.errors[0] == pytest.approx(20 * estimated_relmse(diffusive + caustic, variance), rel=1e-9)
    assert precision.factor is None and FEWEST_GROUPS > 1


@pytest.mark.statistical
def test_coverage_where_errors_of_groups_are_normal() -> None:
    """Of 200 intervals so many hold the truth as 95 % allows within 3.3 standard errors."""
    random, passes = np.random.default_rng(3), 200
    truth = math.exp(2 * SPREAD**2) / passes / (MEAN**2 + RELMSE_FLOOR)
    held = 0
    for _ in range(RUNS):
        estimate, precision = run(random, passes)
        assert precision.factor is not None
        held += abs(math.log(estimate / truth)) <= math.log(precision.factor)
    print(f"\n{held} of {RUNS} hold the truth")
    assert abs(held / RUNS - CONFIDENCE) < 3.3 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) / RUNS)


def test_no_interval_from_few_groups_and_none_needed_without_noise() -> None:
    assert spread_factor(np.ones(FEWEST_GROUPS - 1), np.ones(FEWEST_GROUPS - 1)) is None
    assert spread_factor(np.ones(8), np.ones(8)) == 1.0
    assert spread_factor(np.zeros(8), np.ones(8)) == 1.0
