"""Rounds of passes: how work is dealt out, and traced in short batches.

A round is a run of passes merged whole or dropped whole, which is what keeps a time budget free of bias: averaging the
finished rounds of EQUAL length, the unfinished one dropped and the first always finished, is exactly unbiased.
Finishing a round that the clock has overtaken, merging what each rank happens to have, or letting the length of rounds
follow the cost of earlier ones is not (tests/test_deadline.py).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from causticmpi.render.film import Film
from causticmpi.render.methods import Method

BATCH_SECONDS = 0.25
"""Aim of one batch; the clock and the signals are looked at between batches."""


@dataclass(frozen=True)
class Share:
    """Rows first … last-1 of the pixel order in one pass."""

    pass_index: int
    first: int
    last: int


def deal(first_pass: int, passes: int, tiles: int, size: int, rank: int) -> list[Share]:
    """This rank's equal share of a round: whole passes where their number is a multiple of the ranks, else a run of
    tiles.

    tiles: number of 16-pixel tiles of a pass. The shares of all ranks cover each tile of each pass once.
    """
    total = passes * tiles
    start, stop = total * rank // size, total * (rank + 1) // size
    shares = []
    while start < stop:
        index, first = divmod(start, tiles)
        last = min(tiles, first + stop - start)
        shares.append(Share(first_pass + index, 16 * first, 16 * last))
        start += last - first
    return shares


def equal_round(seconds_per_pass: float, aim: float, size: int) -> int:
    """Passes of every round, so that one takes about `aim` seconds: whole passes per rank where that fits.

    seconds_per_pass: what a pass costs one rank, from a pilot whose samples are thrown away.
    """
    passes = max(1, int(size * aim / max(seconds_per_pass, 1e-9)))
    return passes - passes % size if passes > size else passes


PILOT_PASS = 2**62
"""A pass index that no picture uses."""
PILOT_TILES = 256


class Batches:
    """Traces shares in batches of about BATCH_SECONDS. The size of a batch follows the clock, the samples do not."""

    def __init__(self, method: Method, pixels: np.ndarray, slots: int) -> None:
        self.method = method
        self.pixels = pixels
        self.pass_film = np.zeros((slots, 6), np.float32)
        self.rows = 16 * 64

    def pilot_seconds(self) -> float:
        """What a pass costs here, from tiles spread over the picture in a pass of no picture."""
        tiles = self.pixels.reshape(-1, 16, self.pixels.shape[1])
        some = tiles[:: max(1, len(tiles) // PILOT_TILES)]
        began = time.perf_counter()
        self.method.begin_pass(PILOT_PASS)
        beginning = time.perf_counter() - began
        self.method.trace(np.ascontiguousarray(some.reshape(-1, self.pixels.shape[1])), self.pass_film)
        self.pass_film[:] = 0
        return beginning + (time.perf_counter() - began - beginning) * len(tiles) / len(some)

    def trace(self, shares: list[Share], pending: Film, stop: Callable[[], bool]) -> bool:
        """Trace all shares into `pending`; False, with `pending` to be dropped, if `stop()` came true in between."""
        for share in shares:
            pending.rays += self.method.begin_pass(share.pass_index)
            row = share.first
            while row < share.last:
                end = min(share.last, row + self.rows)
                began = time.perf_counter()
                pending.rays += self.method.trace(self.pixels[row:end], self.pass_film)
                seconds = max(time.perf_counter() - began, 1e-6)
                row = end
                if stop():
                    self.pass_film[:] = 0
                    return False
                wanted = self.rows * min(4.0, max(0.25, BATCH_SECONDS / seconds))
                self.rows = min(len(self.pixels), max(16, int(wanted) // 16 * 16))
            pending.add_pass(self.pass_film)
        return True
