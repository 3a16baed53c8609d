#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi,test && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Runs with faults injected, and what they cost: a table in Markdown.

    scripts/faults.py [--repetitions 20] [--only kill,stop] [--out faults.md]

Each repetition renders a small picture on two ranks with a checkpoint every INTERVAL seconds, injects the fault at a
random moment (seeded), looks at what is left, goes on with --resume and compares all layers with those of a run that
was never disturbed. "lost" is the time from the state in the newest checkpoint to the fault.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import OpenEXR

ROOT = Path(__file__).resolve().parents[1]
TROUBLED = ROOT / "tests" / "mpi_programs" / "troubled_render.py"
RANKS = 2
INTERVAL = 10.0
"""Seconds between checkpoints."""
PATIENCE = 20.0
"""Seconds a rank may be silent in these runs."""
LATEST = 25.0
"""Seconds of tracing within which the fault comes."""
SLOW = 900
"""Seconds after which a repetition counts as hung."""
RENDER = (
    "render", str(ROOT / "configs" / "cornell.yaml"), "--set", "film.width=64", "--set", "film.height=48",
    "--set", "forecast.photons=2000", "--set", "forecast.clusters=32", "--set", f"output.checkpoint={INTERVAL:g}",
    "--set", "output.interval=3",
)  # fmt: skip


@dataclass
class Tally:
    """What all repetitions of a fault gave."""

    repetitions: int = 0
    pictures_lost: int = 0
    unequal: int = 0
    lost: list[float] = field(default_factory=list)
    codes: set[int] = field(default_factory=set)
    lines: dict[str, None] = field(default_factory=dict)
    hung: int = 0
    tracebacks: int = 0


class Run:
    """One start of the program under mpirun."""

    def __init__(self, out: Path, log: Path, *more: str, program: tuple[str, ...] = ("-m", "causticmpi")) -> None:
        self.out, self.log = out, log
        mpirun = Path(sys.executable).parent / "mpirun"
        command = [str(mpirun), "-n", str(RANKS), sys.executable, *program, *RENDER, "--out", str(out), *more]
        env = os.environ | {"PYTHONPATH": str(ROOT), "CAUSTICMPI_PATIENCE": str(PATIENCE), "NUMBA_NUM_THREADS": "1"}
        with log.open("w") as file:
            self.process = subprocess.Popen(
                command, env=env, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
            )

    def wait_for(self, what: Callable[[], bool]) -> bool:
        """Wait until something is true; False if the run ended before."""
        end = time.monotonic() + SLOW
        while not what():
            if self.process.poll() is not None or time.monotonic() > end:
                return False
            time.sleep(0.01)
        return True

    def lasts_until(self, moment: float) -> bool:
        """Wait for a moment; False if the run ended before."""
        return self.wait_for(lambda: time.time() > moment)

    def tracing(self) -> bool:
        return "causticmpi: tracing" in self.log.read_text()

    def ranks(self) -> list[int]:
        """Process ids of the ranks, in no order."""
        parents = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                except (OSError, ValueError, IndexError):
                    continue
        proxies = [pid for pid, parent in parents.items() if parent == self.process.pid]
        return [pid for pid, parent in parents.items() if parent in proxies]

    def end(self) -> int | None:
        """Exit code; None, and everything of it ended, if it hangs."""
        try:
            return self.process.wait(SLOW)
        except subprocess.TimeoutExpired:
            for pid in (*self.ranks(), self.process.pid):
                os.kill(pid, signal.SIGKILL)
            return None


def layers(out: Path) -> dict[str, bytes] | None:
    """All channels of the picture, None if it cannot be read."""
    try:
        with OpenEXR.File(str(out / "image.exr"), separate_channels=True) as file:
            return {name: channel.pixels.tobytes() for name, channel in file.channels().items()}
    except Exception:
        return None


def age_of_state(run: Run, began: float) -> float:
    """Seconds from the state in the newest checkpoint, or from the start of tracing, until now."""
    newest = [began]
    for name in ("checkpoint", "checkpoint.previous"):
        try:
            newest.append((run.out / name).stat().st_mtime)
        except OSError:
            continue
    return time.time() - max(newest)


def to_a_rank(number: int) -> Callable[[Run, random.Random], None]:
    def fault(run: Run, chance: random.Random) -> None:
        os.kill(chance.choice(sorted(run.ranks())), number)

    return fault


def to_the_launcher(number: int) -> Callable[[Run, random.Random], None]:
    return lambda run, chance: run.process.send_signal(number)


def pause(run: Run, chance: random.Random) -> None:
    """A rank stops for less than the patience."""
    rank = chance.choice(sorted(run.ranks()))
    os.kill(rank, signal.SIGSTOP)
    time.sleep(PATIENCE / 2)
    os.kill(rank, signal.SIGCONT)


def kill_all(run: Run, chance: random.Random) -> None:
    """As when the machine goes: launcher and ranks at once."""
    for pid in (run.process.pid, *run.ranks()):
        os.kill(pid, signal.SIGKILL)


def remove_directory(run: Run, chance: random.Random) -> None:
    shutil.rmtree(run.out)


def fill_disk(run: Run, chance: random.Random) -> None:
    """Full for three seconds, then free again."""
    filler = run.out.parent / "filler"
    fill(filler)
    time.sleep(3)
    filler.unlink()


def fill_disk_for_good(run: Run, chance: random.Random) -> None:
    fill(run.out.parent / "filler")


def fill(filler: Path) -> None:
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass


def nothing(run: Run, chance: random.Random) -> None: ...


@dataclass(frozen=True)
class Fault:
    """How a fault is made; goes_on: the run is to end by itself with code 0. disk: on a small disk of its own."""

    inject: Callable[[Run, random.Random], None]
    goes_on: bool = False
    disk: bool = False
    program: tuple[str, ...] = ("-m", "causticmpi")
    many: bool = False


FAULTS = {
    "kill: SIGKILL to a rank": Fault(to_a_rank(signal.SIGKILL), many=True),
    "stop: SIGSTOP to a rank, for ever": Fault(to_a_rank(signal.SIGSTOP), many=True),
    f"pause: SIGSTOP to a rank, SIGCONT after {PATIENCE / 2:g} s": Fault(pause, goes_on=True),
    "machine: SIGKILL to launcher and ranks": Fault(kill_all),
    "term: SIGTERM to mpirun": Fault(to_the_launcher(signal.SIGTERM)),
    "int: SIGINT to mpirun": Fault(to_the_launcher(signal.SIGINT)),
    "usr1: SIGUSR1 to mpirun": Fault(to_the_launcher(signal.SIGUSR1)),
    "one: SIGUSR1 to one rank": Fault(to_a_rank(signal.SIGUSR1)),
    "full: disk full for 3 s": Fault(fill_disk, goes_on=True, disk=True),
    "filled: disk full until the end": Fault(fill_disk_for_good, disk=True),
    "removed: output directory removed": Fault(remove_directory, goes_on=True),
    "rename: every rename takes 1.5 s": Fault(
        nothing, goes_on=True, program=(str(TROUBLED), "slow-rename", "0", "/nowhere")
    ),
    "clock: wall clock jumps by +-1 h": Fault(
        nothing, goes_on=True, program=(str(TROUBLED), "clock-steps", "-1", "/nowhere")
    ),
}


def repetition(
    fault: Fault, spp: str, wanted: dict[str, bytes], folder: Path, chance: random.Random, to: Tally
) -> None:
    """Run, disturb, look, go on, compare."""
    out = folder / "out"
    while True:
        run = Run(out, folder / "first.log", "--spp", spp, "--force", program=fault.program)
        if not run.wait_for(run.tracing):
            sys.exit(f"the run did not begin: {run.log.read_text()}")
        began = time.time()
        if run.lasts_until(began + chance.uniform(0, LATEST)):
            break
        run.end()  # over before the fault: once more
    to.repetitions += 1
    pictured = (out / "report.json").exists()
    if not fault.goes_on:
        to.lost.append(age_of_state(run, began))
    fault.inject(run, chance)
    code = run.end()
    to.hung += code is None
    to.codes.add(-1 if code is None else code)
    told = run.log.read_text()
    (folder / "filler").unlink(missing_ok=True)
    if fault.goes_on:
        to.unequal += code != 0 or layers(out) != wanted
    else:
        to.pictures_lost += pictured and layers(out) is None
        told += resume(out, folder / "second.log", spp)
        to.unequal += layers(out) != wanted or (out / "unfinished").exists()
    to.tracebacks += "Traceback" in told
    for line in told.splitlines():
        if any(word in line for word in ("warning", " rank ", "could not", "stopped by", "going on from")):
            to.lines[line.replace(str(out), "DIR")] = None


def on_a_disk(fault: Fault, spp: str, wanted: dict[str, bytes], base: Path, chance: random.Random, to: Tally) -> None:
    """One repetition, in a directory or on a small disk of its own."""
    folder = Path(tempfile.mkdtemp(dir=base))
    if fault.disk and not small_disk(folder):
        return
    try:
        repetition(fault, spp, wanted, folder, chance, to)
    finally:
        if fault.disk:
            subprocess.run(["umount", str(folder)], check=True)


def resume(out: Path, log: Path, spp: str) -> str:
    """One command goes on."""
    run = Run(out, log, "--spp", spp, "--resume")
    run.end()
    return log.read_text()


def small_disk(folder: Path) -> bool:
    """Mount a disk of 1.5 MB; False where that is not allowed."""
    return subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1536k", "tmpfs", str(folder)]).returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=20, help="of kill and stop; of the others a quarter")
    parser.add_argument("--only", help="names, separated by commas")
    parser.add_argument("--spp", default="600", help="passes; of a run that outlasts the latest fault")
    parser.add_argument("--parallel", type=int, default=1, help="repetitions at the same time")
    parser.add_argument("--out", type=Path, help="also write the table there")
    arguments = parser.parse_args()
    only = arguments.only.split(",") if arguments.only else None
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        base = Path(name)
        spp = arguments.spp
        Run(base / "warm", base / "log", "--spp", "2").end()
        Run(base / "wanted", base / "log", "--spp", spp).end()
        wanted = layers(base / "wanted")
        if wanted is None:
            sys.exit((base / "log").read_text())
        rows = [
            "| fault | repetitions | pictures lost | bits unequal in the end | s of work lost at most | exit codes "
            "| hung | tracebacks |",
            "|---|---|---|---|---|---|---|---|",
        ]
        lines = []
        for title, fault in FAULTS.items():
            if only and title.partition(":")[0] not in only:
                continue
            tally = Tally()
            count = arguments.repetitions if fault.many else -(-arguments.repetitions // 4)
            with ThreadPoolExecutor(arguments.parallel) as pool:
                chances = [random.Random(f"{title} {number}") for number in range(count)]
                list(pool.map(lambda chance: on_a_disk(fault, spp, wanted, base, chance, tally), chances))  # noqa: B023
            lost = f"{max(tally.lost):.1f}" if tally.lost else "0"
            codes = ", ".join(map(str, sorted(tally.codes)))
            rows.append(
                f"| {title} | {tally.repetitions} | {tally.pictures_lost} | {tally.unequal} | {lost} | {codes} "
                f"| {tally.hung} | {tally.tracebacks} |"
            )
            print(rows[-1], flush=True)
            lines += [f"\n{title}:\n", *(f"    {line}" for line in list(tally.lines)[:6])]
        head = f"{RANKS} ranks, {spp} passes of 64 x 48, checkpoint every {INTERVAL:g} s, patience {PATIENCE:g} s\n"
        text = "\n".join([head, *rows, *lines]) + "\n"
        print(text)
        if arguments.out:
            arguments.out.write_text(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
