"""Films: sums over passes, never means, that come out bit for bit alike for any number of ranks and any order.

Every pass value is rounded to a multiple of a fixed power of two, `quantum`, before it is added in float64. As long as
a sum stays below 2^53 quanta, float64 adds such numbers without rounding, so the order of addition cannot show. The
quantum is 2^-36 of the brightest light: 131,072 passes of a pixel that sees it are exact. Squares span twice the range
and are kept in two parts, high and low.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from causticmpi.kernels.jit import inline, kernel
from causticmpi.render.locks import give_back, try_to_take

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
    high = np.floor(square * (1.0 / high_step)) * high_step  # steps are powers of two: exact
    return high, np.rint((square - high) * (1.0 / low_step)) * low_step


@inline
def _add_row(row, sums, quantum):
    """A pixel of a pass (6,) to its sums, and blank it. Returns 1 for a non-finite sample, counted as black."""
    inverse = 1.0 / quantum
    high_step, low_step = quantum * quantum * HIGH, quantum * quantum * LOW
    finite = True
    for c in range(6):
        finite = finite and (abs(row[c]) < np.float32(3e38))
    for c in range(3):
        d = np.float64(row[c]) if finite else 0.0
        k = np.float64(row[3 + c]) if finite else 0.0
        sums[c] += np.rint(d * inverse) * quantum
        sums[3 + c] += np.rint(k * inverse) * quantum
        high, low = _parts_of_square(d + k, high_step, low_step)
        sums[6 + c] += high
        sums[9 + c] += low
        row[c] = 0
        row[3 + c] = 0
    return 0 if finite else 1


@inline
def _add_light_row(row, sums, quantum):
    """As `_add_row`, a pixel of a film of light paths (3,) to the sums' last LIGHT_CHANNELS."""
    inverse = 1.0 / quantum
    high_step, low_step = quantum * quantum * HIGH, quantum * quantum * LOW
    finite = True
    for c in range(3):
        finite = finite and (abs(row[c]) < np.float32(3e38))
    for c in range(3):
        k = np.float64(row[c]) if finite else 0.0
        row[c] = 0
        if k == 0.0:
            continue
        high, low = _parts_of_square(k, high_step, low_step)
        sums[CHANNELS + c] += np.rint(k * inverse) * quantum
        sums[CHANNELS + 3 + c] += high
        sums[CHANNELS + 6 + c] += low
    return 0 if finite else 1


@inline
def _add_blocks(add_row, film, rows, sums, touched, locks, left, quantum):
    """Add rows (first, end) of a film to the sums (n, CHANNELS or more) by `add_row`, and blank them.

    left : (blocks,) bool, which blocks are to be added; blocks that another process holds stay in it. Returns the
    number of non-finite samples.
    """
    bad = 0
    for block in range(rows[0] // BLOCK, -(-rows[1] // BLOCK)):
        if not left[block] or not try_to_take(locks, block):
            continue
        for i in range(max(rows[0], block * BLOCK), min(rows[1], (block + 1) * BLOCK)):
            bad += add_row(film[i], sums[i], quantum)
        touched[block] = True
        give_back(locks, block)
        left[block] = False
    return bad


@kernel
def _accumulate(pass_film, rows, sums, touched, locks, left, quantum):
    """`_add_blocks` for a pass film (n, 6)."""
    return _add_blocks(_add_row, pass_film, rows, sums, touched, locks, left, quantum)


@kernel
def _accumulate_light(light_film, rows, sums, touched, locks, left, quantum):
    """`_add_blocks` for a film of light paths (n, 3)."""
    return _add_blocks(_add_light_row, light_film, rows, sums, touched, locks, left, quantum)


def film_arrays(slots: int, light: bool) -> dict[str, tuple[type, tuple[int, ...]]]:
    """dtype and shape of what a Film keeps, zeros at first: to be handed to it where several processes share it."""
    blocks = -(-slots // BLOCK)
    channels = CHANNELS + (LIGHT_CHANNELS if light else 0)
    return {"sums": (np.float64, (slots, channels)), "touched": (np.bool_, (blocks,)), "locks": (np.int32, (blocks,))}


def _doze() -> None:
    time.sleep(50e-6)


@dataclass
class Film:
    """Sums of independent passes over the pixels of one window.

    light: whether there is room for light paths; sums (slots, channels) float64; passes, nonfinite, rays: counts.
    `quantum` in units of radiance. touched: which blocks of BLOCK rows may be other than 0, so that a small part of a
    round is quickly merged and forgotten.

    Several processes may hold the same sums, by `film_arrays` in memory that they share, each with counts of its own.
    All may add passes at once; part (one, of so many): merging and forgetting is done by each for its part of the
    blocks, between two meetings of all. idle: called while another process adds to the rows wanted.
    """

    slots: int
    quantum: float
    light: bool = False
    passes: int = 0
    nonfinite: int = 0
    rays: int = 0
    shared: Mapping[str, np.ndarray] | None = None
    part: tuple[int, int] = (0, 1)
    idle: Callable[[], None] = _doze

    def __post_init__(self) -> None:
        arrays = self.shared
        if arrays is None:
            arrays = {
                name: np.zeros(shape, kind) for name, (kind, shape) in film_arrays(self.slots, self.light).items()
            }
        self.sums, self.touched, self.locks = arrays["sums"], arrays["touched"], arrays["locks"]
        self._left = np.zeros(len(self.touched), bool)
        one, of = self.part
        self._own = slice(len(self.touched) * one // of, len(self.touched) * (one + 1) // of)

    def add_pass(self, pass_film: np.ndarray, rows: slice | None = None) -> None:
        """Add what one pass put on `pass_film` (slots, 6) float32, and blank it. The caller counts passes: several
        ranks may have shared one. rows: slots outside are known to be black."""
        self._add(_accumulate, pass_film, slice(0, self.slots) if rows is None else rows)

    def add_light(self, light_film: np.ndarray) -> None:
        """Add all light paths of one pass, (slots, 3) float32, and blank them."""
        self._add(_accumulate_light, light_film, slice(0, self.slots))

    def _add(self, accumulate: Callable[..., int], film: np.ndarray, rows: slice) -> None:
        blocks = slice(rows.start // BLOCK, -(-rows.stop // BLOCK))
        self._left[blocks] = True
        span = rows.start, rows.stop
        while True:
            self.nonfinite += accumulate(film, span, self.sums, self.touched, self.locks, self._left, self.quantum)
            if not self._left[blocks].any():
                return
            self.idle()

    def merge(self, other: "Film") -> None:
        """Add another film's sums and counts."""
        for rows in other._touched_rows():
            self.sums[rows] += other.sums[rows]
        self.touched[other._own] |= other.touched[other._own]
        self.passes += other.passes
        self.nonfinite += other.nonfinite
        self.rays += other.rays

    def clear(self) -> None:
        """Forget everything."""
        for rows in self._touched_rows():
            self.sums[rows] = 0
        self.touched[self._own] = False
        self.passes = self.nonfinite = self.rays = 0

    def _touched_rows(self) -> Iterator[slice]:
        """Runs of touched blocks in this process's part."""
        own = self.touched[self._own]
        between = np.zeros(len(own) + 2, bool)
        between[1:-1] = own
        ends = np.flatnonzero(between[1:] != between[:-1])
        ends = BLOCK * (self._own.start + ends)
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
