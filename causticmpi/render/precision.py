"""How well the error of a picture is known: an interval for the estimated relMSE, from groups of passes.

Passes are gathered in groups, the whole run in geometric steps. The passes of a group estimate the variance of one pass
without help of the others; how these estimates differ from group to group tells how far their mean can be trusted.
What they are relative to is the level of the passes before the group: a picture's own mean is bright just where its
variance is large, and mean(variance / R^2) would come out too small, by a factor of several where there are fireflies.
But a level from few passes is noisy, and 1 / R^2 of a noisy level is too large on average. So the level of a pixel is
its earlier mean, drawn towards the mean of the square of 3 x 3 pixels around it as far as its own noise explains their
difference: the local Wiener filter of Lee, "Digital image enhancement and noise filtering by use of local statistics"
(PAMI 1980), with a pixel's own squared difference as the variance of the picture.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from causticmpi.kernels.jit import inline, kernel
from causticmpi.render.film import CHANNELS

STEP = 2.0**0.25
"""Ratio of passes from one group's end to the next."""
FIRST = 16
"""Passes of the first group; the others have at least three."""
FEWEST_GROUPS = 4
CONFIDENCE = 0.95


@inline
def _variance(sums, before, i, high, mean, own):
    """Of a pass of the group; high: column of the high parts of the squares, three before that of the low ones."""
    square = (sums[i, high] - before[i, high] + (sums[i, high + 3] - before[i, high + 3])) / own
    return max(0.0, square - mean * mean) * own / (own - 1)


@inline
def _mean_and_noise(before, i, c, passes):
    """Mean of a pixel's channel c over all passes before, and the variance of that mean."""
    mean = (before[i, c] + before[i, 3 + c]) / passes
    noise = max(0.0, (before[i, 6 + c] + before[i, 9 + c]) / passes - mean * mean)
    if before.shape[1] > CHANNELS:
        light = before[i, CHANNELS + c] / passes
        square = (before[i, CHANNELS + 3 + c] + before[i, CHANNELS + 6 + c]) / passes
        mean += light
        noise += max(0.0, square - light * light)
    return mean, noise / max(1, passes - 1)


@inline
def _keep_row(kept, before, y, passes):
    """Mean and noise of the pixels of row y into kept (3, width, 6), a ring of rows."""
    width = kept.shape[1]
    for x in range(width):
        for c in range(3):
            kept[y % 3, x, c], kept[y % 3, x, 3 + c] = _mean_and_noise(before, y * width + x, c, passes)


@inline
def _level(kept, y, height, x, c):
    """A pixel's mean, drawn towards that of its square. kept: its row and those beside it."""
    top, bottom = max(0, y - 1), min(height, y + 2)
    left, right = max(0, x - 1), min(kept.shape[1], x + 2)
    around, noise_around = 0.0, 0.0
    for v in range(top, bottom):
        for u in range(left, right):
            around += kept[v % 3, u, c]
            noise_around += kept[v % 3, u, 3 + c]
    count = (bottom - top) * (right - left)
    around, noise_around = around / count, noise_around / count
    mean = kept[y % 3, x, c]
    own = (mean - around) * (mean - around)
    explained = own + max(kept[y % 3, x, 3 + c], noise_around)
    return around + (mean - around) * own / explained if explained > 0 else mean


@kernel
def _group_variance(sums, before, kept, passes, floor):
    """Sum over pixels and channels of the variance of a pass, over level^2 + floor; `before` becomes a copy of `sums`.

    sums, before (slots, channels): see render.film, at the end of the group and of the one before it, row by row of the
    picture; kept (3, width, 6): workspace, for the levels of the whole picture would be as large as half a film;
    passes: before the group, of which the level is, and those of the group.
    """
    total = 0.0
    earlier, own = passes
    width = kept.shape[1]
    height = sums.shape[0] // width
    _keep_row(kept, before, 0, earlier)
    for y in range(height):
        if y + 1 < height:
            _keep_row(kept, before, y + 1, earlier)
        for x in range(width):
            i = y * width + x
            for c in range(3):
                mean = (sums[i, c] + sums[i, 3 + c] - before[i, c] - before[i, 3 + c]) / own
                variance = _variance(sums, before, i, 6 + c, mean, own)
                if sums.shape[1] > CHANNELS:
                    mean = (sums[i, CHANNELS + c] - before[i, CHANNELS + c]) / own
                    variance += _variance(sums, before, i, CHANNELS + 3 + c, mean, own)
                level = _level(kept, y, height, x, c)
                total += variance / (level * level + floor)
            for c in range(sums.shape[1]):
                before[i, c] = sums[i, c]
    return total


@dataclass
class Precision:
    """Groups of a run: when one ends (`due`, on every rank) and what it says (rank 0 only).

    width: pixels of a row of the film; errors: relMSE of a single pass, by each group but the first, which has none
    before it; passes: of each of these; first: of the first.
    """

    width: int
    errors: list[float] = field(default_factory=list)
    passes: list[int] = field(default_factory=list)
    first: int = 0
    _next: float = FIRST
    _before: np.ndarray | None = None

    def due(self, passes: int) -> bool:
        """Whether a group ends with this many passes; each answer moves the mark on."""
        if passes < self._next:
            return False
        self._next = max(STEP * passes, passes + 3)
        return True

    def take(self, sums: np.ndarray, passes: int, floor: float) -> None:
        """End a group. sums: of all passes so far (see render.film); floor: of the relative error [radiance^2]."""
        if self._before is None:
            self._before, self.first = sums.copy(), passes
            return
        before = self.first + sum(self.passes)
        total = _group_variance(sums, self._before, np.empty((3, self.width, 6)), (before, passes - before), floor)
        self.errors.append(total / (3 * len(sums)))
        self.passes.append(passes - before)

    def kept(self) -> dict[str, np.ndarray]:
        """What `go_on_from` needs, not copied; nothing before the first group. When the next one ends is not in it."""
        if self._before is None:
            return {}
        counts = np.array([self.first, *self.passes], np.int64)
        return {"before": self._before, "errors": np.array(self.errors, np.float64), "passes": counts}

    def go_on_from(self, kept: Mapping[str, np.ndarray]) -> None:
        """Begin with what another one has `kept`."""
        if kept:
            self._before, self.errors = kept["before"].copy(), kept["errors"].tolist()
            self.first, *self.passes = kept["passes"].tolist()

    @property
    def error(self) -> float | None:
        """Estimated relMSE of the mean of all passes so far; None for fewer than FEWEST_GROUPS groups."""
        if len(self.errors) < FEWEST_GROUPS:
            return None
        return float(np.average(self.errors, weights=self.passes)) / (self.first + sum(self.passes))

    @property
    def known(self) -> tuple[float, float] | None:
        """The estimate, and f such that the true relMSE is within [estimate / f, estimate * f] with CONFIDENCE, where
        errors of groups are normal, which fireflies are not; None for fewer than FEWEST_GROUPS groups."""
        factor = spread_factor(np.array(self.errors), np.array(self.passes, float))
        return None if self.error is None or factor is None else (self.error, factor)


def spread_factor(errors: np.ndarray, weights: np.ndarray) -> float | None:
    """The factor of `Precision.known` from the errors of a pass in groups of `weights` passes."""
    from scipy.special import stdtrit  # scipy.stats takes three times as long to load, amid tracing

    if len(errors) < FEWEST_GROUPS:
        return None
    share = weights / weights.sum()
    mean = float(share @ errors)
    if mean <= 0:
        return 1.0
    groups = 1 / float(share @ share)  # as many equal ones would be as good
    deviation = math.sqrt(float(share**2 @ (errors - mean) ** 2) * groups / (groups - 1))
    quantile = float(stdtrit(groups - 1, 0.5 + CONFIDENCE / 2))
    return math.exp(min(quantile * deviation / mean, 50.0))
