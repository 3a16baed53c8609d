"""`-j RANKS`: the ranks that `render` and `compare` start on this machine."""

import sys
from collections.abc import Sequence


def run_in_ranks(ranks: int, argv: Sequence[str], go_on: str) -> int | None:
    """Start them and return the exit code of all; None for a process that is a rank itself.

    A code that no rank gives (a rank was killed) is told, with the way to `go_on`, and becomes 1. Raises InputError.
    """
    from causticmpi.distributed.launch import launch_ranks

    code = launch_ranks(ranks, argv)
    if code in (None, 0, 1, 2):
        return code
    why = "one of them was killed (out of memory? a batch system?)"
    print(f"causticmpi: the ranks ended with code {code}: {why}; {go_on}", file=sys.stderr)
    return 1
