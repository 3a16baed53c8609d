#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Write scenes/meshes/*.ply anew, the same bytes on every run.

The benchmark's tessellations: flat-shaded triangles, so that every renderer sees the same surface.
"""

import argparse
import math
from pathlib import Path

import numpy as np

MESHES = Path(__file__).resolve().parent.parent / "scenes" / "meshes"


def ring(
    inner: float, outer: float, bottom: float, top: float, segments: int, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Upright shell between two cylinders about y, rims closed: segments * (4 * rows + 4) triangles, outward."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for radius, outward in ((inner, False), (outer, True)):
        base = len(vertices)
        for row in range(rows + 1):
            for i in range(segments):
                angle = 2 * math.pi * i / segments
                y = bottom + (top - bottom) * row / rows
                vertices.append((radius * math.cos(angle), y, radius * math.sin(angle)))
        for row in range(rows):
            for i in range(segments):
                p, q = base + row * segments + i, base + row * segments + (i + 1) % segments
                s, t = p + segments, q + segments
                faces += [(p, s, q), (q, s, t)] if outward else [(p, q, s), (q, t, s)]
    wall = segments * (rows + 1)
    for i in range(segments):
        j = (i + 1) % segments
        for level, upward in ((rows * segments, True), (0, False)):
            a, b, c, d = level + i, level + j, wall + level + i, wall + level + j
            faces += [(a, b, c), (b, d, c)] if upward else [(a, c, b), (b, c, d)]
    return np.array(vertices), np.array(faces)


WAVES = ((0.007, 11, 0.4, 0.3), (0.006, 15, 1.7, 1.1), (0.005, 19, 2.6, 2.0), (0.003, 23, 1.0, 0.7))
"""Amplitude, wave number, heading and phase of each sine."""


def water(half_side: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Open height field over a square in x, z: 2 * cells^2 triangles, normals up."""
    grid = np.linspace(-half_side, half_side, cells + 1)
    vertices = [
        (x, sum(a * math.sin(k * (math.cos(h) * x + math.sin(h) * z) + phase) for a, k, h, phase in WAVES), z)
        for z in grid.tolist()
        for x in grid.tolist()
    ]
    column, row = np.meshgrid(np.arange(cells), np.arange(cells))
    p = (row * (cells + 1) + column).ravel()
    q, r, t = p + 1, p + cells + 1, p + cells + 2
    return np.array(vertices), np.concatenate([np.stack([p, r, q], 1), np.stack([q, r, t], 1)])


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Binary little-endian PLY."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def main(directory: Path) -> None:
    """Write both meshes."""
    directory.mkdir(parents=True, exist_ok=True)
    write_ply(directory / "ring.ply", *ring(0.98, 1.02, -0.01, 0.6, 300, 9))
    write_ply(directory / "water.ply", *water(1.001, 128))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, nargs="?", default=MESHES, help="for other places than scenes/meshes")
    main(parser.parse_args().directory)
