"""Stopping at a wanted error must not bend the picture: halves that stop each other, on a toy of rare bright passes.

The toy is bright (100) with one pass in 50, else dim, as a rare caustic path makes a pixel. Stopping by the
whole picture's own error, known to be wrong, shows its bias in the same harness.
"""

from collections.abc import Callable

import numpy as np
import pytest

from causticmpi.distributed.until import EARLIEST, FIRST, Until
from causticmpi.output.picture import estimated_relmse
from causticmpi.render.film import CHANNELS, resolve
from causticmpi.render.precision import FEWEST_GROUPS

RUNS, MOST = 8000, 1024
ASKED = [n for n in range(1, MOST + 1) if Until(1, 1).asks(n)]
SECOND = np.array([Until(1, 1).half(i) for i in range(MOST)], bool)
DIM, BRIGHT, RARE = 1.0, 100.0, 1 / 50
TRUTH = DIM + RARE * (BRIGHT - DIM)
TARGET = 0.05
CERTAIN = 4.0
"""Standard errors: a right rule exceeds them with 1 seed of 16 000."""


def sums_of(values: np.ndarray) -> np.ndarray:
    """Film sums (1, 12) of passes that show these values in one pixel; the low part of the squares is left out."""
    sums = np.zeros((1, CHANNELS))
    sums[0, :3], sums[0, 6:9] = values.sum(), (values**2).sum()
    return sums


def mean_of(parts: list[tuple[np.ndarray, int]]) -> float:
    return float(np.mean([resolve(sums, n)[0][0, 0] for sums, n in parts]))


def each_other(values: np.ndarray) -> tuple[float, int]:
    """The program's rule: the picture, and the passes of the run."""
    rule = Until(TARGET, 1)
    for n in ASKED:
        whole, second = sums_of(values[:n]), sums_of(values[:n][SECOND[:n]])
        if rule.decide(whole, second, n):
            break
    return mean_of(list(rule.parts(whole, second, n))), n


def own_error(values: np.ndarray) -> tuple[float, int]:
    """Known to be wrong: stop as soon as the picture looks good."""
    for n in ASKED:
        diffusive, caustic, variance = resolve(sums_of(values[:n]), n)
        if estimated_relmse(diffusive + caustic, variance) <= TARGET:
            break
    return mean_of([(sums_of(values[:n]), n)]), n


def bias(estimate: Callable[[np.ndarray], tuple[float, int]]) -> tuple[float, float, float]:
    """Mean relative error of the runs, its standard error, and how many passes they took."""
    random = np.random.default_rng(5)
    found = [estimate(np.where(random.random(MOST) < RARE, BRIGHT, DIM)) for _ in range(RUNS)]
    means = np.array([mean for mean, _ in found]) / TRUTH - 1
    error = float(means.std(ddof=1) / np.sqrt(RUNS))
    passes = float(np.mean([n for _, n in found]))
    print(f"\nbias {100 * means.mean():+.2f} +- {100 * error:.2f} %, {passes:.0f} passes")
    return float(means.mean()), error, passes


@pytest.mark.statistical
def test_halves_that_stop_each_other_are_unbiased() -> None:
    found, error, _ = bias(each_other)
    assert abs(found) < CERTAIN * error


@pytest.mark.statistical
def test_stopping_by_its_own_error_shows() -> None:
    """Dark by a third and more: runs that saw no bright pass stop at once."""
    found, error, _ = bias(own_error)
    assert found < -0.3 and abs(found) > CERTAIN * error


def test_halves_alternate_in_blocks_and_are_equal_when_asked() -> None:
    rule = Until(0.01, 1)
    halves = [rule.half(i) for i in range(5000)]
    asked = [n for n in range(1, 5000) if Until(0.01, 1).asks(n)]
    assert asked[0] == 2 * FIRST and len(asked) > 20
    for n in asked:
        assert sum(halves[:n]) == n // 2
    assert all(b <= max(1.35 * a, a + 6) for a, b in zip(asked, asked[1:], strict=False))


def test_rounds_end_at_the_border_of_a_half() -> None:
    rule = Until(0.01, 1)
    for start in range(300):
        length = rule.to_border(start)
        assert length >= 1
        assert len({rule.half(i) for i in range(start, start + length)}) == 1
        assert rule.half(start + length) != rule.half(start)


def frozen(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Copies that nobody may write, as those from a file."""
    copies = {name: array.copy() for name, array in arrays.items()}
    for array in copies.values():
        array.flags.writeable = False
    return copies


def test_remarks() -> None:
    rule = Until(0.01, 1)
    assert rule.remark(EARLIEST - 1) == f" (wanted: 0.01, not asked for before {EARLIEST} passes)"
    assert rule.remark(EARLIEST) == " (wanted: 0.01)"


def test_parts() -> None:
    """One picture of all passes where both halves end at once, two of their own lengths where they do not."""
    quiet, loud = np.array([1.0, 1.001] * 100), np.array([1.0, 60.0] * 100)

    def run(
        first: np.ndarray, second: np.ndarray, passes: int, stops: bool = False
    ) -> tuple[Until, bool, list[tuple[np.ndarray, int]]]:
        rule, over = Until(1e-4, 1), False
        for n in [n for n in range(1, passes + 1) if Until(1, 1).asks(n)]:
            if stops:
                rule = Until(1e-4, 1, frozen(rule.kept(sums_of(second))))
            a, b = sums_of(first[: n // 2]), sums_of(second[: n // 2])
            over = rule.decide(a + b, b, n)
            if over:
                break
        a, b = sums_of(first[: passes // 2]), sums_of(second[: passes // 2])
        return rule, over, list(rule.parts(a + b, b, passes))

    soon = [n for n in range(1, 100) if Until(1, 1).asks(n)][FEWEST_GROUPS]  # the first question with an answer
    _, over, parts = run(quiet, quiet, 200)
    assert over and [n for _, n in parts] == [soon] and soon == EARLIEST
    # The first half is good at once and ends the second; the second never is, so the first goes on to the last pass.
    asked = [n for n in range(1, 100) if Until(1, 1).asks(n)][-1]
    _, over, parts = run(quiet, loud, asked)
    assert not over and [n for _, n in parts] == [asked // 2, soon // 2]
    assert mean_of(parts) == pytest.approx((quiet[: asked // 2].mean() + loud[: soon // 2].mean()) / 2)
    _, over, parts = run(loud, loud, asked)
    assert not over and [n for _, n in parts] == [asked]
    # Kept and taken up again at every question: the same parts.
    for kinds in ((quiet, quiet), (quiet, loud), (loud, quiet), (loud, loud)):
        _, kept_over, kept_parts = run(*kinds, asked, stops=True)
        _, over, parts = run(*kinds, asked)
        assert kept_over == over and len(kept_parts) == len(parts)
        for (sums, n), (wanted, wanted_n) in zip(kept_parts, parts, strict=True):
            assert n == wanted_n and np.array_equal(sums, wanted)
    # Ended by something else in the middle of a block: the other half counts what it has.
    rule, _, _ = run(quiet, loud, asked)
    for passes in range(asked, 200):
        first, second = rule.parts(sums_of(quiet), sums_of(loud), passes)
        assert first[1] == passes - sum(rule.half(i) for i in range(passes)) and second[1] == soon // 2
