"""Rounds of passes: how work is dealt out, and traced in short batches.

A round is a run of passes merged whole or dropped whole, which is what keeps a time budget free of bias: averaging the
finished rounds, the unfinished one dropped and the first always finished, is exactly unbiased, while finishing a round
that the clock has overtaken, or merging what each rank happens to have, is not (tests/test_deadline.py).
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


class Batches:
    """Traces shares in batches of about BATCH_SECONDS. The size of a batch follows the clock, the samples do not."""

    def __init__(self, method: Method, pixels: np.ndarray, slots: int) -> None:
        self.method = method
        self.pixels = pixels
        self.pass_film = np.zeros((slots, 6), np.float32)
        self.rows = 16 * 64

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
                self.rows = max(16, int(wanted) // 16 * 16)
            pending.add_pass(self.pass_film)
        return True
