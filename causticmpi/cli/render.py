"""`causticmpi render`: from the command line to the ranks."""

import argparse
from collections.abc import Sequence

from causticmpi.cli.ranks import run_in_ranks
from causticmpi.config.load import load_config, scene_path


def overrides(arguments: argparse.Namespace) -> list[str]:
    """The options of the command line as config overrides, in the form `load_config` takes."""
    named = ("method", "time", "spp", "until", "seed", "out")
    given = [f"--{name}={getattr(arguments, name)}" for name in named if getattr(arguments, name, None) is not None]
    return [*arguments.settings, *given]


def render(arguments: argparse.Namespace, argv: Sequence[str]) -> int:
    """Start the ranks if asked to, else be one of them. Returns the exit code; raises InputError."""
    go_on = "go on from the last checkpoint by the same command with --resume"
    code = run_in_ranks(arguments.ranks, argv, go_on)
    if code is not None:
        return code
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
