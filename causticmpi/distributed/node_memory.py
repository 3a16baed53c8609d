"""Arrays that the ranks of a node write together, and their sums over nodes.

What ranks of a node add up in one place need not be reduced among them: only the leaders of nodes reduce, over the
network. Where shared memory is too small every rank holds arrays of its own, and all ranks reduce.
"""

import sys

import numpy as np

from causticmpi.distributed.mpi_world import MpiWorld, sum_over
from causticmpi.distributed.shared_arrays import Layout, SharedBlock, lay_out, shortage
from causticmpi.distributed.world import Common, Shapes


class NodeMemory(Common):
    """Of the ranks of one node; the contract is Common's."""

    def __init__(self, world: MpiWorld, block: SharedBlock, layout: Layout) -> None:
        self.rank, self.size = world.node_rank, world.node_size
        self._world, self._block = world, block
        self.arrays = {
            name: np.ndarray(shape, dtype, buffer=block.bytes.data, offset=offset)
            for name, (dtype, shape, offset) in layout.entries.items()
        }

    def sync(self) -> None:
        self._block.sync()

    def total(self, name: str) -> np.ndarray | None:
        if self._world.node_count == 1:
            return self.arrays[name] if self._world.is_root else None
        return sum_over(self._world.leaders, self.arrays[name]) if self._world.is_node_leader else None

    def free(self) -> None:
        self.arrays.clear()
        self._block.free()


class RankMemory(Common):
    """Of one rank alone, in a world of several."""

    def __init__(self, world: MpiWorld, shapes: Shapes) -> None:
        super().__init__(shapes)
        self._world = world

    def total(self, name: str) -> np.ndarray | None:
        return self._world.reduce_sum(self.arrays[name])


def hold_in_common(world: MpiWorld, shapes: Shapes) -> Common:
    """Collective. Arrays of zeros of these shapes, held once per node where its shared memory allows."""
    layout = lay_out({name: np.broadcast_to(np.zeros((), kind), shape) for name, (kind, shape) in shapes.items()})
    short = None
    if world.is_node_leader:  # scene and maps need some, too
        short = shortage(2 * layout.size, world.hosts()[world.rank], "sums of passes and others beside them need")
    if world.all_max(int(short is not None)):
        told = world.gather(short)
        if told is not None:
            first = next(error for error in told if error is not None)
            print(
                f"causticmpi: warning: {first}; until then each rank has sums of its own", file=sys.stderr, flush=True
            )
        return RankMemory(world, shapes)
    return NodeMemory(world, SharedBlock(world, layout.size), layout)
