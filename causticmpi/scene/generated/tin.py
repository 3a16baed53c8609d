"""A tea tin of radius 1 and height 2.4, and its lid: outlines turned about the y axis. Both are closed."""

import math

import numpy as np

Pair = tuple[float, float]
"""Radius and height, or a direction in a plane."""
HEIGHT, GROOVES = 2.4, (0.28, 0.38, 1.72, 1.82)
GROOVE_DEPTH, GROOVE_WIDTH = 0.025, 0.04
LID_FROM, LID_TO, LID_RADIUS = 2.0, 2.5, 1.03
ROWS = 150
"""Along the wall of the tin."""


def tin(doublings: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """The body: vertices (V, 3) float32, triangles (T, 3) int32. Four times 2**doublings segments go around."""
    heights = (0.05 + (HEIGHT - 0.1) * row / ROWS for row in range(1, ROWS))
    wall = [(1.0 - _groove(height), height) for height in heights]
    return _turned([*_corner(1.0, 0.0, 0.05), *wall, *_corner(1.0, HEIGHT, -0.05)], doublings)


def lid(doublings: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """The lid in its place on the tin, with a raised disc: vertices (V, 3) float32, triangles (T, 3) int32."""
    skirt = [*_corner(LID_RADIUS, LID_FROM, 0.01), *_corner(LID_RADIUS, LID_TO, -0.08)]
    return _turned([*skirt, (0.75, LID_TO), *_corner(0.72, LID_TO + 0.04, -0.02)], doublings)


def _groove(height: float) -> float:
    """Depth of the wall below radius 1."""
    away = min(abs(height - groove) for groove in GROOVES) / GROOVE_WIDTH
    return GROOVE_DEPTH * (1.0 - away * away) * (1.0 - away * away) if away < 1.0 else 0.0


def _corner(radius: float, height: float, rounding: float) -> list[Pair]:
    """A rounded edge: from flat to wall above `height`, or with a negative rounding from wall to flat below it."""
    size = abs(rounding)
    arc = _between([(0.0, -1.0), (1.0, 0.0)] if rounding > 0.0 else [(1.0, 0.0), (0.0, 1.0)], 3)
    return [(radius - size + size * x, height + rounding + size * y) for x, y in arc]


def _between(directions: list[Pair], doublings: int) -> list[Pair]:
    """Unit vectors, halving the angles again and again: no sines, which machines round each in their own way."""
    for _ in range(doublings):
        finer = [directions[0]]
        for (ax, ay), (bx, by) in zip(directions[:-1], directions[1:], strict=True):
            length = math.sqrt((ax + bx) * (ax + bx) + (ay + by) * (ay + by))
            finer += [((ax + bx) / length, (ay + by) / length), (bx, by)]
        directions = finer
    return directions


def _turned(outline: list[Pair], doublings: int) -> tuple[np.ndarray, np.ndarray]:
    """The solid that an outline, given from below to above, makes about y; closed by flat ends."""
    around = np.array(_between([(1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)], doublings)[:-1])
    radius, height = np.array(outline).T
    rings = np.empty((len(outline), len(around), 3))
    rings[..., 0::2], rings[..., 1] = radius[:, None, None] * around, height[:, None]
    poles = [(0.0, height[0], 0.0), (0.0, height[-1], 0.0)]
    number = np.arange(rings.size // 3, dtype=np.int32).reshape(rings.shape[:2])
    following = np.roll(number, -1, axis=1)
    below, above = np.full(len(around), number.size), np.full(len(around), number.size + 1)
    triangles = [
        (below, following[0], number[0]),
        (number[:-1], following[:-1], following[1:]),
        (number[:-1], following[1:], number[1:]),
        (above, number[-1], following[-1]),
    ]
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in triangles])
    return np.concatenate([rings.reshape(-1, 3), poles]).astype(np.float32), faces.astype(np.int32)
