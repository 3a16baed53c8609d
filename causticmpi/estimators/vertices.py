"""Vertices that wait for their full radiance, and the up to 16 of them that are worked on."""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline

WAITING = 2048
"""Room for vertices that wait: many times what a tile was ever seen to need."""


class Vertex(NamedTuple):
    """A non-specular vertex that waits for its full radiance.

    p: off its surface by `offset`; n: on the side of the eye; wo: unit direction back to the eye; throughput to the
    pixel; material; depth: non-specular vertices before it; layer its light belongs to; lane: pixel of the tile that
    it shines on; key of its random numbers
    """

    p: Any
    offset: Any
    n: Any
    wo: Any
    throughput: Any
    material: Any
    depth: Any
    layer: Any
    lane: Any
    key: Any


class Vertices(NamedTuple):
    """Rows of vertices: reals (rows, 13) float32: p, offset, n, wo, throughput; tags (rows, 4) int64: material, depth,
    layer, lane; key (rows,) uint64."""

    reals: Any
    tags: Any
    key: Any


def empty_vertices(rows: int) -> Vertices:
    """Room for so many."""
    return Vertices(np.zeros((rows, 13), np.float32), np.zeros((rows, 4), np.int64), np.zeros(rows, np.uint64))


@inline
def put(vertices, i, at):
    row = vertices.reals[i]
    row[0], row[1], row[2] = at.p
    row[3] = at.offset
    row[4], row[5], row[6] = at.n
    row[7], row[8], row[9] = at.wo
    row[10], row[11], row[12] = at.throughput
    tag = vertices.tags[i]
    tag[0], tag[1], tag[2], tag[3] = at.material, at.depth, at.layer, at.lane
    vertices.key[i] = at.key


@inline
def get(vertices, i):
    row, tag = vertices.reals[i], vertices.tags[i]
    return Vertex(
        (row[0], row[1], row[2]),
        row[3],
        (row[4], row[5], row[6]),
        (row[7], row[8], row[9]),
        (row[10], row[11], row[12]),
        tag[0],
        tag[1],
        tag[2],
        tag[3],
        vertices.key[i],
    )


@inline
def take(waiting, now, top):
    """Move the last up to 16 of `top` waiting vertices to `now`. Returns how many wait still, and how many were moved.

    The last first: a depth-first walk, whose stack stays short.
    """
    count = min(top, LANES)
    for i in range(count):
        put(now, i, get(waiting, top - count + i))
    return top - count, count
