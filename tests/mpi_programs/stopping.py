"""Works in batches until a signal has reached any rank, then all stop together. Prints "started", "stopped SIGNAL"."""

import time

from reporting import say

from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.world import open_world


def main() -> None:
    with open_world() as world, StopFlag() as flag:
        end = time.monotonic() + 15
        say("started", world.rank)
        while not (number := world.all_max(flag.raised)) and time.monotonic() < end:
            time.sleep(0.05)
        say("stopped", number)


if __name__ == "__main__":
    main()
