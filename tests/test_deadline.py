"""A time budget must not bend the picture: which rule for the last round is unbiased, on a toy whose cost is its value.

The toy's passes take as long as they are bright (exponential, mean 1), which no scene does but which lays bare any rule
that prefers cheap passes. Real dealing, batches, films and the run's own loop are driven by a clock that the toy winds
on. Known-bad rules show their bias in the same harness: were the good one bad, it would show.

Why merging whole rounds of EQUAL length is exact, the first always finished: that k rounds were merged says that their
costs sum up to less than the budget and those of k + 1 do not, which is symmetric in the first k rounds. So given k the
expected mean of the merged rounds is that of the first one, and so over all k.
"""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from rendering import make_config

from causticmpi.distributed import budget_clock
from causticmpi.distributed import run as run_module
from causticmpi.distributed.budget_clock import BudgetClock
from causticmpi.distributed.films import Films
from causticmpi.distributed.until import Until
from causticmpi.distributed.world import SerialWorld
from causticmpi.render import rounds
from causticmpi.render.film import Film
from causticmpi.render.rounds import Batches, divide

pytestmark = pytest.mark.statistical
TILES = 4
PIXELS = np.zeros((16 * TILES, 4), np.int32)
QUANTUM = 2.0**-40
BUDGET = 15.0
"""Seconds of the toy, whose passes take 1 s on average."""
RUNS = 5000
CERTAIN = 4.0
"""Standard errors: a right rule exceeds them with 1 seed of 16 000."""


class Clock:
    """In place of the `time` module: seconds pass where the toy says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.now

    def monotonic(self) -> float:
        return self.now


class Toy:
    """A method whose pass i takes value[i] seconds and shows value[i] in every pixel."""

    light_paths = 0

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.value = np.zeros(0)
        self.pass_index = 0

    def begin_pass(self, pass_index: int) -> int:
        self.pass_index = pass_index
        return 0

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        share = len(pixels) / len(PIXELS)
        self.clock.now += self.value[self.pass_index] * share
        film[0, 0] += np.float32(self.value[self.pass_index] * share)
        return 0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(rounds, "time", made)
    monkeypatch.setattr(budget_clock, "time", made)
    monkeypatch.setattr(run_module, "time", made)
    return made


def bias(estimate: Callable[[np.ndarray], float], passes: int, runs: int = RUNS) -> tuple[float, float]:
    """Mean error of the estimates of a mean of 1, and its standard error.

    The mean of the first `passes` values, whose expectation is known, takes most of the noise away (control variate).
    """
    random = np.random.default_rng(3)
    values = random.exponential(1.0, (runs, 40 * passes))
    found = np.array([estimate(v) for v in values])
    control = values[:, :passes].mean(axis=1) - 1
    left = found - np.cov(found, control)[0, 1] / control.var(ddof=1) * control
    error = float(left.std(ddof=1) / np.sqrt(runs))
    print(f"\nbias {100 * (left.mean() - 1):+.2f} +- {100 * error:.2f} %")
    return float(left.mean() - 1), error


class SerialRun(run_module.Run):
    """The run's own loop and decisions, without a scene, files or a terminal."""

    def __init__(self, toy: Toy, budget: float, length: int = 1, until: Until | None = None) -> None:
        self.length, self.until = length, until
        self.world, self.flag = SerialWorld(), SimpleNamespace(raised=0)
        self.config = make_config(method="pt", budget={"time": budget})
        self.watch = SimpleNamespace(elapsed=lambda: 0.0, add=lambda name, seconds: None)
        self.pixels, self.limit, self.reserve = PIXELS, budget, 0.0
        self.films = Films(SerialWorld(), 1, QUANTUM, light=False, halves=until is not None)
        self.film, self.pending = self.films.merged, self.films.pending
        self.batches = Batches(toy, PIXELS, 1)
        self.rounds = self.stopped_by = 0
        self.snapshots = self.state = None
        self.clock = BudgetClock(None)

    def _say(self, stage: str) -> None: ...

    def _round_length(self) -> int:
        return self.length  # the pilot would wind the toy's clock on

    def _good_enough(self) -> bool:
        return False  # the time is over first

    def _time_for_tracing(self) -> float:
        return self.limit

    def _show_progress(self) -> None: ...

    def _writing_due(self, round_seconds: float) -> tuple[bool, bool]:
        return False, False


def test_the_run_itself(clock: Clock) -> None:
    """The real loop, on one rank."""
    toy = Toy(clock)

    def estimate(value: np.ndarray) -> float:
        clock.now, toy.value = 0.0, value
        run = SerialRun(toy, BUDGET)
        run.trace()
        return run.film.sums[0, 0] / run.film.passes

    found, error = bias(estimate, 14, 4 * RUNS)
    assert abs(found) < CERTAIN * error
    assert error < 0.002


class StoppedRun(SerialRun):
    """Stopped by a signal after half the budget, or going on from where such a run was stopped."""

    def __init__(self, toy: Toy, before: "StoppedRun | None" = None) -> None:
        super().__init__(toy, BUDGET)
        if before is None:
            self.flag = HalfTime(toy.clock)
            return
        self.state = SimpleNamespace(
            passes=before.film.passes,
            rounds=before.rounds,
            tracing=before.clock.tracing_kept,
            writing=before.clock.written_for,
            covers=lambda budget: False,
        )
        self.clock = BudgetClock(self.state)
        self.film.merge(before.film)
        self.arrays_before = None


class HalfTime:
    """A signal that comes when half the budget is spent."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    @property
    def raised(self) -> int:
        return 15 if self.clock.now > BUDGET / 2 else 0


def test_a_resumed_run(clock: Clock) -> None:
    """Stopped in the middle of a round, which is dropped and traced anew by the next start: none the wiser, whatever
    the cost of the rounds before the stop."""
    toy = Toy(clock)

    def estimate(value: np.ndarray) -> float:
        clock.now, toy.value = 0.0, value
        first = StoppedRun(toy)
        first.trace()
        clock.now = 0.0
        second = StoppedRun(toy, first)
        second.trace()
        assert second.film.passes >= first.film.passes
        return second.film.sums[0, 0] / second.film.passes

    found, error = bias(estimate, 14, 2 * RUNS)
    assert abs(found) < CERTAIN * error
    assert error < 0.003


def test_rounds_that_end_at_known_borders(clock: Clock) -> None:
    """Rounds of three passes, shorter where a half of the passes ends (distributed.until): unlike, but known before."""
    toy = Toy(clock)

    def estimate(value: np.ndarray) -> float:
        clock.now, toy.value = 0.0, value
        run = SerialRun(toy, 2 * BUDGET, 3, Until(1e-9, 1))
        run.trace()
        return run.film.sums[0, 0] / run.film.passes

    found, error = bias(estimate, 27)
    assert abs(found) < CERTAIN * error
    assert error < 0.003


@pytest.mark.parametrize(("size", "passes"), [(1, 1), (1, 2), (4, 4), (4, 1), (3, 2)])
def test_equal_rounds(clock: Clock, size: int, passes: int) -> None:
    """Rounds of `passes` passes handed out to `size` ranks as they come free; dropped whole if any rank is late."""
    toy = Toy(clock)
    film, pending = Film(1, QUANTUM), Film(1, QUANTUM)
    budget = 12.0 * passes / size
    batches = Batches(toy, PIXELS, 1)

    def estimate(value: np.ndarray) -> float:
        began, toy.value = 0.0, value
        film.clear()
        while True:
            whole, ends = True, [began] * size
            pending.clear()
            for share in divide(film.passes, passes, TILES, size):
                clock.now = min(ends)
                late = (lambda: clock.now > budget) if film.passes else (lambda: False)
                whole = batches.trace([share], pending, late) and whole
                ends[ends.index(min(ends))] = clock.now
            began = max(ends)
            if not whole:
                break
            film.merge(pending)
            film.passes += passes
            if began > budget:
                break
        return film.sums[0, 0] / film.passes

    found, error = bias(estimate, 8 * passes)
    assert abs(found) < CERTAIN * error
    assert error < 0.005


def finish_the_running_pass(value: np.ndarray) -> float:
    return value[: np.searchsorted(value.cumsum(), BUDGET) + 1].mean()


def start_none_that_would_not_fit(value: np.ndarray) -> float:
    ends = value.cumsum()
    passes = 1
    while ends[passes - 1] * (1 + 1 / passes) <= BUDGET:  # as long as the mean so far
        passes += 1
    return value[:passes].mean()


def pool_what_each_rank_has(value: np.ndarray) -> float:
    streams = value.reshape(4, -1)
    counts = [max(1, int(np.searchsorted(stream.cumsum(), BUDGET))) for stream in streams]
    return sum(stream[:n].sum() for stream, n in zip(streams, counts, strict=True)) / sum(counts)


@pytest.mark.parametrize(
    ("rule", "least"),
    [(finish_the_running_pass, 0.04), (start_none_that_would_not_fit, 0.03), (pool_what_each_rank_has, -0.04)],
)
def test_known_bad_rules_show(rule: Callable[[np.ndarray], float], least: float) -> None:
    """They are off by several percent, in the direction that estimators with such rules are known to be off."""
    found, error = bias(rule, 14)
    assert abs(found) > abs(least) and found * least > 0
    assert abs(found) > CERTAIN * error


def test_writing_that_takes_longer_than_thought_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of tracing stands still meanwhile, that of the budget does not."""
    now = [100.0]
    monkeypatch.setattr(budget_clock.time, "monotonic", lambda: now[0])
    clock = BudgetClock(None)
    clock.start(5.0)
    clock.for_tracing, clock.end = 40.0, 60.0
    with clock.standing_still():
        now[0] += 54.0
    assert clock.tracing() == 0 and not clock.is_over()
    now[0] += 2.0
    assert clock.tracing() == 2 and clock.is_over()
