"""A dragon with raised wings and a coiled tail, looking along x, about 1.5 high."""

import numpy as np

from causticmpi.scene.generated.implicit import (
    Bead,
    Field,
    Point,
    above_ground,
    mirrored,
    sheet,
    spline,
    tube,
    union,
    unit,
)
from causticmpi.scene.generated.polygonise import polygonise

NECK: list[Bead] = [
    (0.2, 0.5, 0, 0.165), (0.36, 0.62, 0, 0.125), (0.48, 0.78, 0, 0.098), (0.49, 0.97, 0, 0.082),
    (0.44, 1.13, 0, 0.075), (0.48, 1.27, 0, 0.074), (0.58, 1.33, 0, 0.07),
]  # fmt: skip
TRUNK: list[Bead] = [
    (0.2, 0.5, 0, 0.165), (0.08, 0.46, 0, 0.19), (-0.12, 0.43, 0, 0.185), (-0.3, 0.4, 0, 0.15), (-0.48, 0.33, 0, 0.11),
]  # fmt: skip
TAIL: list[Bead] = [
    (-0.48, 0.33, 0, 0.11), (-0.68, 0.22, 0, 0.082), (-0.87, 0.11, 0.04, 0.065), (-1.0, 0.06, 0.18, 0.055),
    (-0.99, 0.05, 0.37, 0.047), (-0.83, 0.045, 0.5, 0.04), (-0.62, 0.04, 0.53, 0.033), (-0.44, 0.05, 0.5, 0.026),
    (-0.3, 0.09, 0.47, 0.02),
]  # fmt: skip
SPADE: list[tuple[Point, Point, Point]] = [
    ((-0.33, 0.08, 0.475), (-0.27, 0.1, 0.57), (-0.1, 0.16, 0.43)),
    ((-0.33, 0.08, 0.475), (-0.1, 0.16, 0.43), (-0.31, 0.1, 0.385)),
]
SNOUT: list[Bead] = [(0.57, 1.33, 0, 0.085), (0.66, 1.315, 0, 0.07), (0.78, 1.275, 0, 0.05), (0.85, 1.262, 0, 0.04)]
JAW: list[Bead] = [(0.58, 1.28, 0, 0.055), (0.68, 1.2, 0, 0.036), (0.79, 1.14, 0, 0.024)]
NOSTRIL: list[Bead] = [(0.84, 1.285, 0.022, 0.02), (0.86, 1.3, 0.024, 0.013)]
BROW: list[Bead] = [(0.66, 1.36, 0.045, 0.022), (0.6, 1.395, 0.06, 0.024), (0.54, 1.42, 0.07, 0.012)]
HORN: list[Bead] = [
    (0.55, 1.38, 0.045, 0.034),
    (0.44, 1.46, 0.085, 0.028),
    (0.34, 1.49, 0.11, 0.02),
    (0.25, 1.56, 0.12, 0.011),
]
FANG: list[Bead] = [(0.8, 1.245, 0.03, 0.014), (0.805, 1.19, 0.03, 0.009)]
EAR: list[Bead] = [(0.54, 1.31, 0.06, 0.03), (0.46, 1.32, 0.12, 0.022), (0.4, 1.35, 0.15, 0.01)]
FORELEG: list[Bead] = [
    (0.2, 0.46, 0.13, 0.11), (0.13, 0.31, 0.19, 0.075), (0.19, 0.18, 0.2, 0.055), (0.25, 0.08, 0.2, 0.05),
    (0.3, 0.035, 0.2, 0.046),
]  # fmt: skip
HIND_LEG: list[Bead] = [
    (-0.27, 0.42, 0.11, 0.15), (-0.13, 0.29, 0.19, 0.11), (-0.2, 0.2, 0.2, 0.068), (-0.3, 0.12, 0.2, 0.05),
    (-0.26, 0.05, 0.2, 0.05), (-0.19, 0.035, 0.2, 0.046),
]  # fmt: skip
TOES = (-0.055, 0.0, 0.055)
SHOULDER, ELBOW, WRIST = (0.12, 0.6, 0.1), (-0.02, 0.86, 0.25), (0.1, 1.14, 0.38)
TIPS: list[Point] = [(-0.22, 1.56, 0.7), (-0.56, 1.3, 0.74), (-0.68, 0.98, 0.64), (-0.6, 0.7, 0.46)]
FLANK = (-0.3, 0.5, 0.1)
MEMBRANE = 0.013
"""Half the thickness of a wing."""
SCALLOP = 0.2
"""How far the edge of a wing draws back between two fingers, as a share of their length."""


def _wing(side: float) -> list[tuple[Field, float]]:
    """An arm, four fingers, and the skin between them: two triangles from the wrist for every bay."""

    def placed(point: Point) -> Point:
        return point[0], point[1], side * point[2]

    def bone(points: list[Point], radii: tuple[float, ...]) -> Field:
        return tube(spline([(*placed(p), r) for p, r in zip(points, radii, strict=True)], 5))

    parts = [(bone([SHOULDER, ELBOW, WRIST], (0.075, 0.045, 0.034)), 0.06)]
    for tip in TIPS:
        arched = tuple(0.5 * (w + t) + d for w, t, d in zip(WRIST, tip, (-0.01, 0.035, 0.03), strict=True))
        parts.append((bone([WRIST, (arched[0], arched[1], arched[2]), tip], (0.03, 0.022, 0.012)), 0.015))
    parts.append((tube([(*placed(WRIST), 0.024), (*placed((0.2, 1.24, 0.42)), 0.01)]), 0.015))
    rim = [*TIPS, FLANK]
    for near, far in zip(rim[:-1], rim[1:], strict=True):
        x, y, z = (0.5 * (n + f) for n, f in zip(near, far, strict=True))
        bay = (x + SCALLOP * (WRIST[0] - x), y + SCALLOP * (WRIST[1] - y), z + SCALLOP * (WRIST[2] - z))
        for a, b in ((near, bay), (bay, far)):
            parts.append((sheet(placed(WRIST), placed(a), placed(b), MEMBRANE), 0.015))
    for corners in ((SHOULDER, ELBOW, FLANK), (ELBOW, WRIST, FLANK)):
        a, b, c = (placed(corner) for corner in corners)
        parts.append((sheet(a, b, c, MEMBRANE), 0.015))
    return parts


def _spines() -> list[tuple[Field, float]]:
    """A row of thorns from the head along the back to the tail."""
    thorns = []
    neck_and_back = [*reversed(spline(NECK, 4)), *spline(TRUNK, 4)[1:]]
    for string, upright in ((neck_and_back, False), (spline(TAIL, 4)[:-8], True)):
        for before, (x, y, z, r), after in zip(string[:-2], string[1:-1], string[2:], strict=True):
            ax, ay, az = unit([after[axis] - before[axis] for axis in range(3)])
            # The tail lies on the ground, its thorns up; neck and back bend up and down, their thorns outward.
            ux, uy, uz = unit((-ay * ax, 1.0 - ay * ay, -ay * az)) if upright else (ay, -ax, 0.0)
            size = 0.045 + 0.35 * r
            out, back = r + size, 0.5 * size
            root = (x + 0.8 * r * ux, y + 0.8 * r * uy, z + 0.8 * r * uz, 0.012 + 0.2 * r)
            tip = (x + out * ux + back * ax, y + out * uy + back * ay, z + out * uz + back * az, 0.01)
            thorns.append((tube([root, tip]), 0.02))
    return thorns


def _foot(x: float, z: float) -> list[tuple[Field, float]]:
    toes = []
    for spread in TOES:
        knuckle, end = (x + 0.07, 0.035, z + spread), (x + 0.115, 0.02, z + 1.25 * spread)
        toes.append((tube([(x, 0.035, z + 0.4 * spread, 0.035), (*knuckle, 0.027), (*end, 0.018)]), 0.02))
        toes.append((tube([(*end, 0.016), (x + 0.16, 0.009, z + 1.4 * spread, 0.009)]), 0.008))
    return toes


def field() -> Field:
    """The dragon as a field."""
    parts: list[tuple[Field, float]] = [
        (tube(spline(TRUNK), flat=0.9), 1.0),
        (tube(spline(NECK)), 0.05),
        (tube(spline(TAIL, 6)), 0.03),
        (tube(spline(SNOUT), flat=0.85), 0.05),
        (tube(spline(JAW), flat=1.2), 0.03),
        *((sheet(*corners, 0.014), 0.02) for corners in SPADE),
    ]
    for beads, fillet in ((NOSTRIL, 0.02), (BROW, 0.02), (HORN, 0.02), (EAR, 0.02), (FANG, 0.01)):
        parts += [(tube(spline(side, 4)), fillet) for side in mirrored(beads)]
    for leg in (FORELEG, HIND_LEG):
        for side in mirrored(leg):
            parts.append((tube(spline(side, 4)), 0.06))
            parts += _foot(side[-1][0], side[-1][2])
    return above_ground(union([*parts, *_wing(1.0), *_wing(-1.0), *_spines()]))


def dragon(step: float = 0.0135) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32, triangles (T, 3) int32, edges about `step` long: 290,000 triangles."""
    return polygonise(field(), (-1.2, -0.05, -0.9), 2.2, step)
