"""`causticmpi compare`: from the command line to the ranks."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from causticmpi.cli.ranks import run_in_ranks


def compare(arguments: argparse.Namespace, argv: Sequence[str]) -> int:
    """Start the ranks if asked to, else be one of them. Returns the exit code; raises InputError."""
    code = run_in_ranks(arguments.ranks, argv, "the same command goes on where it was")
    if code is not None:
        return code
    from causticmpi.compare.run import compare as run_comparison
    from causticmpi.distributed.failure import install_abort_hook, run_to_exit_code
    from causticmpi.distributed.world import open_world

    world = open_world()
    install_abort_hook(world)
    return run_to_exit_code(
        world,
        lambda: run_comparison(
            world,
            arguments.config,
            arguments.settings,
            arguments.out,
            ("causticmpi", *argv),
            references_only=arguments.references,
            more=[Path(directory) for directory in arguments.show],
            scene=arguments.scene,
        ),
    )
