"""The zero surface of a field -> closed triangle mesh: marching tetrahedra, then even triangles on the true surface.

Tetrahedra leave no ambiguous case: every edge of the mesh has exactly two triangles, whatever the field.
"""

import itertools
import math

import numpy as np

from causticmpi.scene.generated.implicit import Field, Point

STEEPNESS = 2.0
"""A field changes by at most so much per unit of distance: which cells may hold surface."""
CHUNK = 8192
"""Points per evaluation: the temporaries stay in cache."""
ROUNDS, SMOOTHINGS = 3, 4
"""After each of the rounds of smoothing along the surface, vertices are put back onto it."""

# Cube corners as bits x, y, z; the six tetrahedra share the diagonal from corner 0 to corner 7, all right-handed.
_CORNERS = (np.arange(8)[:, None] >> np.arange(3)) & 1
_PATHS = [(0, 1 << a, (1 << a) | (1 << b), 7) for a, b, _ in itertools.permutations(range(3))]
_TETRAHEDRA = [p if (p[1], p[2]) in ((1, 3), (2, 6), (4, 5)) else (p[0], p[2], p[1], p[3]) for p in _PATHS]
# Tetrahedral differences: the gradient from four evaluations.
_PROBES = np.array([(1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)], dtype=np.float64)


def polygonise(field: Field, low: Point, extent: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and triangles (T, 3) int32, normals outward, of the surface field = 0.

    The surface must lie within the cube from `low` that is `extent` wide; `step` is the grid's.
    """
    origin = np.array(low)
    levels = max(math.ceil(extent / step) - 1, 1).bit_length()
    cells = _surface_cells(field, origin, step, levels)
    vertices, triangles = _march(field, origin, step, cells, 2**levels + 1)
    for _ in range(ROUNDS):
        for _ in range(SMOOTHINGS):
            vertices = _smoothed(vertices, triangles)
        vertices = _projected(field, vertices, step)
    vertices = _projected(field, vertices, step)
    return vertices.astype(np.float32), triangles.astype(np.int32)


def evaluate(field: Field, points: np.ndarray) -> np.ndarray:
    """(N,) float64: the field, a chunk at a time."""
    return np.concatenate([field(points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)])


def _surface_cells(field: Field, origin: np.ndarray, step: float, levels: int) -> np.ndarray:
    """(C, 3) int64: the finest cells near the surface, found by halving those that may hold some of it."""
    cells = np.zeros((1, 3), dtype=np.int64)
    for level in range(levels, -1, -1):
        size = step * 2**level
        centre = origin + (cells + 0.5) * size
        reach = STEEPNESS * size * 0.8660254037844386
        cells = cells[np.abs(evaluate(field, centre)) <= reach]
        if level:
            cells = (2 * cells[:, None] + _CORNERS).reshape(-1, 3)
    return cells


def _march(
    field: Field, origin: np.ndarray, step: float, cells: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Marching tetrahedra. A vertex is named by the two grid points it lies between."""
    lattice = cells[:, None] + _CORNERS  # (C, 8, 3)
    names = (lattice[..., 0] * side + lattice[..., 1]) * side + lattice[..., 2]
    points, index = np.unique(names, return_inverse=True)
    index = index.reshape(-1, 8)
    grid = np.stack([points // (side * side), points // side % side, points % side], axis=1)
    value = evaluate(field, origin + grid * step)
    tetrahedra = np.concatenate([index[:, list(corners)] for corners in _TETRAHEDRA])
    inside = value[tetrahedra] < 0.0
    ends = _edges_crossed(tetrahedra, inside)  # (T, 3, 2)
    ends.sort(axis=2)
    edge, triangles = np.unique(ends[..., 0] * len(points) + ends[..., 1], return_inverse=True)
    a, b = edge // len(points), edge % len(points)
    # Off the grid points, where triangles would shrink to nothing.
    share = np.clip(value[a] / (value[a] - value[b]), 0.1, 0.9)[:, None]
    return origin + step * (grid[a] + share * (grid[b] - grid[a])), triangles.reshape(-1, 3)


def _edges_crossed(tetrahedra: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(T, 3, 2): for each corner of each triangle the grid points on both sides of it."""
    found = []
    count = inside.sum(axis=1)
    for corner in range(4):
        # The other three in the order that keeps the tetrahedron right-handed.
        p, q, r = ((1, 3, 2), (0, 2, 3), (0, 3, 1), (0, 1, 2))[corner]
        for lone, order in ((1, (p, r, q)), (3, (p, q, r))):
            rows = tetrahedra[(count == lone) & (inside[:, corner] == (lone == 1))]
            found.append(np.stack([rows[:, [corner, other]] for other in order], axis=1))
    for a, b, c, d in ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (2, 3, 0, 1), (3, 1, 0, 2), (1, 2, 0, 3)):
        rows = tetrahedra[(count == 2) & inside[:, a] & inside[:, b]]
        ac, ad, bc, bd = (rows[:, pair] for pair in ([a, c], [a, d], [b, c], [b, d]))
        found += [np.stack([ac, ad, bd], axis=1), np.stack([ac, bd, bc], axis=1)]
    return np.concatenate(found)


def _smoothed(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Each vertex half the way to the mean of its neighbours, along the surface only."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    face = np.cross(b - a, c - a)
    around = np.bincount(start).astype(np.float64)
    mean, normal = np.empty_like(vertices), np.empty_like(vertices)
    for axis in range(3):
        mean[:, axis] = np.bincount(start, weights=vertices[end, axis]) / around
        normal[:, axis] = np.bincount(start, weights=np.repeat(face[:, axis], 3))
    shift = mean - vertices
    shift -= normal * (_dot(shift, normal) / np.maximum(_dot(normal, normal), 1e-300))[:, None]
    return vertices + 0.5 * shift


def _projected(field: Field, vertices: np.ndarray, step: float) -> np.ndarray:
    """One Newton step to the surface, at most one grid step long."""
    apart = 1e-3 * step
    gradient, value = np.zeros_like(vertices), np.zeros(len(vertices))
    for probe in _PROBES:
        found = evaluate(field, vertices + apart * probe)
        gradient += found[:, None] * probe
        value += found
    gradient /= 4.0 * apart
    value /= 4.0
    length = np.clip(value / np.maximum(_dot(gradient, gradient), 0.04), -step, step)
    return vertices - gradient * length[:, None]


def _dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[:, 0] * v[:, 0] + u[:, 1] * v[:, 1] + u[:, 2] * v[:, 2]
