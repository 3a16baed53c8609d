"""Large arrays on every rank, held once per node.

Rank 0's arrays are laid out in one block of memory that the ranks of a node share (an MPI shared-memory window). Node
leaders pass the block on as raw bytes, in chunks: nothing large is pickled, and no count comes near 2^31, where
broadcasts of some libraries fail.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from mpi4py import MPI

from causticmpi.distributed.mpi_world import MpiWorld, wait, wait_bulk
from causticmpi.distributed.world import Arrays, read_only
from causticmpi.errors import InputError

ALIGNMENT = 64
PADDING = 64
"""Bytes after each array: Embree reads a few bytes past the end of its vertex buffers."""

CHUNK_BYTES = 1 << 26


@dataclass(frozen=True)
class Layout:
    """Where each array lies in the block: name -> (dtype, shape, offset in bytes); `size` in bytes."""

    entries: dict[str, tuple[np.dtype, tuple[int, ...], int]]
    size: int


def lay_out(arrays: Mapping[str, np.ndarray]) -> Layout:
    """Offsets are multiples of ALIGNMENT, PADDING bytes follow each array. Raises TypeError for Python objects."""
    entries, end = {}, 0
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise TypeError(f"share: array {name!r} holds Python objects, need numbers")
        entries[name] = (array.dtype, array.shape, end)
        end += -(-(array.nbytes + PADDING) // ALIGNMENT) * ALIGNMENT
    return Layout(entries, end)


class SharedBlock:
    """`size` writable bytes (`bytes`, uint8, 64-byte aligned, zero at first) in memory shared by a node's ranks.

    Making and freeing one is collective on the node. What a rank writes is seen by the others after `publish`.
    """

    def __init__(self, world: MpiWorld, size: int) -> None:
        self._node = world.node
        wait(self._node.Ibarrier())  # the calls below wait spinning
        room = size + ALIGNMENT if world.is_node_leader else 0
        self._window = MPI.Win.Allocate_shared(room, 1, MPI.INFO_NULL, self._node)
        self._window.Lock_all()
        whole = np.frombuffer(cast(memoryview, self._window.Shared_query(0)[0]), dtype=np.uint8)
        skip = np.array([-whole.ctypes.data % ALIGNMENT], dtype=np.int64)
        wait(self._node.Ibcast(skip, 0))  # the leader's count holds for all: mappings differ by whole pages
        self._skip = int(skip[0])
        self.bytes = whole[self._skip : self._skip + size]
        # No MPI promises zeros. Each rank writes its part: pages come into being near the ranks, or fail now.
        rank, ranks = self._node.rank, self._node.size
        self.bytes[size * rank // ranks : size * (rank + 1) // ranks] = 0
        self.publish()

    def sync(self) -> None:
        """What this rank wrote before, others see after a meeting and a `sync` of theirs."""
        self._window.Sync()

    def publish(self) -> None:
        """Collective on the node. What was written before is visible to all after."""
        self.sync()
        wait(self._node.Ibarrier())
        self.sync()

    def fetch_and_add(self, offset: int, value: int) -> int:
        """Add to the 64-bit integer at byte `offset`, in one step for all ranks; returns what it was before."""
        return self._exchange(offset, value, MPI.SUM)

    def store(self, offset: int, value: int) -> None:
        """Replace the 64-bit integer at byte `offset`, in one step for all ranks."""
        self._exchange(offset, value, MPI.REPLACE)

    def _exchange(self, offset: int, value: int, operation: MPI.Op) -> int:
        operand, before = np.array([value], dtype=np.int64), np.empty(1, dtype=np.int64)
        self._window.Fetch_and_op(operand, before, 0, self._skip + offset, operation)
        self._window.Flush(0)
        return int(before[0])

    def free(self) -> None:
        """Collective on the node; the memory is gone afterwards."""
        self.bytes = np.empty(0, dtype=np.uint8)
        wait(self._node.Ibarrier())
        self._window.Unlock_all()
        self._window.Free()


class SharedArrays(Arrays):
    """Read-only arrays by name, views of one SharedBlock. They must not be used after `free` or the world's end."""

    def __init__(self, block: SharedBlock, layout: Layout) -> None:
        super().__init__()
        self.block: SharedBlock | None = block
        for name, (dtype, shape, offset) in layout.entries.items():
            self[name] = read_only(np.ndarray(shape, dtype, buffer=block.bytes.data, offset=offset))

    def free(self) -> None:
        """Collective. Give the memory back before the world closes; harmless when repeated."""
        self.clear()
        if self.block is not None:
            self.block.free()
            self.block = None


def share(world: MpiWorld, arrays: Arrays | None, chunk_bytes: int = CHUNK_BYTES) -> SharedArrays:
    """Collective. Rank 0's `arrays` on every rank: same names, dtypes and shapes, read-only, C order, once per node.

    arrays : needed on rank 0, ignored elsewhere. chunk_bytes : 1 … 2^30, the most that one message carries.
    Raises InputError on all ranks if some node's shared memory is too small; ValueError, TypeError for wrong arguments.
    """
    if not 1 <= chunk_bytes <= 1 << 30:
        raise ValueError(f"share: found chunk_bytes={chunk_bytes}, need 1 … 2^30")
    if world.is_root and arrays is None:
        raise ValueError("share: rank 0 has to give the arrays")
    layout: Layout = world.broadcast(lay_out(arrays) if world.is_root and arrays is not None else None)
    world.agree(shortage(layout.size, world.hosts()[world.rank], "the scene needs") if world.is_node_leader else None)
    block = SharedBlock(world, layout.size)
    if world.is_root and arrays is not None:
        for name, (dtype, shape, offset) in layout.entries.items():
            np.ndarray(shape, dtype, buffer=block.bytes.data, offset=offset)[...] = arrays[name]
    if world.is_node_leader and world.node_count > 1:
        wait(world.leaders.Ibarrier())
        for start in range(0, layout.size, chunk_bytes):
            wait_bulk(world.leaders.Ibcast(block.bytes[start : start + chunk_bytes], 0))
    block.publish()
    return SharedArrays(block, layout)


def shortage(size: int, host: str, who: str, directory: str = "/dev/shm") -> InputError | None:
    """The error to report if `size` bytes do not fit into shared memory: writing there would be a crash (SIGBUS).

    who: such as "the scene needs".
    """
    try:
        status = os.statvfs(directory)
    except OSError:
        return None  # this system keeps shared memory elsewhere
    free = status.f_bavail * status.f_frsize
    if size < free:
        return None
    return InputError(
        f"{host}: {who} {size / 1e6:.0f} MB of shared memory, {directory} has {free / 1e6:.0f} MB free: "
        "enlarge it (docker run --shm-size, mount -o remount,size=), remove left-overs there, or take a smaller scene "
        "or picture"
    )
