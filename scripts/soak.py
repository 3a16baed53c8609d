#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""A long run at many ranks: does memory grow, and is the reduced picture the sum of what the ranks hold?

    scripts/soak.py 60min --ranks 20          (-h for all options)

Samples the resident memory of every rank. Each keeps, besides, the sums of what it traced itself: at every reduction
rank 0 adds these up, in rank order, and compares them bit for bit. Prints one line a minute and the verdict; exit code
1 if the memory that any rank holds (the least of each minute's samples) moved by more than 2 % after the first tenth of
the time (at least a minute), or if any sum differed.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from causticmpi.config.units import parse_time
from causticmpi.distributed.launch import launcher_command, launcher_environment

ALLOWED = 0.02
COMPARED = "CAUSTICMPI_SOAK_COMPARED"
"""Names the file that rank 0 appends a line to for every reduction: numbers that differ, numbers compared."""


def check_reductions() -> None:
    """Every rank keeps the sums of what it traced itself, too, and at every reduction rank 0 adds them up."""
    from causticmpi.distributed import run
    from causticmpi.distributed.films import Films
    from causticmpi.distributed.world import World
    from causticmpi.render.film import Film

    class CheckedFilms(Films):
        def __init__(self, world: World, slots: int, quantum: float, light: bool, halves: bool = False) -> None:
            super().__init__(world, slots, quantum, light, halves)
            self.world = world
            self.own, self.own_round = Film(slots, quantum, light), Film(slots, quantum, light)
            add_pass, add_light = self.pending.add_pass, self.pending.add_light

            def add_pass_twice(film: np.ndarray, rows: slice | None = None) -> None:
                self.own_round.add_pass(film.copy(), rows)
                add_pass(film, rows)

            def add_light_twice(film: np.ndarray) -> None:
                self.own_round.add_light(film.copy())
                add_light(film)

            self.pending.add_pass, self.pending.add_light = add_pass_twice, add_light_twice  # type: ignore[method-assign]

        def merge(self, passes: int, second: bool) -> None:
            self.own.merge(self.own_round)
            self.own_round.clear()
            super().merge(passes, second)

        def total(self) -> np.ndarray | None:
            total, parts = super().total(), self.world.gather(self.own.sums)
            if total is not None and parts is not None:
                again = np.zeros_like(total)
                for part in parts:
                    again += part
                with open(os.environ[COMPARED], "a") as file:
                    file.write(f"{np.count_nonzero(again != total)} {total.size}\n")
            return total

    run.Films = CheckedFilms  # type: ignore[misc]


def resident_mb(launcher: int) -> dict[int, float]:
    """Resident memory [MB] of every rank below the launcher, by process."""
    parents, memory, ranks = {}, {}, set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            pid = int(folder.name)
            status = dict(
                line.split(":\t", 1) for line in (folder / "status").read_text().splitlines() if ":\t" in line
            )
            parents[pid] = int(status["PPid"])
            memory[pid] = int(status["VmRSS"].split()[0]) / 1024
            if (folder / "cmdline").read_bytes().split(b"\0")[0].endswith(b"python"):
                ranks.add(pid)
        except (OSError, KeyError, ValueError):
            continue  # gone, or a thread of the kernel

    def below(pid: int) -> bool:
        return pid == launcher or (pid in parents and below(parents[pid]))

    return {pid: memory[pid] for pid in ranks if below(pid)}


Samples = list[tuple[float, dict[int, float]]]
"""(seconds, MB by process)."""


def watch(launcher: "subprocess.Popen[bytes]", seconds: float, ranks: int, samples: Samples) -> None:
    """Append a sample every five seconds until the run ends, or the planned seconds are over."""
    began, told = time.monotonic(), 0.0
    while launcher.poll() is None:
        time.sleep(5)
        now, memory = time.monotonic() - began, resident_mb(launcher.pid)
        if len(memory) == ranks and now < seconds:
            samples.append((now, memory))
            if now - told > 60:
                told = now
                print(
                    f"{now:7.0f} s  {sum(memory.values()):8.1f} MB in all, largest {max(memory.values()):.1f} MB",
                    flush=True,
                )


def by_minute(samples: Samples) -> np.ndarray:
    """The least of each rank's samples in each minute [MB], (minutes, ranks): what it holds on to. The rest comes and
    goes, with pictures, checkpoints and this script's own gathering of all films on rank 0."""
    minutes: dict[int, list[list[float]]] = {}
    for seconds, memory in samples:
        minutes.setdefault(int(seconds // 60), []).append([memory[pid] for pid in sorted(memory)])
    return np.array([np.min(found, axis=0) for found in minutes.values()])


def verdict(samples: Samples, seconds: float, compared: Path) -> bool:
    settled = [(t, m) for t, m in samples if t > max(60.0, 0.1 * seconds)]
    held = by_minute(settled)
    if len(held) < 2:
        print("too short: memory is looked at after the first minute, minute by minute")
        return False
    moved, together = held / held[0] - 1, held.sum(axis=1)
    slope = np.polyfit(np.arange(len(held)) / 60, together, 1)[0] / together[0]
    print(f"memory that ranks hold (least of each minute's samples), {len(settled)} samples in {len(held)} minutes:\n"
          f"  each moved by {100 * moved.min():+.2f} to {100 * moved.max():+.2f} %, all together by "
          f"{100 * (together.min() / together[0] - 1):+.2f} to {100 * (together.max() / together[0] - 1):+.2f} %, "
          f"trend {100 * slope:+.2f} % an hour")  # fmt: skip
    peak = max(max(memory[pid] / least - 1 for pid, least in zip(sorted(memory), held[0], strict=True))
               for _, memory in settled)  # fmt: skip
    print(f"highest single sample of a rank, buffers that come and go included: {100 * peak:+.2f} %")
    lines = [tuple(map(int, line.split())) for line in compared.read_text().splitlines()]
    differing, numbers = (sum(column) for column in zip(*lines, strict=True))
    print(f"sums, {len(lines)} reductions: {differing} of {numbers} numbers differ from the sum in rank order")
    return np.abs(moved).max() <= ALLOWED and differing == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("duration", help="such as 60min")
    parser.add_argument("--ranks", type=int, default=20)
    parser.add_argument("--config", default="configs/cornell.yaml")
    parser.add_argument("--size", type=int, default=96, help="width and height of the film [pixels]")
    arguments = parser.parse_args()
    seconds = parse_time(arguments.duration)
    samples: Samples = []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    with tempfile.TemporaryDirectory() as folder:
        compared = Path(folder) / "compared"
        size = [f"--set=film.{side}={arguments.size}" for side in ("width", "height")]
        words = ["render", arguments.config, *size, "--time", arguments.duration, "--out", f"{folder}/out"]
        rank = [sys.executable, __file__, "--rank", *words, "--set=output.checkpoint=20"]
        env = launcher_environment(os.environ) | {COMPARED: str(compared)}
        launcher = subprocess.Popen([*launcher_command(arguments.ranks), *rank], env=env, stderr=subprocess.DEVNULL)
        try:
            watch(launcher, seconds, arguments.ranks, samples)
        except KeyboardInterrupt:
            print("interrupted: judged by what there is")
        finally:
            launcher.terminate()
            launcher.wait()
        good = verdict(samples, seconds, compared)
    print("flat and without drift" if good else "NOT flat, or drifting")
    return 0 if good else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["--rank"]:
        from causticmpi.cli.main import main as program

        del sys.argv[1]
        check_reductions()
        raise SystemExit(program())
    raise SystemExit(main())
