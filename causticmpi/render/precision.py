"""How well the error of a picture is known: an interval for the estimated relMSE, from groups of passes.

Passes are gathered in groups, the whole run in geometric steps. The passes of a group estimate the variance of one pass
without help of the others; how these estimates differ from group to group tells how far their mean can be trusted.
What they are relative to is the mean of the passes before the group: a picture's own mean is bright just where its
variance is large, and mean(variance / R^2) would come out too small, by a factor of several where there are fireflies.
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


@kernel
def _group_variance(sums, before, passes, floor):
    """Sum over pixels and channels of the variance of a pass, over R^2 + floor; `before` becomes a copy of `sums`.

    sums, before (slots, channels): see render.film, at the end of the group and of the one before it; passes: before
    the group, of which R is the mean, and those of the group.
    """
    total = 0.0
    earlier, own = passes
    for i in range(sums.shape[0]):
        for c in range(3):
            level = (before[i, c] + before[i, 3 + c]) / earlier
            mean = (sums[i, c] + sums[i, 3 + c] - before[i, c] - before[i, 3 + c]) / own
            variance = _variance(sums, before, i, 6 + c, mean, own)
            if sums.shape[1] > CHANNELS:
                level += before[i, CHANNELS + c] / earlier
                mean = (sums[i, CHANNELS + c] - before[i, CHANNELS + c]) / own
                variance += _variance(sums, before, i, CHANNELS + 3 + c, mean, own)
            total += variance / (level * level + floor)
        for c in range(sums.shape[1]):
            before[i, c] = sums[i, c]
    return total


@dataclass
class Precision:
    """Groups of a run: when one ends (`due`, on every rank) and what it says (rank 0 only).

    errors: relMSE of a single pass, by each group but the first, which has none before it; passes: of each of these;
    first: of the first.
    """

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
        total = _group_variance(sums, self._before, (before, passes - before), floor)
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
