"""How well the error of a picture is known: an interval for the estimated relMSE, from groups of passes.

Passes are gathered in groups, the whole run in geometric steps. The passes of a group estimate the error of one pass
without help of the others; how these estimates differ from group to group tells how far their mean can be trusted.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from causticmpi.kernels.jit import kernel

STEP = 2.0**0.25
"""Ratio of passes from one group's end to the next."""
FIRST = 16
"""Passes of the first group; the others have at least three."""
FEWEST_GROUPS = 4
CONFIDENCE = 0.95


@kernel
def _group_variance(sums, before, passes, floor):
    """Sum over pixels and channels of the variance of a pass, over R^2 + floor; `before` becomes a copy of `sums`.

    sums, before (slots, 12): see render.film, at the end of the group and of the one before it; passes: of all and of
    the group; R: the mean of all passes.
    """
    total = 0.0
    every, own = passes
    for i in range(sums.shape[0]):
        for c in range(3):
            mean_all = (sums[i, c] + sums[i, 3 + c]) / every
            mean = (sums[i, c] + sums[i, 3 + c] - before[i, c] - before[i, 3 + c]) / own
            square = (sums[i, 6 + c] - before[i, 6 + c] + (sums[i, 9 + c] - before[i, 9 + c])) / own
            total += max(0.0, square - mean * mean) * own / (own - 1) / (mean_all * mean_all + floor)
        for c in range(sums.shape[1]):
            before[i, c] = sums[i, c]
    return total


@dataclass
class Precision:
    """Groups of a run: when one ends (`due`, on every rank) and what it says (rank 0 only).

    errors: relMSE of a single pass, by each group; passes: of each group.
    """

    errors: list[float] = field(default_factory=list)
    passes: list[int] = field(default_factory=list)
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
            self._before = np.zeros_like(sums)
        own = passes - sum(self.passes)
        total = _group_variance(sums, self._before, (passes, own), floor)
        self.errors.append(total / (3 * len(sums)))
        self.passes.append(own)

    @property
    def error(self) -> float:
        """Estimated relMSE of the mean of all passes that are in groups; there is one at least."""
        done = sum(self.passes)
        return float(np.dot(self.errors, self.passes)) / done**2

    @property
    def factor(self) -> float | None:
        """f such that the true relMSE lies within [estimate / f, estimate * f], with CONFIDENCE where errors of groups
        are normal, which fireflies are not; None for fewer than FEWEST_GROUPS groups."""
        return spread_factor(np.array(self.errors), np.array(self.passes, float))


def spread_factor(errors: np.ndarray, weights: np.ndarray) -> float | None:
    """The factor of `Precision.factor` from the errors of a pass in groups of `weights` passes."""
    from scipy import stats

    if len(errors) < FEWEST_GROUPS:
        return None
    share = weights / weights.sum()
    mean = float(share @ errors)
    if mean <= 0:
        return 1.0
    groups = 1 / float(share @ share)  # as many equal ones would be as good
    deviation = math.sqrt(float(share**2 @ (errors - mean) ** 2) * groups / (groups - 1))
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2, groups - 1))
    return math.exp(min(quantile * deviation / mean, 50.0))
