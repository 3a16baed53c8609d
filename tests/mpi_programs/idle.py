"""Prints the CPU seconds that each rank spends waiting in a barrier and in a broadcast for a sleeping rank 0."""

import sys
import time

import numpy as np
from reporting import say

from causticmpi.distributed.world import open_world


def main() -> None:
    seconds = float(sys.argv[1])
    with open_world() as world:
        for wait in (world.barrier, lambda: world.broadcast(1), lambda: world.reduce_sum(np.ones(10))):
            world.barrier()
            start, wall = time.process_time(), time.monotonic()
            if world.is_root:
                time.sleep(seconds)
            wait()
            world.barrier()
            assert time.monotonic() - wall > 0.5 * seconds, "nobody waited"  # a busy machine starts some late
            spent = world.gather(time.process_time() - start)
            if spent is not None:
                say("cpu", *spent)


if __name__ == "__main__":
    main()
