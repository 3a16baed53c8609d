"""Where paths are kept: queues of vertices that wait, and the 16 lanes that are worked on.

Paths go on in waves, those of path tracing as told here, particles much alike (`particle_waves`). A vertex that a ray
has found waits in one of two queues, of specular and of other surfaces, so that the 16 lanes of a packet do the same
work and hold hardly a dead path. A queue is a run of blocks; a block holds the rows below of 16 vertices. A stage
copies a block to the front of `work`, which is `embree.ray_buffer`, and works on it in loops over the lanes that the
compiler turns into vector instructions: no branches, no calls, and nothing read but `work` at offsets known when
compiling.

Vertices of one pixel keep their order in every queue whoever else is there, and Embree's answer to a ray does not
depend on the other lanes (tests/test_embree.py): so a pixel's sums are the same bits in any picture.
"""

import numpy as np

from causticmpi.kernels.embree import LANES, PRIM, RAY16, TFAR, ray_buffer
from causticmpi.kernels.jit import inline

GROUP = 256
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
    SURFACE,
    MATERIAL,
    LIGHT,
    THROUGHPUT,
    DENSITY,
    KEY,
    PIXEL,
    DEPTH,
    CHAIN,
    CAUSTIC,
    _VERTEX_END,
) = (_FIRST + LANES * row for row in (0, 3, 6, 7, 8, 12, 13, 14, 17, 18, 20, 21, 22, 23, 24))
"""Rows of a vertex, as word offsets of the block in `work`.

ORIGIN, DIRECTION, DISTANCE: the ray that found it and how far away; PRIMITIVE, MATERIAL, LIGHT int32 and SURFACE: rows
of the scene; THROUGHPUT to the pixel; DENSITY [1/sr] of the sample that found it, of use if CHAIN = 0; KEY uint64: its
random numbers; PIXEL int32: row of `pixels`; DEPTH, CHAIN int32: non-specular vertices before it, specular ones since;
CAUSTIC int32: 1 if the path belongs to L_c."""
BLOCK_WORDS = _VERTEX_END - _FIRST

(
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
    CORNER,
    EDGE1,
    EDGE2,
    LIGHT_NORMAL,
    LIGHT_REACH,
    LIGHT_PDF,
    LIGHT_RADIANCE,
    TO_LIGHT,
    CONTRIBUTION,
    IOR,
    IS_MIRROR,
    KIND,
    ETA2,
    _SCRATCH_END,
) = (
    _VERTEX_END + LANES * row
    for row in (0, 3, 6, 7, 10, 11, 12, 15, 16, 17, 18, 19, 20, 21, 24, 27, 30, 33, 34, 35, 38, 41, 44, 45, 46, 47, 48)
)
"""Rows of what a stage finds out about its lanes."""
FOUND, REACH = 12, 13
"""Words of a traced packet that replace Embree's normal (see `path_stages.look_up`)."""
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
    return lanes_and_packets(FIRST_SPLIT), np.zeros((2, 2, MOST_WAITING // LANES * BLOCK_WORDS), np.float32)


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
def load_block(work, queue, block):
    """Copy a block of a queue to the lanes."""
    source = queue[block * BLOCK_WORDS : (block + 1) * BLOCK_WORDS]
    for i in range(BLOCK_WORDS):
        work[ORIGIN + i] = source[i]


@inline
def push(scene, work, queue, position, packet, lane, throughput, density, key, pixel, depth, chain, caustic):
    """Let the vertex that lane `lane` of the packet at word `packet` has hit wait as number `position` of the queue."""
    b = (position >> 4) * BLOCK_WORDS + (position & 15) - ORIGIN
    words = queue.view(np.int32)
    primitive = work.view(np.int32)[packet + 16 * PRIM + lane]
    for c in range(3):
        queue[b + ORIGIN + 16 * c] = work[packet + 16 * c + lane]
        queue[b + DIRECTION + 16 * c] = work[packet + 16 * (4 + c) + lane]
        queue[b + THROUGHPUT + 16 * c] = throughput[c]
        queue[b + SURFACE + 16 * c] = scene.surface[primitive, c]
    queue[b + DISTANCE] = work[packet + 16 * TFAR + lane]
    queue[b + SURFACE + 48] = work[packet + 16 * REACH + lane]
    words[b + PRIMITIVE] = primitive
    words[b + MATERIAL] = scene.material[primitive]
    words[b + LIGHT] = scene.light[primitive]
    queue[b + DENSITY] = density
    low = (position >> 4) * (BLOCK_WORDS // 2) + (position & 15) + (KEY - ORIGIN) // 2
    queue.view(np.uint64)[low] = key
    words[b + PIXEL] = pixel
    words[b + DEPTH] = depth
    words[b + CHAIN] = chain
    words[b + CAUSTIC] = caustic
