"""Pages about whole runs: is the stated interval of the error right, where do runs stop, and what becomes of a million
samples of one pixel?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from causticmpi.distributed.until import Until
from causticmpi.output.picture import RELMSE_FLOOR, estimated_relmse
from causticmpi.render.film import Film, quantum_for, resolve
from causticmpi.render.precision import Precision
from causticmpi.stability.cell import FAR_PASS, Bench, config_for, set_up
from causticmpi.stability.records import Contender, Page

TRUE_WITHIN = 1.25
"""Factor within which an estimated error is called accurate."""
TARGET_FACTOR = 1.5
"""The error that `until` runs aim at is that of page.passes passes, times this."""
LONGEST_STOP = 8
"""A run is given up after this many times page.passes passes."""
FEWEST_RUNS = 8


@dataclass(frozen=True)
class Coverage:
    """Runs of one contender, arrays over runs. estimated: relMSE as a run's report states it (`relmse`), and its
    factor; actual: squared error of its picture; own: `estimated_relmse`, relative to the picture's own mean.
    """

    label: str
    passes: int
    estimated: np.ndarray
    factor: np.ndarray
    actual: np.ndarray
    own: np.ndarray

    @property
    def expected(self) -> float:
        """Mean squared error of a run's picture."""
        return float(self.actual.mean())

    @property
    def uncertainty(self) -> float:
        """Relative standard error of `expected`."""
        return float(self.actual.std(ddof=1) / math.sqrt(len(self.actual)) / self.expected)

    @property
    def within(self) -> float:
        """Share of runs whose estimate is within TRUE_WITHIN of the expected error."""
        return float((np.abs(np.log(self.estimated / self.expected)) <= math.log(TRUE_WITHIN)).mean())

    @property
    def covered(self) -> float:
        """Share of runs whose stated interval holds the expected error."""
        return float((np.abs(np.log(self.estimated / self.expected)) <= np.log(self.factor)).mean())


def coverage(page: Page, contender: Contender, file: Path, scale: float) -> Coverage:
    """Independent runs of equally many passes; the truth of each is the mean of all the others."""
    runs = _run_count(page, scale)
    bench = set_up(file, config_for(page.side, 1, {**page.set, **contender.set}))
    pictures, own, estimated, factors = [], [], [], []
    for run in range(runs):
        film, precision = Film(page.side**2, quantum_for(bench.scene.brightest)), Precision(page.side)
        for i in range(page.passes):
            _add(bench, film, run * page.passes + i)
            if precision.due(film.passes):
                precision.take(film.sums, film.passes, RELMSE_FLOOR)
        rgb, variance = _resolved(film)
        pictures.append(rgb)
        own.append(estimated_relmse(rgb, variance))
        error, factor = precision.known or (math.nan, math.nan)
        # Known of the passes up to the end of the last group: of all, as the error falls with their number.
        estimated.append(error * (precision.first + sum(precision.passes)) / film.passes)
        factors.append(factor)
    bench.close()
    return Coverage(
        contender.label, page.passes, np.array(estimated), np.array(factors), _actual(np.array(pictures)), np.array(own)
    )


def _actual(pictures: np.ndarray) -> np.ndarray:
    """Squared relative error of each of (runs, H, W, 3), against the mean of the others, whose share is taken off.

    For n pictures of one error e, |I - mean of the others|^2 is e (1 + 1 / (n - 1)) on average.
    """
    n = len(pictures)
    total = pictures.sum(axis=0)
    weight = 1 / ((total / n) ** 2 + RELMSE_FLOOR)
    found = [float(((p - (total - p) / (n - 1)) ** 2 * weight).mean()) for p in pictures]
    return np.array(found) * (n - 1) / n


@dataclass(frozen=True)
class Stops:
    """Runs that stop at a wanted error. target: relMSE; passes, actual (runs,): when they stopped and their squared
    relative error; difference, z: of the mean of all pictures to the truth, relative and in standard errors; naive: the
    same runs stopped by their own error."""

    label: str
    target: float
    passes: np.ndarray
    actual: np.ndarray
    difference: float
    z: float
    naive_passes: np.ndarray
    naive_difference: float
    naive_z: float


def stops(page: Page, contender: Contender, file: Path, scale: float) -> Stops:
    """Runs with a wanted error: a pilot finds one that takes about page.passes passes; truth from longer runs."""
    runs = _run_count(page, scale)
    bench = set_up(file, config_for(page.side, 1, {**page.set, **contender.set}))
    quantum = quantum_for(bench.scene.brightest)
    truth_film = Film(page.side**2, quantum)
    truth_passes = runs * page.passes
    for i in range(truth_passes):
        _add(bench, truth_film, FAR_PASS + i)
    truth, variance = _resolved(truth_film)
    target = estimated_relmse(truth, variance) * truth_passes / page.passes * TARGET_FACTOR
    weight = 1 / (truth**2 + RELMSE_FLOOR)
    ended, naive = [], []
    for run in range(runs):
        (rgb, passes), (naive_rgb, naive_passes) = _until(bench, Film(page.side**2, quantum), target, page.passes, run)
        actual = float((((rgb - truth) ** 2 - variance) * weight).mean())
        ended.append((passes, actual, float((rgb * weight).mean())))
        naive.append((naive_passes, float((naive_rgb * weight).mean())))
    bench.close()
    goal = float((truth * weight).mean())
    passes, actual, means = np.array(ended).T
    naive_passes, naive_means = np.array(naive).T
    # The truth is as good as one run of its number of passes.
    share = math.sqrt(1 / runs + float(passes.mean()) / truth_passes)
    return Stops(
        contender.label, target, passes, actual, *_deviation(means, goal, share), naive_passes,
        *_deviation(naive_means, goal, share),
    )  # fmt: skip


def _run_count(page: Page, scale: float) -> int:
    return max(FEWEST_RUNS, round(page.runs * min(1.0, scale)))


def _deviation(means: np.ndarray, goal: float, share: float) -> tuple[float, float]:
    """Of the runs' mean from `goal`: relative, and in standard errors. share: such an error over a run's deviation."""
    difference = float(means.mean()) - goal
    return difference / goal, difference / max(float(means.std(ddof=1)) * share, 1e-300)


Stopped = tuple[np.ndarray, int]


def _until(bench: Bench, whole: Film, target: float, passes: int, run: int) -> tuple[Stopped, Stopped]:
    """One run by the program's rule, and the same passes stopped by their own error."""
    rule, second = Until(target, bench.config.film.width), Film(whole.slots, whole.quantum)
    naive: Stopped | None = None
    first_index = run * LONGEST_STOP * passes
    over = False
    while (not over or naive is None) and whole.passes < LONGEST_STOP * passes:
        half = rule.half(whole.passes)
        index = first_index + whole.passes
        one = _traced(bench, index)
        if half and not over:
            second.add_pass(one.copy())
        whole.add_pass(one)
        whole.passes += 1
        if not rule.asks(whole.passes):
            continue
        if not over and rule.decide(whole.sums, second.sums, whole.passes):
            over, parts = True, rule.parts(whole.sums, second.sums, whole.passes)
        rgb, variance = _resolved(whole)
        if naive is None and estimated_relmse(rgb, variance) <= target:
            naive = (rgb, whole.passes)
    if not over:
        parts = rule.parts(whole.sums, second.sums, whole.passes)
    pictures = [np.add(*resolve(sums, n)[:2]) for sums, n in parts]
    return (np.mean(pictures, axis=0), sum(n for _, n in parts)), naive or (_resolved(whole)[0], whole.passes)


@dataclass(frozen=True)
class Long:
    """Samples of one pixel, luminance. drift: of the film's sum from the exact one, relative; float32: of a sum in
    single precision; z: of the two halves' means; share: of the largest sample in the sum; curve (k, 3): samples,
    their mean, and the share of the largest.
    """

    label: str
    samples: int
    drift: float
    float32: float
    z: float
    share: float
    curve: np.ndarray


def long_run(page: Page, contender: Contender, file: Path, scale: float) -> Long:
    """page.samples samples of a pixel in the lower middle of a film of page.side, added as the program adds them."""
    samples = max(1000, round(page.samples * min(1.0, scale)))
    x, y = page.side // 2, int(0.8 * page.side)
    bench = set_up(file, config_for(page.side, 1, {**page.set, **contender.set, "film.crop": (x, y, x + 1, y + 1)}))
    film, one = Film(1, quantum_for(bench.scene.brightest)), np.zeros((1, 6), np.float32)
    values = np.zeros((samples, 3))
    single = np.zeros(3, np.float32)
    for i in range(samples):
        bench.add_pass(i, one)
        values[i] = one[0, :3].astype(np.float64) + one[0, 3:]
        single += one[0, :3] + one[0, 3:]
        film.add_pass(one)
    bench.close()
    exact = np.array([math.fsum(values[:, c]) for c in range(3)])
    summed = film.sums[0, :3] + film.sums[0, 3:6]
    gray = values.mean(axis=1)
    half = samples // 2
    deviation = math.sqrt(gray[:half].var() / half + gray[half:].var() / (samples - half))
    return Long(
        contender.label,
        samples,
        float(np.abs(summed / exact - 1).max()),
        float(np.abs(single / exact - 1).max()),
        float(gray[:half].mean() - gray[half:].mean()) / max(deviation, 1e-300),
        float(gray.max() / gray.sum()),
        _curve(gray),
    )


def _curve(values: np.ndarray) -> np.ndarray:
    counts = np.unique(np.geomspace(10, len(values), 60).astype(int))
    sums, largest = np.cumsum(values)[counts - 1], np.maximum.accumulate(values)[counts - 1]
    return np.stack([counts, sums / counts, largest / np.maximum(sums, 1e-300)], axis=1)


def _traced(bench: Bench, index: int) -> np.ndarray:
    one = np.zeros((len(bench.pixels), 6), np.float32)
    bench.add_pass(index, one)
    return one


def _add(bench: Bench, film: Film, index: int) -> None:
    film.add_pass(_traced(bench, index))
    film.passes += 1


def _resolved(film: Film) -> tuple[np.ndarray, np.ndarray]:
    diffusive, caustic, variance = resolve(film.sums, film.passes)
    return diffusive + caustic, variance


RUNS = {"coverage": coverage, "until": stops, "long": long_run}
"""By the kind of a page: one task for each contender."""
Result = Coverage | Stops | Long


def verdict(results: Sequence[Result]) -> str:
    """One sentence, by the figures; results are all of one kind."""
    first = results[0]
    if isinstance(first, Coverage):
        lead = (
            f"Of {len(first.estimated)} runs of {first.passes} passes, estimates within a factor {TRUE_WITHIN} of the "
            "true error, and 95 % intervals that hold it: "
        )
    elif isinstance(first, Stops):
        lead = "Error where runs end over the wanted one, and their mean's offset (by halves; stopped by own error): "
    else:
        lead = f"Sum of {first.samples:,} samples of a pixel: "
    return lead + "; ".join(map(_said, results)) + "."


def _said(found: Result) -> str:
    if isinstance(found, Coverage):
        return (
            f"{found.label} {100 * found.within:.0f} % and {100 * found.covered:.0f} % (mean estimate x "
            f"{found.estimated.mean() / found.expected:.2f} of it, median interval x and / "
            f"{np.median(found.factor):.2f}; true error known to {100 * found.uncertainty:.1f} %)"
        )
    if isinstance(found, Stops):
        return (
            f"{found.label} x {(found.actual / found.target).mean():.2f} in {len(found.actual)} runs, "
            f"{100 * found.difference:+.2f} % (z {found.z:+.1f}; {100 * found.naive_difference:+.2f} %, "
            f"z {found.naive_z:+.1f})"
        )
    return (
        f"{found.label} off by {found.drift:.1g} of itself (in float32 by {found.float32:.1g}), halves "
        f"{'agree' if abs(found.z) < 4 else 'DISAGREE'} (z {found.z:+.1f}), largest sample "
        f"{100 * found.share:.2g} % of it"
    )
