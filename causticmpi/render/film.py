"""Films: sums over passes, never means, that come out bit for bit alike for any number of ranks and any order.

Every pass value is rounded to a multiple of a fixed power of two, `quantum`, before it is added in float64. As long as
a sum stays below 2^53 quanta, float64 adds such numbers without rounding, so the order of addition cannot show. The
quantum is 2^-36 of the brightest light: 131,072 passes of a pixel that sees it are exact. Squares span twice the range
and are kept in two parts, high and low.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from causticmpi.kernels.jit import inline, kernel

CHANNELS, LIGHT_CHANNELS = 12, 9
"""Per pixel: sum of L_d (3), sum of L_c (3), sums of the high (3) and low (3) parts of the squares of their total; and,
where light is traced, sum of its L_c (3), sums of the high (3) and low (3) parts of its squares. Light paths cross the
tiles that ranks share, so their film has squares of its own: the two are independent, their variances add."""
QUANTUM_BITS = 36
BLOCK = 1024
HIGH, LOW = 2.0**60, 2.0**24
"""Steps of the two parts of a square, in squares of the quantum: 2^17 low parts of up to 2^36 steps sum up to 2^53."""


@inline
def _parts_of_square(x, high_step, low_step):
    square = x * x
    high = np.floor(square / high_step) * high_step
    return high, np.rint((square - high) / low_step) * low_step


@kernel
def _accumulate(pass_film, sums, quantum):
    """Add the pass film (n, 6) to the sums (n, CHANNELS) and blank it. Returns non-finite samples, counted as black."""
    inverse = 1.0 / quantum
    high_step, low_step = quantum * quantum * HIGH, quantum * quantum * LOW
    bad = 0
    for i in range(pass_film.shape[0]):
        finite = True
        for c in range(6):
            x = pass_film[i, c]
            finite = finite and (abs(x) < np.float32(3e38))
        if not finite:
            bad += 1
        for c in range(3):
            d = np.float64(pass_film[i, c]) if finite else 0.0
            k = np.float64(pass_film[i, 3 + c]) if finite else 0.0
            sums[i, c] += np.rint(d * inverse) * quantum
            sums[i, 3 + c] += np.rint(k * inverse) * quantum
            high, low = _parts_of_square(d + k, high_step, low_step)
            sums[i, 6 + c] += high
            sums[i, 9 + c] += low
            pass_film[i, c] = 0
            pass_film[i, 3 + c] = 0
    return bad


@kernel
def _accumulate_light(light_film, sums, quantum):
    """As `_accumulate`, a film of light paths (n, 3) into the sums' last LIGHT_CHANNELS."""
    inverse = 1.0 / quantum
    high_step, low_step = quantum * quantum * HIGH, quantum * quantum * LOW
    bad = 0
    for i in range(light_film.shape[0]):
        finite = True
        for c in range(3):
            finite = finite and (abs(light_film[i, c]) < np.float32(3e38))
        if not finite:
            bad += 1
        for c in range(3):
            k = np.float64(light_film[i, c]) if finite else 0.0
            light_film[i, c] = 0
            if k == 0.0:
                continue
            high, low = _parts_of_square(k, high_step, low_step)
            sums[i, CHANNELS + c] += np.rint(k * inverse) * quantum
            sums[i, CHANNELS + 3 + c] += high
            sums[i, CHANNELS + 6 + c] += low
    return bad


@dataclass
class Film:
    """Sums of independent passes over the pixels of one window.

    light: whether there is room for light paths; sums (slots, channels) float64; passes, nonfinite, rays: counts.
    `quantum` in units of radiance. touched: which blocks of BLOCK rows may be other than 0, so that a rank's small part
    of a round is quickly merged and forgotten.
    """

    slots: int
    quantum: float
    light: bool = False
    passes: int = 0
    nonfinite: int = 0
    rays: int = 0
    sums: np.ndarray = field(init=False)
    touched: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.sums = np.zeros((self.slots, CHANNELS + (LIGHT_CHANNELS if self.light else 0)))
        self.touched = np.zeros(-(-self.slots // BLOCK), bool)

    def add_pass(self, pass_film: np.ndarray, rows: slice | None = None) -> None:
        """Add what one pass put on `pass_film` (slots, 6) float32, and blank it. The caller counts passes: several
        ranks may have shared one. rows: slots outside are known to be black."""
        rows = slice(0, self.slots) if rows is None else rows
        self.nonfinite += _accumulate(pass_film[rows], self.sums[rows], self.quantum)
        self.touched[rows.start // BLOCK : -(-rows.stop // BLOCK)] = True

    def add_light(self, light_film: np.ndarray) -> None:
        """Add all light paths of one pass, (slots, 3) float32, and blank them."""
        self.nonfinite += _accumulate_light(light_film, self.sums, self.quantum)
        self.touched[:] = True

    def merge(self, other: "Film") -> None:
        """Add another film's sums and counts."""
        for rows in other._touched_rows():
            self.sums[rows] += other.sums[rows]
        self.touched |= other.touched
        self.passes += other.passes
        self.nonfinite += other.nonfinite
        self.rays += other.rays

    def clear(self) -> None:
        """Forget everything."""
        for rows in self._touched_rows():
            self.sums[rows] = 0
        self.touched[:] = False
        self.passes = self.nonfinite = self.rays = 0

    def _touched_rows(self) -> Iterator[slice]:
        """Runs of touched blocks."""
        ends = BLOCK * np.flatnonzero(np.diff(self.touched, prepend=False, append=False))
        return (slice(start, stop) for start, stop in ends.reshape(-1, 2).tolist())


def quantum_for(brightest: float) -> float:
    """The quantum of a scene whose brightest light has this radiance."""
    return 2.0 ** (math.ceil(math.log2(brightest)) - QUANTUM_BITS)


def resolve(sums: np.ndarray, passes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L_d, L_c and the variance of their sum's mean, each (slots, 3) float64; the variance is 0 for a single pass."""
    diffusive, caustic = sums[:, :3] / passes, sums[:, 3:6] / passes
    variance = _variance(diffusive + caustic, sums[:, 6:CHANNELS], passes)
    if sums.shape[1] > CHANNELS:
        light = sums[:, CHANNELS : CHANNELS + 3] / passes
        variance = variance + _variance(light, sums[:, CHANNELS + 3 :], passes)
        caustic = caustic + light
    return diffusive, caustic, variance


def _variance(mean: np.ndarray, squares: np.ndarray, passes: int) -> np.ndarray:
    """Of a mean (slots, 3), from the high and low parts of the sums of squares (slots, 6)."""
    if passes < 2:
        return np.zeros_like(mean)
    return np.maximum((squares[:, :3] + squares[:, 3:]) / passes - mean * mean, 0) / (passes - 1)
