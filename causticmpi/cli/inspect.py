"""`causticmpi inspect`: from the command line to the findings."""

import argparse
from pathlib import Path

from causticmpi.config.load import load_config, scene_path
from causticmpi.output.directory import check_directory


def inspect(arguments: argparse.Namespace) -> int:
    """Find, draw, tell. Returns the exit code; raises InputError before anything is written."""
    from causticmpi.inspect.run import inspect as run_inspection

    config = load_config(arguments.config, arguments.settings)
    directory = Path(arguments.out if arguments.out is not None else Path(config.output.directory) / "inspect")
    check_directory(directory, force=True)
    return run_inspection(config, scene_path(arguments.config, config), directory)
