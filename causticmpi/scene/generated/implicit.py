"""Solids as implicit surfaces: a field of (N, 3) points that is negative inside and grows about as fast as distance.

Fields use +, -, *, /, sqrt, min and max alone, one point at a time. IEEE 754 fixes the result of each of them, so every
machine makes the same mesh to the last bit.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

Field = Callable[[np.ndarray], np.ndarray]
"""(N, 3) float64 -> (N,) float64."""
Point = tuple[float, float, float]
Bead = tuple[float, float, float, float]
"""Centre and radius of a sphere that a tube runs through."""


def tube(beads: Sequence[Bead], flat: float = 1.0) -> Field:
    """A string of tapered capsules through the beads, its extent along z times `flat`."""
    rows = np.array([_segment(a, b, flat) for a, b in zip(beads[:-1], beads[1:], strict=True)])

    def field(points: np.ndarray) -> np.ndarray:
        # Late: it brings numba along, and only who makes a mesh needs it.
        from causticmpi.scene.generated.capsules import lessen_to_capsules

        nearest = np.full(len(points), np.inf)
        lessen_to_capsules(rows, points[:, 0].copy(), points[:, 1].copy(), points[:, 2] / flat, nearest)
        return nearest * min(flat, 1.0)

    return field


def _segment(a: Bead, b: Bead, flat: float) -> tuple[float, ...]:
    """Start, axis, radius, its growth along the axis, squared length."""
    x, y, z = b[0] - a[0], b[1] - a[1], (b[2] - a[2]) / flat
    return a[0], a[1], a[2] / flat, x, y, z, a[3], b[3] - a[3], x * x + y * y + z * z


def sheet(a: Point, b: Point, c: Point, radius: float) -> Field:
    """All points within `radius` of a triangle."""
    corners = np.array([a, b, c])
    edges = np.roll(corners, -1, axis=0) - corners
    nx, ny, nz = normal = _cross(edges[0], edges[1])
    normal_squared = nx * nx + ny * ny + nz * nz
    sides = [(corner, edge, _cross(edge, normal)) for corner, edge in zip(corners, edges, strict=True)]

    def field(points: np.ndarray) -> np.ndarray:
        beyond = np.zeros(len(points), dtype=bool)
        to_edge = np.full(len(points), np.inf)
        for corner, (ex, ey, ez), (ox, oy, oz) in sides:
            px, py, pz = points[:, 0] - corner[0], points[:, 1] - corner[1], points[:, 2] - corner[2]
            beyond |= px * ox + py * oy + pz * oz > 0.0
            along = np.clip((px * ex + py * ey + pz * ez) / (ex * ex + ey * ey + ez * ez), 0.0, 1.0)
            px, py, pz = px - along * ex, py - along * ey, pz - along * ez
            np.minimum(to_edge, px * px + py * py + pz * pz, out=to_edge)
        height = (points[:, 0] - a[0]) * nx + (points[:, 1] - a[1]) * ny + (points[:, 2] - a[2]) * nz
        return np.sqrt(np.where(beyond, to_edge, height * height / normal_squared)) - radius

    return field


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def union(parts: Iterable[tuple[Field, float]]) -> Field:
    """Parts joined one after another, each with a fillet about as wide as the number beside it."""
    parts = tuple(parts)

    def field(points: np.ndarray) -> np.ndarray:
        joined = parts[0][0](points)
        for part, fillet in parts[1:]:
            other = part(points)
            overlap = np.maximum(fillet - np.abs(joined - other), 0.0)
            joined = np.minimum(joined, other) - overlap * overlap / (4.0 * fillet)
        return joined

    return field


def above_ground(solid: Field) -> Field:
    """The part of a solid with y > 0: feet stand flat."""
    return lambda points: np.maximum(solid(points), -points[:, 1])


def mirrored(beads: Sequence[Bead]) -> tuple[list[Bead], list[Bead]]:
    """The same string on the left and on the right, across z = 0."""
    return list(beads), [(x, y, -z, r) for x, y, z, r in beads]


def spline(beads: Sequence[Bead], steps: int = 8) -> list[Bead]:
    """A Catmull-Rom curve through the beads, `steps` pieces between two of them; radii follow likewise."""
    ends = [_beyond(beads[0], beads[1]), *beads, _beyond(beads[-1], beads[-2])]
    curve: list[Bead] = []
    for p, q, r, s in zip(ends[:-3], ends[1:-2], ends[2:-1], ends[3:], strict=True):
        for step in range(steps):
            t = step / steps
            x, y, z, radius = (
                0.5 * (2 * b + t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * b - a - 3 * c + d))))
                for a, b, c, d in zip(p, q, r, s, strict=True)
            )
            curve.append((x, y, z, max(radius, 0.5 * min(q[3], r[3]))))
    return [*curve, beads[-1]]


def _beyond(end: Bead, inner: Bead) -> Bead:
    x, y, z, r = (2 * e - i for e, i in zip(end, inner, strict=True))
    return x, y, z, r


def unit(vector: Sequence[float]) -> Point:
    """The vector at length 1."""
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length
