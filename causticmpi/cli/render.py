"""`causticmpi render`: from the command line to the ranks."""

import argparse
import sys
from collections.abc import Sequence

from causticmpi.config.load import load_config, scene_path


def overrides(arguments: argparse.Namespace) -> list[str]:
    """The options of the command line as config overrides, in the form `load_config` takes."""
    named = ("method", "time", "spp", "until", "seed", "out")
    given = [f"--{name}={getattr(arguments, name)}" for name in named if getattr(arguments, name, None) is not None]
    return [*arguments.settings, *given]


def render(arguments: argparse.Namespace, argv: Sequence[str]) -> int:
    """Start the ranks if asked to, else be one of them. Returns the exit code; raises InputError."""
    from causticmpi.distributed.launch import launch_ranks

    if arguments.ranks != 1:
        code = launch_ranks(arguments.ranks, argv)
        if code is not None:
            return told_exit_code(code)
    from causticmpi.distributed.begin import Request
    from causticmpi.distributed.failure import install_abort_hook, run_to_exit_code
    from causticmpi.distributed.job import render as render_job
    from causticmpi.distributed.world import open_world

    def read_request() -> Request:
        config = load_config(arguments.config, overrides(arguments))
        scene_file = scene_path(arguments.config, config)
        return Request(config, scene_file, arguments.force, ("causticmpi", *argv), arguments.resume)

    world = open_world()
    install_abort_hook(world)
    return run_to_exit_code(world, lambda: render_job(world, read_request))


def told_exit_code(code: int) -> int:
    """The launcher's exit code as ours; one that no rank gives (a rank was killed) is told and becomes 1."""
    if code in (0, 1, 2):
        return code
    print(
        f"causticmpi: the ranks ended with code {code}: one of them was killed (out of memory? a batch system?); go on "
        "from the last checkpoint by the same command with --resume",
        file=sys.stderr,
    )
    return 1
