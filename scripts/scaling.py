#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""What more ranks bring: measured on this machine, and modelled for 20, 1,000 and 10,000 (docs/scaling.md).

scripts/scaling.py               some five minutes on two idle cores
scripts/scaling.py --no-runs     the constants of the model and the model alone
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from causticmpi.distributed.launch import launcher_command, launcher_environment
from causticmpi.render.precision import Precision

ROOT = Path(__file__).resolve().parent.parent
SLOTS, CHANNELS = 640 * 640, 21
BUDGET, PICTURES_EVERY, ROUND = 240.0, 10.0, 1.0
"""The paper's four minutes, a picture every ten seconds, rounds of a second."""
WORLDS = (
    # ranks, nodes, latency [s] and bandwidth [B/s] between nodes
    (2, 1, 0.0, math.inf),
    (20, 5, 20e-6, 1e9),
    (1000, 20, 2e-6, 1e10),
    (10000, 200, 2e-6, 1e10),
)


@dataclass
class Constants:
    """Seconds, on this machine. agree: a small collective of two ranks, asleep in between; reduce: the sums of a
    640 x 640 picture over two ranks as if on two nodes; merge: a round's sums to those before, by one core; add: a pass
    and its light paths to the sums; estimate: the error of a group of passes; write: EXR, PNG and report; prepare:
    photons, clusters, trees on rank 0; begin: virtual lights of a pass; pass_seconds: a whole pass on one core; start:
    interpreter to first line."""

    agree: float
    reduce: float
    merge: float
    add: float
    estimate: float
    write: float
    prepare: float
    begin: float
    pass_seconds: float
    start: float


def render(ranks: int, out: Path, *words: str) -> dict:
    """The report of a render with this many ranks (1: no MPI)."""
    start = launcher_command(ranks) if ranks > 1 else []
    command = [*start, sys.executable, "-m", "causticmpi", "render", str(ROOT / "configs" / "cornell.yaml")]
    subprocess.run(
        [*command, "--out", str(out), "--force", *words], env=launcher_environment(os.environ), cwd=ROOT, check=True,
        capture_output=True,
    )  # fmt: skip
    return json.loads((out / "report.json").read_text())


def efficiency(folder: Path, repeats: int) -> None:
    """One rank against two, in turn; wall clock needs two idle cores, CPU seconds do not."""
    rows: dict[int, list[tuple[float, float, float]]] = {1: [], 2: []}
    for _ in range(repeats):
        for ranks in rows:
            report = render(ranks, folder / "run", "--spp", "48", "--set=film.width=320", "--set=film.height=320")
            cpu, passes = report["cpu_seconds"], report["passes"]
            rows[ranks].append(
                (passes / report["seconds"]["tracing"], cpu["rounds"] / passes, cpu["tracing"] / cpu["rounds"])
            )
    medians = {
        ranks: [statistics.median(column) for column in zip(*found, strict=True)] for ranks, found in rows.items()
    }
    for ranks, (speed, cpu, share) in medians.items():
        spread = [round(row[0], 2) for row in rows[ranks]]
        print(
            f"{ranks} rank(s): {speed:.2f} passes/s of {spread}, {cpu:.4f} CPU s a pass, {100 * share:.1f} % in kernels"
        )
    speedup = medians[2][0] / medians[1][0]
    cost = medians[2][1] / medians[1][1]
    print(f"1 -> 2 ranks: {speedup:.2f} times the passes a second, {cost:.3f} times the CPU of a pass")


def crowded(folder: Path, seconds: int) -> None:
    """Twenty ranks, however few the cores."""
    report = render(20, folder / "crowd", "--time", f"{seconds}s")
    shares = report["cpu_seconds"]["tracing_share_per_rank"]
    print(
        f"20 ranks, {seconds} s: {100 * report['cpu_seconds']['tracing_share']:.1f} % of the CPU time of rounds in "
        f"kernels (rank 0, which writes: {100 * shares[0]:.1f} %, others from {100 * min(shares[1:]):.1f} %)"
    )


def measure_collectives() -> None:
    """As a rank: seconds of a small collective and of a reduction, by rank 0, as JSON."""
    from causticmpi.distributed.world import open_world

    with open_world() as world:
        small, large = [], []
        for _ in range(50):
            world.barrier()
            began = time.perf_counter()
            world.all_max(1)
            small.append(time.perf_counter() - began)
        sums = np.ones((SLOTS, CHANNELS))
        for _ in range(15):
            world.barrier()
            began = time.perf_counter()
            world.reduce_sum(sums)
            large.append(time.perf_counter() - began)
        if world.is_root:
            # The least: whatever else the machine does adds to it.
            print(json.dumps([statistics.median(small), min(large)]), flush=True)


def collectives(ranks: int) -> tuple[float, float]:
    command = [*launcher_command(ranks), sys.executable, __file__, "--collectives"]
    done = subprocess.run(
        command, env=launcher_environment(os.environ), cwd=ROOT, capture_output=True, text=True, check=True
    )
    agree, reduce = json.loads(done.stdout.splitlines()[-1])
    return agree, reduce


def measure(folder: Path) -> Constants:
    small = {ranks: collectives(ranks) for ranks in (2, 4, 20)}
    for ranks, (agree, reduce) in small.items():
        print(
            f"{ranks:3} ranks: a small collective {1e3 * agree:.2f} ms; if each were a node, a reduction of 69 MB "
            f"{1e3 * reduce:.0f} ms"
        )
    reports = [render(1, folder / "one", "--spp", "6") for _ in range(3)]
    low = {name: min(r["seconds"][name] for r in reports) for name in reports[0]["seconds"]}
    passes = reports[0]["passes"]
    per_pass = min(r["cpu_seconds"]["tracing"] for r in reports) / passes
    merge, add, error = film_seconds()
    return Constants(
        agree=small[2][0], reduce=small[2][1], merge=merge, add=add, estimate=error,
        write=low["write"], begin=begin_seconds(), start=low["startup"],
        prepare=low["photons"] + low["clustering"] + low["trees"], pass_seconds=per_pass,
    )  # fmt: skip


def film_seconds() -> tuple[float, float, float]:
    """CPU seconds of merging and forgetting a round, of adding a pass with light paths, of an error estimate."""
    from causticmpi.render.film import Film

    film, pending, groups = Film(SLOTS, 2.0**-36, light=True), Film(SLOTS, 2.0**-36, light=True), Precision(640)
    one = np.random.default_rng(1).random((SLOTS, 6)).astype(np.float32)
    found: list[list[float]] = [[], [], []]

    def timed(kind: int, work: Callable[..., object], *arguments: object) -> None:
        began = time.process_time()
        work(*arguments)
        found[kind].append(time.process_time() - began)

    def add(eye: np.ndarray, light: np.ndarray) -> None:
        pending.add_pass(eye)
        pending.add_light(light)

    def merge() -> None:
        film.merge(pending)
        pending.clear()

    for passes in range(1, 8):
        timed(1, add, one.copy(), one[:, :3].copy())
        timed(0, merge)
        timed(2, groups.take, film.sums, 3 * passes, 1.0)
    merged, added, estimated = (statistics.median(seconds[2:]) for seconds in found)
    return merged, added, estimated


def begin_seconds() -> float:
    """CPU seconds of the virtual lights of a pass."""
    from causticmpi.config.load import load_config
    from causticmpi.distributed.prepare import share_maps, share_scene
    from causticmpi.distributed.world import SerialWorld
    from causticmpi.preprocess.forecast import no_forecast
    from causticmpi.render.methods import make_method
    from causticmpi.scene.load import load_scene
    from causticmpi.scene.tracing import camera_array

    config = load_config(str(ROOT / "configs" / "cornell.yaml"), ["--method=iws"])
    scene = share_scene(SerialWorld(), load_scene(ROOT / "scenes" / "cornell.yaml"))
    camera = camera_array(scene.data.camera, 64, 64)
    method = make_method(config, scene.traced, camera, share_maps(SerialWorld(), no_forecast()), scene.extent)
    method.begin_pass(0)
    began = time.process_time()
    for index in range(200):
        method.begin_pass(index)
    return (time.process_time() - began) / 200


def losses(c: Constants, ranks: int, nodes: int, latency: float, bandwidth: float) -> dict[str, float]:
    """Shares of all ranks' time in BUDGET that are not tracing, by cause; see docs/scaling.md for each term.

    latency [s], bandwidth [B/s]: of the network between two nodes.
    """
    hops = math.ceil(math.log2(nodes))
    pictures = BUDGET / PICTURES_EVERY
    passes = max(1.0, ranks * ROUND / c.pass_seconds)
    precision = Precision(640)
    groups = sum(precision.due(int(number * passes)) for number in range(1, int(BUDGET / ROUND) + 1))
    shares = 8 * (1 + math.log(min(passes, 8 * ranks))) + max(0.0, passes / ranks - 8) if ranks > 1 else passes
    volume = SLOTS * CHANNELS * 8
    reduction = c.reduce + hops * latency + 2 * volume / bandwidth if nodes > 1 else 0.0
    return {
        "start-up": c.start / BUDGET,
        "preprocess on rank 0": (c.prepare + hops * (latency + 2e7 / bandwidth)) / BUDGET,
        "adding passes to sums": c.add / (c.add + c.pass_seconds),
        "merging rounds": c.merge / min(4, ranks / nodes) / ROUND,
        "agreeing on rounds": 3 * (c.agree + hops * latency) / ROUND if ranks > 1 else 0.0,
        "waiting at a round's end": c.pass_seconds / (16 * ranks) / ROUND + 0.01 if ranks > 1 else 0.0,
        "virtual lights traced again": max(0.0, shares - passes / ranks) * c.begin / ROUND if ranks > 1 else 0.0,
        "the round that is dropped": ROUND / 2 / BUDGET,
        "reductions between nodes": (pictures + groups) * reduction / BUDGET,
        "error estimated by rank 0": groups * c.estimate / BUDGET,
        "pictures written by rank 0": pictures * c.write / BUDGET if ranks > 1 else 0.0,
    }


def show_model(c: Constants) -> None:
    print(json.dumps({name: float(f"{value:.3g}") for name, value in asdict(c).items()}))
    columns = {world[0]: losses(c, *world) for world in WORLDS}
    print(f"{'share of the time lost to':30}" + "".join(f"{ranks:>10}" for ranks in columns))
    for cause in columns[2]:
        print(f"{cause:30}" + "".join(f"{100 * column[cause]:9.2f}%" for column in columns.values()))
    print(f"{'efficiency':30}" + "".join(f"{100 * (1 - sum(column.values())):9.1f}%" for column in columns.values()))
    print(f"{'limited by':30}" + "  ".join(max(column, key=column.__getitem__) for column in columns.values()))


def main() -> None:
    if sys.argv[1:] == ["--collectives"]:
        return measure_collectives()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no-runs", action="store_true", help="constants and model only")
    parser.add_argument("--only-runs", action="store_true", help="neither constants nor model")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--crowd-seconds", type=int, default=120)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        if not arguments.no_runs:
            efficiency(Path(name), arguments.repeats)
            if arguments.crowd_seconds:
                crowded(Path(name), arguments.crowd_seconds)
        if not arguments.only_runs:
            show_model(measure(Path(name)))


if __name__ == "__main__":
    main()
