"""Rank 1 is stopped between its last batch and the end of the ring."""

import os
import signal

from causticmpi.distributed.world import open_world

with open_world() as world:
    world.watch(True)
    world.barrier()
    if world.rank == 1:
        os.kill(os.getpid(), signal.SIGSTOP)
    world.watch(False)
