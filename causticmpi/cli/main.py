"""`causticmpi VERB …`: reads the command line, nothing more; heavy modules are imported by the verb that needs them."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from causticmpi import __version__
from causticmpi.config.command_line import Parser, count, one_line
from causticmpi.distributed.environment import launcher_rank
from causticmpi.errors import InputError, RunError

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # one rank is one thread


def build_parser() -> argparse.ArgumentParser:
    """The command line of all verbs."""
    parser = Parser(
        prog="causticmpi",
        description="Unbiased caustics, rendered in batch on many cores: IWS + Caustic Forecasting and its rivals.",
        epilog="Start it plainly, with -j 2, or under mpirun -n 20. Exit codes: 0 done, 2 bad input, 1 anything else.",
    )
    parser.add_argument("--version", action="version", version=f"causticmpi {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB")
    render = _verb(verbs, "render", "render a picture within a time or sample budget")
    _input(render)
    _picture(render)
    _ranks(render)
    held = render.add_mutually_exclusive_group()
    held.add_argument(
        "--resume",
        action="store_true",
        help="go on with the run that DIR holds, if any, or extend it",
    )
    held.add_argument("--force", action="store_true", help="replace the run that DIR holds")
    check = _verb(verbs, "check", "validate config and scene, estimate memory and time of a render")
    _input(check)
    _picture(check)
    _ranks(check, "the ranks that the render will have on this machine (default: 1)")
    compare = _verb(verbs, "compare", "equal-time runs of several methods: tables, charts, one HTML report")
    _input(compare, "configs/compare/smoke.yaml")
    _output(compare, "output directory (default: the config's)")
    _ranks(compare)
    compare.add_argument("--scene", metavar="N", type=count, help="the runs of the Nth scene alone, and no report")
    compare.add_argument("--references", action="store_true", help="make the references that are missing, nothing else")
    compare.add_argument(
        "--show", metavar="DIR", action="append", default=[], help="put the PNGs of this directory into the report"
    )
    inspect = _verb(verbs, "inspect", "virtual lights, caustic points and clusters as pictures and numbers")
    _input(inspect)
    _output(inspect, "directory of the pictures (default: inspect in the config's)")
    merge = _verb(verbs, "merge", "put runs of one config with different seeds together into one picture")
    merge.add_argument("runs", metavar="RUN", nargs="+", help="directories of finished or stopped runs, two or more")
    _output(merge, "output directory", required=True)
    merge.add_argument("--force", action="store_true", help="replace the run that the output directory holds")
    bench = _verb(verbs, "bench", "this machine: raw Embree rate beside each kernel's rate, on one core")
    bench.add_argument(
        "configs", metavar="CONFIG", nargs="*", default=BENCH_CONFIGS, help=f"default: {' '.join(BENCH_CONFIGS)}"
    )
    _output(bench, "also write bench.json and bench.md there")
    return parser


ALONE = ("check", "inspect", "merge", "bench")
"""Verbs that one process does: under mpirun the others have nothing to do."""
BENCH_CONFIGS = [f"configs/{name}.yaml" for name in ("cornell", "ring", "pool")]


def _verb(verbs: Any, name: str, purpose: str) -> argparse.ArgumentParser:
    verb: argparse.ArgumentParser = verbs.add_parser(name, help=purpose, description=purpose)
    return verb


def _input(verb: argparse.ArgumentParser, example: str = "configs/cornell.yaml") -> None:
    verb.add_argument("config", metavar="CONFIG", help=f"config file (YAML), such as {example}")
    verb.add_argument(
        "--set", dest="settings", metavar="KEY.SUB=VALUE", action="append", default=[], help="override a config value"
    )


def _picture(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--method", metavar="M", help="pt, pt-brute, iws, iws+cf or iws+pm (biased)")
    budget = verb.add_mutually_exclusive_group()
    budget.add_argument("--time", metavar="T", help="wall-clock budget, such as 30s, 4min or 1h")
    budget.add_argument("--spp", metavar="N", help="samples per pixel")
    verb.add_argument("--until", metavar="E", help="stop before that at this estimated relMSE, such as 1%%")
    _output(verb, "output directory (default: the config's)")
    verb.add_argument("--seed", metavar="N", help="seed of all random numbers")


def _output(verb: argparse.ArgumentParser, purpose: str, required: bool = False) -> None:
    verb.add_argument("-o", "--out", metavar="DIR", required=required, help=purpose)


def _ranks(verb: argparse.ArgumentParser, purpose: str = "start this many ranks here") -> None:
    verb.add_argument("-j", dest="ranks", metavar="RANKS", type=count, default=1, help=purpose)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code. Without `argv` it is all that the process does: a rank ends in here."""
    if argv is not None:
        return _run(list(argv))
    from causticmpi.distributed.leaving import leave

    code = _run(sys.argv[1:])
    leave(code)
    return code


def _run(argv: list[str]) -> int:
    try:
        parser = build_parser()
        arguments = parser.parse_args(argv)
        if arguments.verb is None:
            parser.error("found no VERB; allowed: render, check, compare, inspect, merge, bench")
        if arguments.verb in ALONE and launcher_rank() > 0:
            return 0
        if arguments.verb == "check":
            from causticmpi.cli.check import check

            return check(arguments)
        if arguments.verb == "compare":
            from causticmpi.cli.compare import compare

            return compare(arguments, argv)
        if arguments.verb == "inspect":
            from causticmpi.cli.inspect import inspect

            return inspect(arguments)
        if arguments.verb == "merge":
            from causticmpi.distributed.merge import merge

            return merge(arguments.runs, arguments.out, arguments.force, ("causticmpi", *argv))
        if arguments.verb == "bench":
            from causticmpi.bench.run import bench

            return bench(arguments.configs, arguments.out)
        from causticmpi.cli.render import render

        return render(arguments, argv)
    except InputError as error:
        return report_input_error(error)
    except RunError as error:
        print(f"causticmpi: {error}", file=sys.stderr, flush=True)
        return 1


def report_input_error(error: InputError) -> int:
    """Print bad input once, even where a launcher started many of us; code 2."""
    if launcher_rank() == 0:
        print(one_line(error, "causticmpi"), file=sys.stderr, flush=True)
    return 2
