"""Where paths are kept: queues of vertices that wait, and the 16 lanes that are worked on.

Paths go on in waves, those of path tracing as told here, particles much alike (`particle_waves`). A vertex that a ray
has found waits in one of two queues, of specular and of other surfaces, so that the 16 lanes of a packet do the same
work and hold hardly a dead path. A queue holds the rows below one after the other, each as long as there is room for
vertices. A stage copies 16 vertices to `work`, which begins with an `embree.ray_buffer`, and works on them in loops
over the lanes that the compiler turns into vector instructions: no branches, no calls, and nothing read but `work` at
offsets known when compiling. What tables say of a lane lies in one line of the cache (`lanes.take8`, `lanes.take16`),
and the lanes that go on are packed behind those that wait already (`lanes.pack`).

Vertices of one pixel keep their order in every queue whoever else is there, and Embree's answer to a ray does not
depend on the other lanes (tests/test_embree.py): so a pixel's sums are the same bits in any picture.
"""

import numpy as np

from causticmpi.kernels import lanes
from causticmpi.kernels.embree import DIR, LANES, PRIM, RAY16, TFAR, ray_buffer
from causticmpi.kernels.jit import inline

GROUP = 512
"""Pixels whose paths go on together: enough to fill packets, few enough to stay in the cache."""
FIRST_SPLIT, SECOND_SPLIT = 4, 2
"""Rays of the first and of the second non-specular vertex of a path (see `path_tracing`)."""
MOST_WAITING = GROUP * FIRST_SPLIT * SECOND_SPLIT
"""A bound that no queue can pass: later vertices send one ray each."""

_FIRST = RAY16 + 24 * LANES
(
    ORIGIN,
    DIRECTION,
    DISTANCE,
    PRIMITIVE,
    THROUGHPUT,
    DOUBT,
    KEY,
    PIXEL,
    DEPTH,
    CHAIN,
    _VERTEX_END,
) = (_FIRST + LANES * row for row in (0, 3, 6, 7, 8, 11, 12, 14, 15, 16, 17))
"""Rows of a vertex, as word offsets of the lanes in `work`.

ORIGIN, DIRECTION, DISTANCE: the ray that found it and how far away; PRIMITIVE int32; THROUGHPUT to the pixel; DOUBT
[sr]: 1 / density of the sample that found it if next-event estimation might have done so as well, else 0; KEY uint64:
its random numbers; PIXEL int32: twice the row of the film, and 1 more if the path belongs to L_c; DEPTH, CHAIN int32:
non-specular vertices before it, specular ones since."""
ROWS, _KEY_ROW = (_VERTEX_END - _FIRST) // LANES, (KEY - _FIRST) // LANES
ROOM = MOST_WAITING + LANES
"""Words of a row in a queue: packing writes 16 at a time."""

(
    SURFACE,
    SIZE,
    MATERIAL,
    LIGHT,
    KIND,
    SHAPE,
    POINT,
    NORMAL,
    OFFSET,
    RADIANCE,
    ALIVE,
    SPLITS,
    REFLECTANCE,
    CHOICE,
    U,
    V,
    LIGHT_U,
    LIGHT_V,
    SURVIVE,
    CHOSEN,
    CORNER,
    EDGE1,
    EDGE2,
    LIGHT_NORMAL,
    LIGHT_PDF,
    LIGHT_RADIANCE,
    LIGHT_REACH,
    TO_LIGHT,
    CONTRIBUTION,
    IOR,
    IS_MIRROR,
    ETA2,
    _SCRATCH_END,
) = (
    _VERTEX_END + LANES * row
    for row in (
        0, 3, 4, 5, 6, 7, 8, 11, 14, 15, 18, 19, 20, 23, 24, 25, 26, 27, 28,
        29, 30, 33, 36, 39, 42, 43, 46, 47, 50, 53, 54, 55, 56,
    )
)  # fmt: skip
"""Rows of what a stage finds out about its lanes: SURFACE, SIZE, MATERIAL, LIGHT, KIND and SHAPE are a row of
`scene.surface`, CORNER to LIGHT_RADIANCE one of `scene.light_row`."""
FOUND, FOUND_THROUGHPUT, FOUND_DOUBT, FOUND_PIXEL, FOUND_CHAIN, FOUND_KEY, FOUND_DEPTH = 12, 13, 16, 18, 19, 20, 22
FOUND_LIGHT = 23
"""Rows of a traced packet, in which Embree's normal and the like are replaced by what a vertex is made of: the kind of
material it is on, -1 for none, the rows above, and whether it is on a light."""
PACKET_WORDS = 24 * LANES
PACKETS = _SCRATCH_END
"""The packets of the rays of a block, FIRST_SPLIT of them."""


def lanes_and_packets(packets: int) -> np.ndarray:
    """`work` with room for so many packets at PACKETS."""
    work = ray_buffer(PACKETS + packets * PACKET_WORDS - _FIRST)
    for j in range(packets):
        packet = PACKETS + j * PACKET_WORDS
        work[packet : packet + PACKET_WORDS] = work[RAY16 : RAY16 + PACKET_WORDS]
    return work


def path_work() -> tuple[np.ndarray, np.ndarray]:
    """Workspace: `work`, and the queues (2 waves, 2 kinds, words) float32."""
    return lanes_and_packets(FIRST_SPLIT), np.zeros((2, 2, ROWS * ROOM), np.float32)


@inline
def get3(work, row, lane):
    """Three rows of a lane as a vector."""
    return work[row + lane], work[row + 16 + lane], work[row + 32 + lane]


@inline
def put3(work, row, lane, value):
    work[row + lane] = value[0]
    work[row + 16 + lane] = value[1]
    work[row + 32 + lane] = value[2]


@inline
def place(row, position):
    """Where in a queue a row of `work` has what belongs to the vertex number `position`."""
    return (row - _FIRST) // LANES * ROOM + position


@inline
def load_block(work, queue, block, used):
    """Copy 16 vertices of a queue to the lanes; of those beyond `used`, PRIMITIVE is 0 and the rest without meaning."""
    words = work.view(np.int32)
    for row in range(ROWS):
        if row != _KEY_ROW and row != _KEY_ROW + 1:
            lanes.copy(queue, row * ROOM + LANES * block, work, _FIRST + LANES * row)
    for half in range(2):
        lanes.copy(queue, _KEY_ROW * ROOM + LANES * (2 * block + half), work, KEY + LANES * half)
    for i in range(LANES):
        words[PRIMITIVE + i] = words[PRIMITIVE + i] if i < used else np.int32(0)


@inline
def push(work, packet, mask, queue, count):
    """Let the vertices that the marked lanes of a packet have found wait behind `count` others. Returns how many do."""
    for c in range(3):
        lanes.pack(work, packet + 16 * c, mask, queue, place(ORIGIN + 16 * c, count))
        lanes.pack(work, packet + 16 * (DIR + c), mask, queue, place(DIRECTION + 16 * c, count))
        lanes.pack(work, packet + 16 * (FOUND_THROUGHPUT + c), mask, queue, place(THROUGHPUT + 16 * c, count))
    lanes.pack(work, packet + 16 * TFAR, mask, queue, place(DISTANCE, count))
    lanes.pack(work, packet + 16 * PRIM, mask, queue, place(PRIMITIVE, count))
    lanes.pack(work, packet + 16 * FOUND_DOUBT, mask, queue, place(DOUBT, count))
    lanes.pack_long(work, packet + 16 * FOUND_KEY, mask, queue, place(KEY, 2 * count))
    lanes.pack(work, packet + 16 * FOUND_PIXEL, mask, queue, place(PIXEL, count))
    lanes.pack(work, packet + 16 * FOUND_DEPTH, mask, queue, place(DEPTH, count))
    lanes.pack(work, packet + 16 * FOUND_CHAIN, mask, queue, place(CHAIN, count))
    return count + lanes.count(mask)
