"""Runs that end badly. Arguments: what happens, and on which rank (-1: on all)."""

import atexit
import os
import signal
import sys
import time

from reporting import say, say_shared_files

from causticmpi.distributed.failure import install_abort_hook, run_to_exit_code
from causticmpi.distributed.world import World, open_world
from causticmpi.errors import InputError


def happen(world: World, what: str) -> None:
    if what == "raise-late":  # the highest rank first
        time.sleep(0.15 * (world.size - 1 - world.rank))
    if what.startswith("raise"):
        raise ValueError("boom in the sampler")
    if what == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "input":
        raise InputError("scene.yaml:3: found no camera")


def body(world: World, what: str, rank: int) -> int:
    chosen = rank in (-1, world.rank)
    if what == "agree":
        world.agree(InputError("scene.yaml:3: found no camera") if chosen else None)
    elif what == "leader":
        world.first_on_node(lambda: happen(world, "raise"))
    elif what == "leader-input":
        world.first_on_node(lambda: happen(world, "input"))
    elif chosen:
        happen(world, what)
    world.barrier()
    say("reached the end")
    time.sleep(1)
    return 0


def main() -> int:
    what, rank = sys.argv[1], int(sys.argv[2])
    world = open_world()
    install_abort_hook(world)
    atexit.register(say, "cleared up")
    say_shared_files()
    world.barrier()
    time.sleep(0.2)  # what was printed arrives before ranks are ended
    return run_to_exit_code(world, lambda: body(world, what, rank))


if __name__ == "__main__":
    raise SystemExit(main())
