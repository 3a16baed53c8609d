#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Compile the kernels of every method in two processes; nothing to do where that was done before.

For tests and benchmarks: else each of their processes compiles for itself what it comes to first.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from causticmpi.config.records import Forecast, RenderConfig
from causticmpi.distributed.warmup import PARTS, compiled_so_far, warm_up_parts

PROCESSES = 2
KINDS = "iws+cf mixture", "iws+cf two", "iws+pm mixture", "iws mixture", "pt mixture", "pt-brute mixture"
"""Methods and samplings, what takes longest first."""


def compile_part(kind: str, part: int) -> int:
    """How many kernels of this part of a kind had to be compiled."""
    method, sampling = kind.split()
    config = RenderConfig(scene="", method=method, forecast=Forecast(sampling=sampling))
    before = compiled_so_far()
    warm_up_parts(config, forecasting=method == "iws+cf")[part]()
    return compiled_so_far() - before


if __name__ == "__main__":
    with ProcessPoolExecutor(PROCESSES, get_context("spawn")) as pool:
        tasks = [pool.submit(compile_part, kind, part) for kind in KINDS for part in range(PARTS)]
        made = sum(task.result() for task in tasks)
    print(f"kernels: {made} compiled anew" if made else "kernels: known", file=sys.stderr)
