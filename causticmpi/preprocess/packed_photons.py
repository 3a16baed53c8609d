"""Photons that steer at a place, packed: 16 bits a number, and what vector code reads at once side by side.

They come from far away in memory, so half the bytes are half the wait. Directions are multiples of STEP, a few
hundredths of the narrowest cone; all else is bfloat16, a float32 without its lower half, for curvature goes from the
sun's to that of a focus. A sampler and its pdf both ask what is unpacked: rounding makes neither of them wrong.

Packed photons of a place are blocks of 16, each a row of 16 for every row that the photons have. So places of numbers
are known when a loop over 16 of them is compiled; were they not, code that rules out that what it writes is what it
reads would take longer than the loop.
"""

import math
from typing import Any

import numpy as np

from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel, prefetch
from causticmpi.preprocess.parallax import CURVATURE, DIRECTION, HEIGHT, POWER, ROWS, turned

PACKED = np.int16
"""Type of the numbers."""
BLOCK = LANES * ROWS
"""Numbers of 16 photons."""
LINE = 64
"""Bytes that come from memory at a time."""
_STEPS = np.float32(32767)
STEP = np.float32(1) / _STEPS
_HALF_BITS, _ROUND = np.int32(16), np.int32(0x7FFF)


@inline
def place_of(i, block):
    """Where photon i is, in blocks of so many numbers."""
    return (i // LANES) * block + i % LANES


@inline
def _pack_coordinate(x):
    return np.int16(math.floor(x * _STEPS + np.float32(0.5)))


@inline
def _coordinate(packed, at):
    return np.float32(packed[at]) * STEP


@inline
def _pack_real(x):
    """Rounded to the nearest, ties to even: 0 stays 0."""
    bits: Any = np.float32(x).view(np.int32)
    return np.int16((bits + _ROUND + ((bits >> _HALF_BITS) & np.int32(1))) >> _HALF_BITS)


@inline
def _real(packed, at):
    return np.int32(np.int32(packed[at]) << _HALF_BITS).view(np.float32)


@inline
def pack(photon, count, packed, first):
    """`count` photons of a place, photon (ROWS, >= count) float32, packed as number `first` and so on of (BLOCK *
    blocks,) int16."""
    for i in range(count):
        at = place_of(first + i, BLOCK)
        for row in range(DIRECTION, DIRECTION + 3):
            packed[at + LANES * row] = _pack_coordinate(photon[row, i])
        for row in range(POWER, ROWS):
            packed[at + LANES * row] = _pack_real(photon[row, i])


@inline
def ask_for(packed, place, columns):
    """Have the first `columns` photons of a place, of packed (places, BLOCK * blocks), brought near."""
    first = packed.ctypes.data + packed.itemsize * packed.shape[1] * np.int64(place)
    for byte in range(0, packed.itemsize * ROWS * columns, LINE):
        prefetch(first + byte)


@inline
def power_of(packed, at):
    """Of the photon at `place_of`, as what follows."""
    return _real(packed, at + LANES * POWER)


@inline
def height_of(packed, at):
    return _real(packed, at + LANES * HEIGHT)


@inline
def turned_packed(packed, at, step):
    """The direction, of length 1, of the photon at `place_of` as seen a step from where it is known."""
    x = _coordinate(packed, at + LANES * DIRECTION)
    y = _coordinate(packed, at + LANES * (DIRECTION + 1))
    z = _coordinate(packed, at + LANES * (DIRECTION + 2))
    m = (
        _real(packed, at + LANES * CURVATURE),
        _real(packed, at + LANES * (CURVATURE + 1)),
        _real(packed, at + LANES * (CURVATURE + 2)),
        _real(packed, at + LANES * (CURVATURE + 3)),
        _real(packed, at + LANES * (CURVATURE + 4)),
        _real(packed, at + LANES * (CURVATURE + 5)),
    )
    return turned((x, y, z), m, step)


@kernel
def _pack_all(photon, packed):
    for place in range(photon.shape[0]):
        pack(photon[place], photon.shape[2], packed[place], 0)


def no_photons(places: int, columns: int) -> np.ndarray:
    """Packed photons of places, `columns` of each, a multiple of 16: without power or direction."""
    return np.zeros((places, ROWS * columns), PACKED)


def packed_photons(photon: np.ndarray) -> np.ndarray:
    """The photons of places, photon (places, ROWS, n) float32, n a multiple of 16, packed: (places, ROWS * n) int16."""
    packed = no_photons(photon.shape[0], photon.shape[2])
    _pack_all(photon, packed)
    return packed


def unpacked_row(packed: np.ndarray, row: int) -> np.ndarray:
    """One row of the photons of places, packed (places, ROWS * n) int16, as float32 again: (places, n)."""
    places, numbers = packed.shape
    one = packed.reshape(places, numbers // BLOCK, ROWS, LANES)[:, :, row].reshape(places, numbers // ROWS)
    return one * STEP if row < DIRECTION + 3 else (one.astype(np.int32) << _HALF_BITS).view(np.float32)


def unpacked_photons(packed: np.ndarray) -> np.ndarray:
    """All of them: (places, ROWS, n)."""
    return np.stack([unpacked_row(packed, row) for row in range(ROWS)], axis=1)
