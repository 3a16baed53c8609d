"""Prints rank, size, thread settings and arguments; exits with the code given as the last argument."""

import os
import sys

from reporting import say

from causticmpi.distributed.world import open_world


def main() -> int:
    with open_world() as world:
        say("rank", world.rank, "of", world.size, os.environ["NUMBA_NUM_THREADS"], *sys.argv[1:])
    return int(sys.argv[-1])


if __name__ == "__main__":
    raise SystemExit(main())
