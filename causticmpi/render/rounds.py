"""Rounds of passes: how work is cut into shares, and how shares are traced in short batches.

A round is a run of passes merged whole or dropped whole, which is what keeps a time budget free of bias: averaging the
finished rounds of EQUAL length, the unfinished one dropped and the first always finished, is exactly unbiased.
Finishing a round that the clock has overtaken, merging what each rank happens to have, or letting the length of rounds
follow the cost of earlier ones is not (tests/test_deadline.py).
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from causticmpi.kernels.particle_waves import GROUP
from causticmpi.render.film import Film
from causticmpi.render.methods import Method

BATCH_SECONDS = 0.25
"""Aim of one batch; the clock and the signals are looked at between batches."""


@dataclass(frozen=True)
class Share:
    """Rows first … last-1 of the pixel order in one pass; light: and all its light paths."""

    pass_index: int
    first: int
    last: int
    light: bool = False


FINENESS = 8
"""A share is at most what is left of the round by this many times the ranks ..."""
LEAST = 64
"""... but no less than so many tiles, where that leaves work for every rank."""


def divide(first_pass: int, passes: int, tiles: int, size: int, light: bool = False) -> list[Share]:
    """The shares of a round in the order to hand them out to `size` ranks that come free at times of their own.

    Whole passes as long as plenty of them are left, then ever smaller parts (guided self-scheduling), so that at the
    end no rank waits long for another: parts of a pass cost each rank that takes one the beginning of that pass.
    tiles: number of 16-pixel tiles of a pass; light: passes have light paths. The shares cover each tile and the light
    paths of each pass once; these stay together, for the squares of a pass need all of them.
    """
    shares = []
    for index in range(passes):
        left = passes - index
        parts = 1
        if size > 1:
            parts = min(tiles, max(-(-size // left), min(-(-FINENESS * size // left), tiles // LEAST)))
        cuts = [16 * (tiles * part // parts) for part in range(parts + 1)]
        if light and parts > 1:
            shares.append(Share(first_pass + index, 0, 0, light=True))
        alone = light and parts == 1
        shares += [Share(first_pass + index, *cut, light=alone) for cut in zip(cuts, cuts[1:], strict=False)]
    return shares


def equal_round(seconds_per_pass: float, aim: float, size: int) -> int:
    """Passes of every round, so that one takes about `aim` seconds: whole passes per rank where that fits.

    seconds_per_pass: what a pass costs one rank, from a pilot whose samples are thrown away.
    """
    passes = max(1, int(size * aim / max(seconds_per_pass, 1e-9)))
    return passes - passes % size if passes > size else passes


def _stretch(seconds: float) -> float:
    """Factor for the size of the next batch, after one of so many seconds."""
    return min(4.0, max(0.25, BATCH_SECONDS / max(seconds, 1e-6)))


PILOT_PASS = 2**62
"""A pass index that no picture uses."""
PILOT_TILES = 256
PILOT_LIGHT = 32
"""The pilot takes this part of the light paths."""


def _cpu_seconds(work: Callable[..., int], *args: object) -> float:
    """CPU seconds of this process that `work` takes."""
    began = time.process_time()
    work(*args)
    return time.process_time() - began


class Batches:
    """Traces shares in batches of about BATCH_SECONDS. The size of a batch follows the clock, the samples do not."""

    def __init__(self, method: Method, pixels: np.ndarray, slots: int) -> None:
        self.method = method
        self.pixels = pixels
        self.pass_film = np.zeros((slots, 6), np.float32)
        by_tile = pixels[:, 3].reshape(-1, 16)
        self.low, self.high = np.where(by_tile < 0, slots, by_tile).min(axis=1), by_tile.max(axis=1)
        self.light_film = np.zeros((slots if method.light_paths else 0, 3), np.float32)
        self.rows, self.paths = 16 * 64, 4096
        self.kernel_seconds = 0.0
        """CPU seconds spent in the method itself, the pilot left out."""
        self.began: float | None = None
        """CPU seconds of this process when the first round began; None before."""

    def pilot_seconds(self) -> float:
        """CPU seconds of a pass here, from tiles spread over the picture in a pass of no picture.

        Not by the wall clock: on a crowded core a pilot of milliseconds waits for the pilots of all others. What only
        a first call costs is left out, for it would be taken a hundredfold.
        """
        tiles = self.pixels.reshape(-1, 16, self.pixels.shape[1])
        some = np.ascontiguousarray(tiles[:: max(1, len(tiles) // PILOT_TILES)])
        self.pass_film[:] = 0  # its pages come into being
        self.method.begin_pass(PILOT_PASS)
        self.method.trace(some[0], self.pass_film)
        beginning = _cpu_seconds(self.method.begin_pass, PILOT_PASS)
        rows = some.reshape(-1, self.pixels.shape[1])
        seconds = beginning + _cpu_seconds(self.method.trace, rows, self.pass_film) * len(tiles) / len(some)
        self.pass_film[:] = 0
        paths = self.method.light_paths // PILOT_LIGHT
        if paths > 0:
            self.light_film[:] = 0
            self.method.trace_light(PILOT_PASS, 0, 1, self.light_film)
            per_part = _cpu_seconds(self.method.trace_light, PILOT_PASS, 0, paths, self.light_film)
            seconds += per_part * self.method.light_paths / paths
            self.light_film[:] = 0
        return seconds

    def trace(self, shares: Iterable[Share], pending: Film, stop: Callable[[], bool]) -> bool:
        """Trace all shares into `pending`; False, with `pending` to be dropped, if `stop()` came true in between."""
        begun: int | None = None
        if self.began is None:
            self.began = time.process_time()
        for share in shares:
            if share.light and not self._trace_light(share.pass_index, pending, stop):
                return False
            if share.last == share.first:
                continue
            if share.pass_index != begun:
                begun = share.pass_index
                pending.rays += self._timed(self.method.begin_pass, begun)
            row = share.first
            while row < share.last:
                end = min(share.last, row + self.rows)
                began = time.perf_counter()
                pending.rays += self._timed(self.method.trace, self.pixels[row:end], self.pass_film)
                wanted = self.rows * _stretch(time.perf_counter() - began)
                row = end
                if stop():
                    self.pass_film[:] = 0
                    return False
                self.rows = min(len(self.pixels), max(16, int(wanted) // 16 * 16))
            pending.add_pass(self.pass_film, self._slots_of(share))
        return True

    def _trace_light(self, pass_index: int, pending: Film, stop: Callable[[], bool]) -> bool:
        """The light paths of a pass; False if `stop()` came true in between."""
        path = 0
        while path < self.method.light_paths:
            end = min(self.method.light_paths, path + self.paths)
            began = time.perf_counter()
            pending.rays += self._timed(self.method.trace_light, pass_index, path, end, self.light_film)
            wanted = self.paths * _stretch(time.perf_counter() - began)
            self.paths = min(self.method.light_paths, max(GROUP, int(wanted) // GROUP * GROUP))
            path = end
            if stop():
                self.light_film[:] = 0
                return False
        pending.add_light(self.light_film)
        return True

    def _slots_of(self, share: Share) -> slice:
        tiles = slice(share.first // 16, -(-share.last // 16))
        return slice(int(self.low[tiles].min()), int(self.high[tiles].max()) + 1)

    def _timed(self, work: Callable[..., int], *args: object) -> int:
        began = time.process_time()
        rays = work(*args)
        self.kernel_seconds += time.process_time() - began
        return rays
