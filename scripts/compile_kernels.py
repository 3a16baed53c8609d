#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Compile the kernels of every method in two processes; nothing to do where that was done before.

For tests and benchmarks: else each of their processes compiles for itself what it comes to first.
"""

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from causticmpi.config.records import Forecast, RenderConfig
from causticmpi.distributed.warmup import compiled_so_far, warm_up_parts

PROCESSES = 2
KINDS = "iws+cf mixture", "iws+cf two", "iws+pm mixture", "iws mixture", "pt mixture", "pt-brute mixture"
"""Methods and samplings, what takes longest first."""


def parts_of(kind: str) -> list[Callable[[], None]]:
    method, sampling = kind.split()
    config = RenderConfig(scene="", method=method, forecast=Forecast(sampling=sampling))
    return warm_up_parts(config, forecasting=method == "iws+cf")


def compiled_by(part: Callable[[], None]) -> int:
    """How many kernels a part had to compile."""
    before = compiled_so_far()
    part()
    return compiled_so_far() - before


if __name__ == "__main__":
    with ProcessPoolExecutor(PROCESSES, get_context("spawn")) as pool:
        made = sum(pool.map(compiled_by, [part for kind in KINDS for part in parts_of(kind)]))
    print(f"kernels: {made} compiled anew" if made else "kernels: known", file=sys.stderr)
