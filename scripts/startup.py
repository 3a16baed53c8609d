#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Start-up: CPU seconds of runs that do next to nothing, medians of several with the least and the greatest.

    scripts/startup.py [--rounds 5] [--ranks 20] [--cold]

`render` makes a picture of 16 x 16 pixels, one sample each, from 64 forecast photons: importing, reading the scene,
loading the compiled kernels, building Embree's tree, and, beyond the first ray, writing the files and leaving. It is
therefore an upper bound of the CPU time before the first ray, preprocess excluded. --cold also renders once with an
empty cache, which compiles every kernel of the method.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAM = [sys.executable, "-m", "causticmpi"]
LITTLE = ["--spp", "1", "--force", "--set", "film.width=16", "--set", "film.height=16", "--set", "forecast.photons=64"]


def spent(command: list[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """CPU seconds of a command and of all that it started, and wall-clock seconds."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    result = subprocess.run(command, env=environment, cwd=REPOSITORY, capture_output=True, text=True)
    wall = time.perf_counter() - began
    if result.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{result.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def report(name: str, figures: list[tuple[float, float]]) -> None:
    """One line: medians, and the range of the CPU time."""
    cpu, wall = zip(*figures, strict=True)
    print(f"{name:44} CPU {statistics.median(cpu):6.2f} s ({min(cpu):.2f} - {max(cpu):.2f})", end="")
    print(f"   wall {statistics.median(wall):6.2f} s")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", default="configs/cornell.yaml")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--ranks", type=int, default=20)
    parser.add_argument("--cold", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        render = [*PROGRAM, "render", arguments.config, *LITTLE, "--out", f"{folder}/out"]
        commands = {
            "--help": [*PROGRAM, "--help"],
            "render, pt, warm": [*render, "--method", "pt"],
            "render, iws+cf, warm": render,
            f"render, iws+cf, warm, {arguments.ranks} ranks on {os.cpu_count()} cores": [
                *render, "-j", str(arguments.ranks)
            ],
        }  # fmt: skip
        for command in commands.values():
            spent(command)  # fills the cache
        figures: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        for _ in range(arguments.rounds):
            for name, command in commands.items():
                figures[name].append(spent(command))
        for name, found in figures.items():
            report(name, found)
        if arguments.cold:
            report("render, iws+cf, cold", [spent(render, {**os.environ, "CAUSTICMPI_CACHE": f"{folder}/cache"})])


if __name__ == "__main__":
    main()
