#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Compile the kernels of every method, half of them in each of two processes; nothing to do where that was done before.

For tests and benchmarks: else each of their processes compiles for itself what it comes to first.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from causticmpi.config.records import Forecast, RenderConfig
from causticmpi.distributed.warmup import warm_up

HALVES = ["iws+cf mixture"], ["iws+cf two", "iws+pm mixture", "iws mixture", "pt mixture", "pt-brute mixture"]
"""Methods and samplings; either takes a process a minute or two."""


def compile_all(kinds: list[str]) -> bool:
    """Whether any kernel of these kinds had to be compiled."""
    made = False
    for kind in kinds:
        method, sampling = kind.split()
        config = RenderConfig(scene="", method=method, forecast=Forecast(sampling=sampling))
        made |= warm_up(config, root=True, forecasting=method == "iws+cf")
    return made


if __name__ == "__main__":
    with ProcessPoolExecutor(len(HALVES), get_context("spawn")) as pool:
        made = any(list(pool.map(compile_all, HALVES)))
    print("kernels: compiled anew" if made else "kernels: known", file=sys.stderr)
