"""How a run ends badly: one message, all ranks gone, code 2 for bad input and 1 for anything else."""

import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import NoReturn

from causticmpi.distributed.world import AgreedInputError, World
from causticmpi.errors import InputError, RunError

LAST_RESORT = 5.0
"""Seconds a silent failing rank waits to be ended by the one that prints."""


def end_all_ranks(world: World, error: BaseException) -> NoReturn:
    """Print rank, host and error once for all failing ranks, then the traceback; end every rank within seconds."""
    code = 2 if isinstance(error, InputError) else 1
    if not is_first_failure(world):
        time.sleep(LAST_RESORT)
        world.abort(code)
    host = world.hosts()[world.rank]
    kind = "bad input" if code == 2 else type(error).__name__
    message = f"causticmpi: rank {world.rank} of {world.size} on {host} failed: {kind}: {error}; ending all ranks\n"
    details = "" if code == 2 else "".join(traceback.format_exception(error))
    sys.stderr.write(message + details)
    sys.stderr.flush()
    time.sleep(0.1)  # the launcher passes stderr on; some drop what has not arrived when ranks are ended
    world.abort(code)


def is_first_failure(world: World) -> bool:
    """World's word on who prints; a rank whose MPI no longer works prints."""
    from causticmpi.distributed.mpi_world import MpiWorld

    try:
        return not isinstance(world, MpiWorld) or world.is_first_failure()
    except Exception:
        return True


def install_abort_hook(world: World) -> None:
    """From now on an uncaught exception, in any thread, ends all ranks. Does nothing in a world of one process."""
    if world.size == 1:
        return

    def thread_hook(args: threading.ExceptHookArgs) -> None:
        if args.exc_value is not None and not isinstance(args.exc_value, SystemExit):
            end_all_ranks(world, args.exc_value)

    sys.excepthook = lambda kind, error, at: end_all_ranks(world, error)
    threading.excepthook = thread_hook


def run_to_exit_code(world: World, body: Callable[[], int]) -> int:
    """Run `body` on every rank, close the world, return the exit code: 2 after bad input, 1 after a RunError, else what
    `body` returned.

    Bad input that all ranks know of (AgreedInputError), or that of a world of one process, is printed by the root. Bad
    input that one rank has not shared ends all ranks with its message. Other exceptions are for the abort hook.
    """
    try:
        code = body()
    except InputError as error:
        if world.size > 1 and not isinstance(error, AgreedInputError):
            end_all_ranks(world, error)
        if world.is_root:
            sys.stderr.write(f"causticmpi: {error}\n")
        code = 2
    except RunError as error:
        if world.is_root:
            sys.stderr.write(f"causticmpi: {error}\n")
        code = 1
    world.close()
    return code
