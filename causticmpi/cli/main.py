"""`causticmpi VERB …`: reads the command line, nothing more; heavy modules are imported by the verb that needs them."""

import argparse
import os
import sys
from collections.abc import Sequence

from causticmpi import __version__
from causticmpi.errors import InputError, RunError

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # one rank is one thread


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        raise InputError(f"{self.prog}: {message}; see {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """The command line of all verbs."""
    parser = _Parser(
        prog="causticmpi",
        description="Unbiased caustics, rendered in batch on many cores: IWS + Caustic Forecasting and its rivals.",
        epilog="Start it plainly, with -j 2, or under mpirun -n 20. Exit codes: 0 done, 2 bad input, 1 anything else.",
    )
    parser.add_argument("--version", action="version", version=f"causticmpi {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    render = verbs.add_parser("render", help="render a picture within a time or sample budget")
    _common(render)
    render.add_argument("--method", metavar="M", help="pt, pt-brute, iws, iws+cf or iws+pm (biased)")
    budget = render.add_mutually_exclusive_group()
    budget.add_argument("--time", metavar="T", help="wall-clock budget, such as 30s, 4min or 1h")
    budget.add_argument("--spp", metavar="N", help="samples per pixel")
    render.add_argument("--until", metavar="E", help="stop before that at this estimated relMSE, such as 1%%")
    render.add_argument("--out", metavar="DIR", help="output directory")
    render.add_argument("--seed", metavar="N", help="seed of all random numbers")
    render.add_argument("-j", dest="ranks", metavar="RANKS", type=int, default=1, help="start this many ranks here")
    held = render.add_mutually_exclusive_group()
    held.add_argument("--resume", action="store_true", help="go on with the run that DIR holds, or extend it")
    held.add_argument("--force", action="store_true", help="replace the run that DIR holds")
    check = verbs.add_parser("check", help="validate config and scene, estimate memory and time")
    _common(check)
    compare = verbs.add_parser("compare", help="equal-time runs of several methods: tables, charts, one HTML report")
    _common(compare)
    compare.add_argument("--out", metavar="DIR", help="output directory")
    compare.add_argument("-j", dest="ranks", metavar="RANKS", type=int, default=1, help="start this many ranks here")
    compare.add_argument("--scene", metavar="N", type=int, help="the runs of the Nth scene alone, and no report")
    compare.add_argument("--references", action="store_true", help="make the references that are missing, nothing else")
    compare.add_argument(
        "--show", metavar="DIR", action="append", default=[], help="put the PNGs of this directory into the report"
    )
    inspect = verbs.add_parser("inspect", help="virtual lights, caustic points and clusters as pictures and numbers")
    _common(inspect)
    inspect.add_argument("--out", metavar="DIR", help="directory of the pictures (default: inspect in the output's)")
    merge = verbs.add_parser("merge", help="put runs of one config with different seeds together into one picture")
    merge.add_argument("runs", metavar="DIR", nargs="+", help="directories of finished or stopped runs, two or more")
    merge.add_argument("-o", "--out", metavar="DIR", required=True, help="output directory")
    merge.add_argument("--force", action="store_true", help="replace the run that the output directory holds")
    bench = verbs.add_parser("bench", help="this machine: raw Embree rate beside each kernel's rate, on one core")
    bench.add_argument(
        "configs", metavar="CONFIG", nargs="*", default=[f"configs/{name}.yaml" for name in BENCH_SCENES]
    )
    bench.add_argument("--out", metavar="DIR", help="also write bench.json and bench.md there")
    return parser


BENCH_SCENES = ("cornell", "ring", "pool")


def _common(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("config", metavar="CONFIG", help="config file (YAML)")
    verb.add_argument(
        "--set", dest="settings", metavar="KEY.SUB=VALUE", action="append", default=[], help="override a config value"
    )


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
        arguments = build_parser().parse_args(argv)
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
    from causticmpi.distributed.environment import launcher_rank

    if launcher_rank() == 0:
        print(f"causticmpi: {error}", file=sys.stderr, flush=True)
    return 2
