"""A trotting horse, withers at y = 1, looking along x, its left foreleg lifted."""

import numpy as np

from causticmpi.scene.generated.implicit import Bead, Field, above_ground, mirrored, spline, tube, union
from causticmpi.scene.generated.polygonise import polygonise

TRUNK: list[Bead] = [
    (0.41, 0.76, 0, 0.125), (0.27, 0.755, 0, 0.2), (0.08, 0.735, 0, 0.2), (-0.12, 0.75, 0, 0.185),
    (-0.31, 0.79, 0, 0.185), (-0.44, 0.79, 0, 0.15),
]  # fmt: skip
NECK: list[Bead] = [
    (0.27, 0.84, 0, 0.17), (0.4, 0.95, 0, 0.15), (0.5, 1.1, 0, 0.11), (0.57, 1.25, 0, 0.083), (0.625, 1.345, 0, 0.068),
]  # fmt: skip
FACE: list[Bead] = [(0.65, 1.35, 0, 0.066), (0.72, 1.265, 0, 0.062), (0.8, 1.13, 0, 0.042), (0.84, 1.06, 0, 0.046)]
JAW: list[Bead] = [(0.675, 1.255, 0, 0.078), (0.755, 1.13, 0, 0.036), (0.815, 1.045, 0, 0.033)]
EAR: list[Bead] = [(0.635, 1.39, 0.038, 0.026), (0.645, 1.44, 0.05, 0.022), (0.66, 1.495, 0.05, 0.006)]
EYE: list[Bead] = [(0.715, 1.3, 0.046, 0.014), (0.722, 1.292, 0.046, 0.014)]
FORELEG: list[Bead] = [
    (0.31, 0.72, -0.085, 0.12), (0.28, 0.575, -0.1, 0.085), (0.295, 0.46, -0.1, 0.056), (0.305, 0.35, -0.1, 0.046),
    (0.3, 0.29, -0.1, 0.034), (0.3, 0.16, -0.1, 0.03), (0.305, 0.115, -0.1, 0.036), (0.335, 0.06, -0.1, 0.032),
]  # fmt: skip
FOREHOOF: list[Bead] = [(0.335, 0.055, -0.1, 0.036), (0.355, 0.0, -0.1, 0.055)]
LIFTED_LEG: list[Bead] = [
    (0.33, 0.71, 0.085, 0.12), (0.36, 0.6, 0.1, 0.085), (0.45, 0.53, 0.1, 0.058), (0.53, 0.48, 0.1, 0.046),
    (0.525, 0.42, 0.1, 0.035), (0.47, 0.31, 0.1, 0.03), (0.45, 0.275, 0.1, 0.036), (0.405, 0.25, 0.1, 0.03),
]  # fmt: skip
LIFTED_HOOF: list[Bead] = [(0.405, 0.25, 0.1, 0.035), (0.365, 0.205, 0.1, 0.045)]
HIND_LEG: list[Bead] = [
    (-0.36, 0.77, 0.08, 0.155), (-0.32, 0.6, 0.1, 0.115), (-0.4, 0.47, 0.1, 0.066), (-0.475, 0.37, 0.1, 0.047),
    (-0.47, 0.31, 0.1, 0.037), (-0.45, 0.17, 0.1, 0.033), (-0.445, 0.115, 0.1, 0.038), (-0.41, 0.06, 0.1, 0.033),
]  # fmt: skip
HIND_HOOF: list[Bead] = [(-0.41, 0.055, 0.1, 0.036), (-0.39, 0.0, 0.1, 0.054)]
STRIDE = 0.13
"""The right hind leg is so far ahead of the left."""
TAIL: list[Bead] = [
    (-0.53, 0.87, 0, 0.04), (-0.62, 0.93, 0, 0.045), (-0.72, 0.87, 0, 0.062), (-0.77, 0.7, 0.01, 0.075),
    (-0.77, 0.52, 0.02, 0.07), (-0.82, 0.36, 0.02, 0.04), (-0.89, 0.27, 0.02, 0.012),
]  # fmt: skip
CREST: list[tuple[float, float]] = [(0.645, 1.42), (0.57, 1.38), (0.5, 1.28), (0.44, 1.17), (0.36, 1.08), (0.25, 1.0)]
"""x, y of the roots of the mane."""


def _mane() -> list[tuple[Field, float]]:
    """Locks that fly back from the crest, to the left and to the right by turns, and a forelock."""
    roots = spline([(x, y, 0.0, 1.0) for x, y in CREST], 3)
    locks = []
    for i, (x, y, _, _) in enumerate(roots[1:-1], start=1):
        aside = 0.03 if i % 2 else -0.03
        long = 0.75 + 0.5 * i / len(roots)
        locks.append(
            [
                (x + 0.02, y - 0.045, 0.0, 0.034),
                (x - 0.035 * long, y + 0.02, 0.5 * aside, 0.034),
                (x - 0.1 * long, y - 0.005, aside, 0.026),
                (x - 0.17 * long, y - 0.06, 1.2 * aside, 0.006),
            ]
        )
    locks.append([(0.63, 1.41, 0, 0.03), (0.69, 1.4, 0, 0.026), (0.735, 1.34, 0.01, 0.02), (0.775, 1.28, 0.01, 0.006)])
    return [(tube(spline(lock, 5), flat=0.8), 0.012) for lock in locks]


def field() -> Field:
    """The horse as a field."""
    other_hind, other_hoof = (
        [(x + STRIDE * (0.8 - y) / 0.8, y, -z, r) for x, y, z, r in beads] for beads in (HIND_LEG, HIND_HOOF)
    )
    tail = tube(spline(TAIL))
    strand = tube(spline([(x - 0.05, y - 0.02, z + 0.04, 0.6 * r) for x, y, z, r in TAIL[2:]]))
    return above_ground(
        union(
            [
                (tube(spline(TRUNK), flat=0.82), 1.0),
                (tube(spline(NECK), flat=0.62), 0.1),
                (tube(spline(FACE), flat=0.8), 0.03),
                (tube(spline(JAW), flat=0.72), 0.025),
                *((tube(spline(leg, 4)), 0.07) for leg in (FORELEG, LIFTED_LEG, HIND_LEG, other_hind)),
                *((tube(hoof), 0.012) for hoof in (FOREHOOF, LIFTED_HOOF, HIND_HOOF, other_hoof)),
                *((tube(ear), 0.015) for ear in mirrored(EAR)),
                *((tube(eye), 0.01) for eye in mirrored(EYE)),
                (tail, 0.03),
                (strand, 0.02),
                *_mane(),
            ]
        )
    )


def horse(step: float = 0.0115) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32, triangles (T, 3) int32, edges about `step` long: 200,000 triangles."""
    return polygonise(field(), (-1.1, -0.05, -0.5), 2.2, step)
