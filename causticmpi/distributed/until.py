"""Stopping at a wanted error without bending the picture: each half of the passes is stopped by the other half.

To stop when the picture looks good prefers pictures that lack a rare bright path: they look good, and are too dark.
Here the passes form two halves, and the half that a pass belongs to depends on its number alone. Half A says from its
own variance when the picture would be good enough, and that ends half B; half B ends half A. Given when it ends, which
it has no say in, each half is a plain mean, so both are unbiased, and so is their mean in equal shares. Mostly both end
at once, and nothing is wasted; where they do not, the half that has ended goes on only to decide for the other.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.render.precision import Precision

FIRST = 8
"""Passes of a half at the first question; it knows an answer a few questions later (render.precision)."""
STEP = 2.0**0.25
"""Ratio of passes from one question to the next: a picture is better than wanted by up to this factor."""

EARLIEST = 40
"""Passes of a run at the first question that has an answer: no run ends before."""
HELD = 6
"""Films in a checkpoint, at most: all passes, the second half, and each half at the last question and at its end."""

Part = tuple[np.ndarray, int]
"""Sums over passes (see render.film), and their number."""


class Until:
    """When to stop. Questions and halves depend on the number of passes alone: the same on every rank.

    target: relMSE of the whole picture, as `Precision` has it; width: pixels of a row of the film; before: what a
    checkpoint `kept`, to go on from.
    """

    def __init__(self, target: float, width: int, before: Mapping[str, np.ndarray] | None = None) -> None:
        self.target = target
        self._borders = [0, FIRST]  # passes of each half at the questions
        self._ended: list[Part | None] = [None, None]
        self._precision = (Precision(width), Precision(width))
        if before is not None:
            self._go_on_from(before)

    def half(self, passes: int) -> int:
        """The half, 0 or 1, that the pass with this number belongs to."""
        before, after = self._around(passes)
        return int(passes >= before + after)

    def to_border(self, passes: int) -> int:
        """Passes from this one to the end of its half of the block: a round may not be longer."""
        before, after = self._around(passes)
        return (before + after if passes < before + after else 2 * after) - passes

    def _around(self, passes: int) -> tuple[int, int]:
        """Passes of each half at the last question and at the next one."""
        while 2 * self._borders[-1] <= passes:
            self._borders.append(max(round(STEP * self._borders[-1]), self._borders[-1] + 3))
        after = next(border for border in self._borders if 2 * border > passes)
        return self._borders[self._borders.index(after) - 1], after

    def asks(self, passes: int) -> bool:
        """Whether the halves are asked after this many passes."""
        return passes > 0 and 2 * self._around(passes)[0] == passes

    def decide(self, whole: np.ndarray, second: np.ndarray, passes: int) -> bool:
        """Ask both halves; True if the run is over. whole, second: sums of all passes and of the second half."""
        each = passes // 2
        halves = (whole - second, second)
        for asked, other in ((0, 1), (1, 0)):
            self._precision[asked].take(halves[asked], each, RELMSE_FLOOR)
            error = self._precision[asked].error  # of a picture of this half alone; the whole has twice as many passes
            if self._ended[other] is None and error is not None and error / 2 <= self.target:
                self._ended[other] = (halves[other].copy(), each)
        return self.over

    def kept(self, second: np.ndarray) -> dict[str, np.ndarray]:
        """What a checkpoint holds besides the sums of all passes, not copied. second: sums of the second half."""
        ends = [0 if end is None else end[1] for end in self._ended]
        arrays = {"second": second, "ended": np.array(ends, np.int64)}
        for half in (0, 1):
            end = self._ended[half]
            if end is not None:
                arrays[f"ended {half}"] = end[0]
            arrays |= {f"{name} {half}": array for name, array in self._precision[half].kept().items()}
        return arrays

    def _go_on_from(self, before: Mapping[str, np.ndarray]) -> None:
        for half, passes in enumerate(before["ended"].tolist()):
            if passes > 0:
                self._ended[half] = (before[f"ended {half}"].copy(), passes)
            names = [name for name in ("before", "errors", "passes") if f"{name} {half}" in before]
            self._precision[half].go_on_from({name: before[f"{name} {half}"] for name in names})

    @property
    def over(self) -> bool:
        """Whether both halves have ended each other."""
        return all(self._ended)

    def remark(self, passes: int) -> str:
        """For the last line of a run: the error that was missed, and whether fewer passes than EARLIEST are why or the
        least there could be; "" where there is nothing to say."""
        if not self.over:
            soon = f", not asked for before {EARLIEST} passes" if passes < EARLIEST else ""
            return f" (wanted: {self.target:.2g}{soon})"
        return f" (wanted: {self.target:.2g}, not asked for before {EARLIEST} passes)" if passes == EARLIEST else ""

    def parts(self, whole: np.ndarray, second: np.ndarray, passes: int) -> Sequence[Part]:
        """What the picture is the plain mean of: all passes at once, or two halves that ended apart.

        passes: of the run; whatever ended it, a half that has not ended has all of its passes.
        """
        first, last = self._ended
        if (first is None and last is None) or (first is not None and last is not None and first[1] == last[1]):
            if first is None or last is None:
                return [(whole, passes)]
            return [(first[0] + last[0], first[1] + last[1])]
        before, after = self._around(passes)
        in_second = before + max(0, passes - before - after)
        return [first or (whole - second, passes - in_second), last or (second.copy(), in_second)]


def ended(kept: Mapping[str, np.ndarray]) -> bool:
    """Whether the run whose checkpoint holds these arrays reached its wanted error."""
    return "ended" in kept and bool(np.all(kept["ended"] > 0))
