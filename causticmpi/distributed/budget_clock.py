"""The clock of a run's budget: what was spent on preparing, on tracing and on writing, and whether tracing is over.

While pictures are written the clock of tracing stands still: whatever lets the cost of past rounds decide on later ones
bends the picture (render.rounds). All ranks count from rank 0's start.
"""

import contextlib
import math
import time
from collections.abc import Iterator

from causticmpi.distributed.checkpoint import State


class BudgetClock:
    """Seconds of the run on this rank; before `start` there are none.

    written_for: spent on writing between rounds; tracing_kept: on rounds that were merged; preparing: before the first
    round of each start; before_tracing: of the run when this start's rounds began. for_tracing: may be spent on rounds;
    end: of the run, by which rounds are over even if writing took more than it was thought to.
    """

    def __init__(self, before: State | None) -> None:
        """before: what earlier starts of this run took."""
        self.written_for = before.writing if before is not None else 0.0
        self.tracing_kept = before.tracing if before is not None else 0.0
        self.preparing = self.before_tracing = 0.0
        self.for_tracing = self.end = math.inf

    def start(self, elapsed: float) -> None:
        """Rounds begin. elapsed: seconds of the run until now, by rank 0's watch."""
        now = time.monotonic()
        self._zero = now - elapsed
        self._tracing_zero = now - self.written_for - self.tracing_kept
        self.before_tracing = elapsed
        self.preparing = elapsed - self.written_for - self.tracing_kept

    def elapsed(self) -> float:
        """Seconds of the run, those of earlier starts included."""
        return time.monotonic() - self._zero

    def tracing(self) -> float:
        """Seconds spent on tracing, the unfinished round included."""
        return time.monotonic() - self._tracing_zero - self.written_for

    def keep_round(self) -> None:
        """A round was merged: its time counts."""
        self.tracing_kept = self.tracing()

    def is_over(self) -> bool:
        """Whether the time for tracing is spent."""
        return self.tracing() > self.for_tracing or self.elapsed() > self.end

    def overrun(self, limit: float, passes: int) -> str:
        """For the last line of a run of one round, of so many passes: how it came over its budget, "" if it did not."""
        if self.preparing + self.tracing_kept <= self.end or self.elapsed() <= limit:
            return ""
        first = "the first pass" if passes == 1 else f"the first round of {passes} passes"
        took = f"preparing took {self.preparing:.1f} s, {first}, always finished, {self.tracing_kept:.1f} s"
        return f", over its budget of {limit:g} s: {took}"

    @contextlib.contextmanager
    def standing_still(self) -> Iterator[None]:
        """The block is writing, not tracing."""
        began = time.monotonic()
        yield
        self.written_for += time.monotonic() - began
