"""Directions of photons as seen from another place than where they landed, and how well those near by then agree.

Where a photon landed, the light it came from is seen in its direction; a step aside it is seen in another, and the
curvature of the photon's wavefront tells in which (kernels.wavefront). So photons of one chain of mirrors and lenses
point at one image of their lamp, however far apart they landed, and cones around them may be as narrow as that image.
"""

import math
from typing import Any

import numpy as np

from causticmpi.kernels import vec
from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import HALF, ONE, ZERO
from causticmpi.kernels.wavefront import ENTRIES, times

DIRECTION, POWER, HEIGHT, CURVATURE, ROWS = 0, 3, 4, 5, 11
"""Rows of the photons that steer at a place: unit direction; power; height of its cone, 1 - cosine of the half angle;
curvature."""
MOST_TURN = np.float32(0.7)
"""A direction is turned by no more [tangent]: next to a focus the curvature holds for a step too small to matter."""
NARROWEST, WIDEST = math.radians(0.05), math.radians(30.0)
"""Half angles of cones, at least and at most: about half of the directions drawn from one lie within."""
_BEYOND = np.float32(3)
"""More than 1 - cosine of any two directions."""
_BEYOND_BITS = _BEYOND.view(np.int32)
_LOWEST, _HIGHEST = np.float32(1 - math.cos(NARROWEST)), np.float32(1 - math.cos(WIDEST))
FEWEST = 4
"""Photons below which nothing is known of how well they agree."""
ALIKE = np.float32(8)
"""The size of a cone is the geometric mean of those around directions within a cone so many times as large."""


@inline
def turned(direction, curvature, step):
    """The direction (towards the light) of a photon as seen a step [scene units] from where it landed."""
    turn = times(curvature, step)
    size2 = vec.dot(turn, turn)
    known = size2 < MOST_TURN * MOST_TURN  # not so if it is NaN
    x = direction[0] - (turn[0] if known else ZERO)
    y = direction[1] - (turn[1] if known else ZERO)
    z = direction[2] - (turn[2] if known else ZERO)
    share = ONE / math.sqrt(x * x + y * y + z * z)
    return x * share, y * share, z * share


@inline
def turned_photon(photon, i, step):
    """The direction of photon i of a place, photon (ROWS, >= i + 1), as seen a step from where it is known."""
    d = (photon[DIRECTION, i], photon[DIRECTION + 1, i], photon[DIRECTION + 2, i])
    m = (
        photon[CURVATURE, i],
        photon[CURVATURE + 1, i],
        photon[CURVATURE + 2, i],
        photon[CURVATURE + 3, i],
        photon[CURVATURE + 4, i],
        photon[CURVATURE + 5, i],
    )
    return turned(d, m, step)


@inline
def _chord(x, y, z, i, j):
    """Half the squared chord between two directions: 1 - cosine."""
    a, b, c = x[i] - x[j], y[i] - y[j], z[i] - z[j]
    return (a * a + b * b + c * c) * HALF


@inline
def _reach(x, y, z, count, companions, chord, height):
    """Height of the cone around each direction that reaches so many others. chord (>= count,): workspace."""
    bits = chord.view(np.int32)  # of numbers >= 0: in the same order, and their least is found by vector code
    for i in range(count):
        for j in range(count):
            chord[j] = _chord(x, y, z, i, j)
        chord[i] = _BEYOND
        reached: Any = 0
        while reached < companions:
            least = bits[i]
            for j in range(count):
                least = min(least, bits[j])
            for j in range(count):
                found = bits[j] == least
                reached += np.int64(found)
                bits[j] = _BEYOND_BITS if found else bits[j]
        height[i] = np.int32(least).view(np.float32)


@inline
def _smooth(x, y, z, count, height, logarithm):
    """Even out the heights of cones among those that are alike. logarithm (>= count,): workspace."""
    for i in range(count):
        height[i] = min(max(height[i], _LOWEST), _HIGHEST)
        logarithm[i] = math.log(height[i])
    for i in range(count):
        total, alike = ZERO, ZERO
        for j in range(count):
            near = ONE if _chord(x, y, z, i, j) <= ALIKE * height[i] else ZERO
            total += near * logarithm[j]
            alike += near
        height[i] = math.exp(total / alike)


@inline
def lay(photon, offset, i, points, j, p):
    """Caustic point j, whose power is a number, as photon i of a place p, for `settle`. points: CausticPoints."""
    for c in range(3):
        photon[DIRECTION + c, i] = points.direction[j, c]
        offset[c, i] = p[c] - points.position[j, c]
    photon[POWER, i] = points.power[j]
    for c in range(ENTRIES):
        photon[CURVATURE + c, i] = points.curvature[j, c]


@inline
def settle(photon, offset, count, companions, work):
    """Turn the first `count` photons of a place, photon (ROWS, >= n), to what they are there, and find their cones.

    Direction, power and curvature are given; offset (3, >= n) is the way to the place from where each photon landed. A
    photon keeps its own direction where that agrees better with those of the others. work (5, >= n).
    """
    x, y, z, own, chord, height = work[0], work[1], work[2], work[3], work[4], photon[HEIGHT]
    for i in range(count):
        x[i], y[i], z[i] = turned_photon(photon, i, (offset[0, i], offset[1, i], offset[2, i]))
        height[i] = _HIGHEST
    if count >= FEWEST:
        companions = min(companions, count - 1)
        _reach(photon[0], photon[1], photon[2], count, companions, chord, own)
        _reach(x, y, z, count, companions, chord, height)
        for i in range(count):
            if height[i] < own[i]:
                photon[0, i], photon[1, i], photon[2, i] = x[i], y[i], z[i]
            else:
                height[i] = own[i]
                for row in range(CURVATURE, ROWS):
                    photon[row, i] = ZERO
        _smooth(photon[0], photon[1], photon[2], count, height, own)
