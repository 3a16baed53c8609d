"""Rank 0 comes to the end of the program some seconds after the others; nobody closes the world. Argument: seconds."""

import sys
import time

from reporting import say

from causticmpi.distributed.world import open_world


def main() -> None:
    world = open_world()
    if world.is_root:
        time.sleep(float(sys.argv[1]))
    say("leaving", world.rank)


if __name__ == "__main__":
    main()
