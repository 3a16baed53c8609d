"""What is known of one contender in one cell: the figures that tables, charts and sentences are made from."""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from causticmpi.stability.records import Value


class Kind(enum.IntEnum):
    """What became of a cell, the less bad before the worse: of several seeds the worst one is shown."""

    FINE = enum.auto()
    BIASED = enum.auto()
    """Off by more than noise, as a biased method may be."""
    LOSES = enum.auto()
    """Right, but a larger error than the baseline's."""
    LATE = enum.auto()
    """Right, but not begun at the time at which errors are compared."""
    UNTESTED = enum.auto()
    """Nobody saw enough for it to be held against."""
    BLIND = enum.auto()
    """It met so little light that nothing can be said of its mean, which is not too high."""
    MISSES = enum.auto()
    """It found less than half of the caustics."""
    WARNED = enum.auto()
    """The test of its mean failed, but a run warns of that beforehand."""
    REFUSED = enum.auto()
    """No picture: the scene was refused, or the method gave up."""
    LEAKS = enum.auto()
    """Light where none can be."""
    NONFINITE = enum.auto()
    """Samples that are no numbers."""
    WRONG = enum.auto()
    """The test of its mean failed, in a second measurement as well."""


class Verdict(NamedTuple):
    """kind: what programs ask; words: what people read, empty for a cell that is fine."""

    kind: Kind
    words: str


FINE = Verdict(Kind.FINE, "")


@dataclass(frozen=True, eq=False)
class Row:
    """One contender in one cell. value: of the parameter; x: its place in the chart, nan for one without a number;
    seed: of its config, None for a cell without a picture.

    relmse: at the page's equal time, the bias of biased methods included; share: of the squared error that the worst
    pixel holds; fireflies: the error over that without the worst pixels; bias: squared, relative, nan for unbiased
    ones; p: of the test against the truth (nan: not tested); whole: z of the picture's mean; difference: relative,
    of the means; resolution: relative standard error of that difference; pass_seconds, preprocess: CPU seconds; rays:
    per sample; slowest: the longest pass over the mean one; caustic: mean luminance of L_c; verdict: what failed;
    against: whom or what it was held against; warnings: given beforehand; again: whether it is of a second measurement,
    as the mean of the first was wrong; rgb (H, W, 3): its picture; signed (H, W): smoothed relative error of biased
    ones.
    """

    value: Value
    x: float
    label: str
    biased: bool
    seed: int | None = None
    relmse: float = math.nan
    share: float = math.nan
    fireflies: float = math.nan
    bias: float = math.nan
    p: float = math.nan
    whole: float = math.nan
    difference: float = math.nan
    resolution: float = math.nan
    passes: int = 0
    pass_seconds: float = math.nan
    preprocess: float = math.nan
    rays: float = math.nan
    slowest: float = math.nan
    memory_mb: float = math.nan
    caustic: float = math.nan
    verdict: Verdict = FINE
    against: str = ""
    warnings: tuple[str, ...] = ()
    again: bool = False
    rgb: np.ndarray | None = None
    signed: np.ndarray | None = None

    @property
    def kind(self) -> Kind:
        """Of its verdict."""
        return self.verdict.kind

    @property
    def trusted(self) -> bool:
        """Whether its error is to be believed: not where the light came too rarely to be met."""
        return self.kind not in (Kind.BLIND, Kind.MISSES)

    @property
    def tested(self) -> bool:
        """Whether its mean was held against the truth, and the test is worth something."""
        return math.isfinite(self.p) and self.kind not in (Kind.BLIND, Kind.UNTESTED)

    @property
    def off(self) -> bool:
        """Whether its mean is not the truth and it does not say so."""
        return self.kind in (Kind.WRONG, Kind.WARNED, Kind.LEAKS)


def refused(value: Value, x: float, label: str, why: str) -> Row:
    """A cell that has no picture."""
    return Row(value, x, label, False, verdict=Verdict(Kind.REFUSED, f"refused: {why}"))
