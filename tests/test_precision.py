"""The interval of the estimated error: groups add up to what the film knows, and intervals hold the truth as stated."""

import math

import numpy as np
import pytest

from causticmpi.output.picture import RELMSE_FLOOR, estimated_relmse
from causticmpi.render.film import Film, resolve
from causticmpi.render.precision import CONFIDENCE, FEWEST_GROUPS, Precision, spread_factor

RUNS, SLOTS = 400, 64


def run(random: np.random.Generator, passes: int, scale: float = 0.3) -> tuple[float, Precision]:
    """A picture of exponential passes of mean 1; a common factor makes whole passes vary, as virtual lights do."""
    film, precision = Film(SLOTS, 2.0**-36), Precision()
    for _ in range(passes):
        common = 1 + scale * random.normal()
        film.add_pass((common * random.exponential(1.0, (SLOTS, 6)) / 2).astype(np.float32))
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
    """Between 92 and 98 % of 400 intervals hold the truth, three standard errors about 95 %."""
    random = np.random.default_rng(3)
    passes, scale = 200, 0.3
    mean_square = (1 + scale**2) * (0.25 * 2 * 2 + 0.25 * 2)  # of the sum of two exponentials of mean 1/2
    truth = (mean_square - 1) / passes / (1 + RELMSE_FLOOR)
    held = 0
    for _ in range(RUNS):
        estimate, precision = run(random, passes, scale)
        assert precision.factor is not None
        held += abs(math.log(estimate / truth)) <= math.log(precision.factor)
    print(f"\n{held} of {RUNS} hold the truth")
    assert abs(held / RUNS - CONFIDENCE) < 3.3 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) / RUNS)


def test_no_interval_from_few_groups_and_none_needed_without_noise() -> None:
    assert spread_factor(np.ones(FEWEST_GROUPS - 1), np.ones(FEWEST_GROUPS - 1)) is None
    assert spread_factor(np.ones(8), np.ones(8)) == 1.0
    assert spread_factor(np.zeros(8), np.ones(8)) == 1.0
