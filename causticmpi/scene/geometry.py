"""Shapes -> triangles with float32 corners. The front of a triangle follows the right-hand rule of its corners."""

from typing import NamedTuple

import numpy as np

from causticmpi.config.check import MAX_COORDINATE
from causticmpi.errors import InputError
from causticmpi.scene.records import Box, Quad, Sphere

FLATNESS = 5e-3
"""Largest spread of a quad's corners about one plane, relative to its size: measured rooms are a little skew."""
_ZERO_AREA = 1e-12
"""Twice a triangle's area over its squared longest edge, below which it has no normal worth the name."""


class ZeroAreaError(InputError):
    """A shape without area: nothing can hit it, and nothing can be emitted from it."""


class Triangles(NamedTuple):
    """vertices (V, 3) float32, scene units; triangles (T, 3) int32; dropped: triangles of zero area left out."""

    vertices: np.ndarray
    triangles: np.ndarray
    dropped: int = 0


def as_float32(points: np.ndarray, name: str) -> np.ndarray:
    """The same array in float32. Raises InputError, without a place, for coordinates float32 cannot use."""
    if not np.isfinite(points).all():
        raise InputError(f"{name}: found coordinates that are not finite; allowed: finite numbers; repair them")
    largest = float(np.abs(points).max(initial=0.0))
    if largest > MAX_COORDINATE:
        raise InputError(
            f"{name}: found coordinate {largest:g}; allowed: up to {MAX_COORDINATE:g}, which float32 can use;"
            " scale the scene down"
        )
    return points.astype(np.float32)


def has_area(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(T,) bool: which triangles have an area after the rounding of their corners to float32."""
    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    edges = np.stack([b - a, c - b, a - c])
    longest = (edges**2).sum(axis=2).max(axis=0)
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return twice_area > _ZERO_AREA * longest


def quad_triangles(quad: Quad) -> Triangles:
    """Two triangles. Raises InputError, without a place, unless the corners go around a flat convex outline."""
    corners = np.array(quad.corners, dtype=np.float64)
    vertices = as_float32(corners, "corners")
    # Newell's normal: the outline's area vector, which a crossing cancels partly or wholly. Relative to the size,
    # so that huge and tiny quads are judged alike.
    size = float(np.abs(corners - corners[0]).max())
    if size == 0.0:
        raise ZeroAreaError("corners: all four are the same point, zero area; spread them")
    unit = (corners - corners[0]) / size
    turns = np.cross(np.roll(unit, -1, axis=0) - unit, np.roll(unit, -2, axis=0) - np.roll(unit, -1, axis=0))
    if np.linalg.norm(turns, axis=1).max() <= _ZERO_AREA:
        raise ZeroAreaError("corners: all four lie on one line, zero area; spread them")
    normal = np.cross(unit, np.roll(unit, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(normal)
    if length <= _ZERO_AREA or (turns @ normal <= 0.0).any():
        raise InputError(
            "corners: they do not go around a convex outline (crossing, dented, or two corners in one place);"
            " list them in order around the quad, or split it"
        )
    heights = unit @ (normal / length)
    deviation = float(np.ptp(heights))
    if deviation > FLATNESS:
        raise InputError(
            f"corners: not in one plane, off by {deviation * size:g}; allowed: {FLATNESS * size:g};"
            " move the corners or use a mesh"
        )
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    if not has_area(vertices, triangles).all():
        raise ZeroAreaError("corners: zero area once rounded to float32; move the scene nearer to the origin")
    return Triangles(vertices, triangles)


# Corner i of a box takes its maximum in x, y, z where bits 0, 1, 2 of i are set; each row goes around one face.
_BOX_FACES = np.array([[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]])


def box_triangles(box: Box) -> Triangles:
    """12 triangles, outward normals. Raises InputError, without a place, unless min < max on each axis."""
    ends = as_float32(np.array([box.min, box.max], dtype=np.float64), "min, max")
    for axis, name in enumerate("xyz"):
        if not ends[0, axis] < ends[1, axis]:
            raise InputError(
                f"min, max: found {box.min[axis]:g} and {box.max[axis]:g} in {name}; allowed: min < max"
                " (in float32); swap them, or use a quad for a flat box"
            )
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    vertices = ends[bits, np.arange(3)]
    triangles = np.concatenate([_BOX_FACES[:, [0, 1, 2]], _BOX_FACES[:, [0, 2, 3]]]).astype(np.int32)
    return Triangles(vertices, triangles)


def sphere_row(sphere: Sphere) -> np.ndarray:
    """(4,) float32: centre, radius. Raises InputError, without a place, for a radius that is not > 0 in float32."""
    if sphere.radius <= 0.0:
        kind = ZeroAreaError if sphere.radius == 0.0 else InputError
        raise kind(f"radius: found {sphere.radius:g}; allowed: a number > 0; write for example 1")
    row = as_float32(np.array([*sphere.center, sphere.radius], dtype=np.float64), "center, radius")
    if row[3] <= np.spacing(np.abs(row[:3]).max()):
        raise InputError(
            f"radius: found {sphere.radius:g}, which vanishes in float32 at this centre;"
            " move the scene nearer to the origin or enlarge the sphere"
        )
    return row
