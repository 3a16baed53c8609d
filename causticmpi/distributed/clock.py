"""Wall clock of a run: the budget counts from the start of the launcher, compilation left out, stages apart."""

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

LAUNCHERS = ("mpiexec", "mpirun", "hydra", "prterun", "orterun", "orted", "prted", "srun")
"""How the names of the processes between the user's shell and a rank begin."""


def _process(pid: int | str) -> tuple[str, int, float]:
    """Name, parent and start [s since the machine's] of a process. Raises OSError, ValueError, IndexError."""
    head, _, tail = Path(f"/proc/{pid}/stat").read_text().rpartition(")")
    fields = tail.split()
    return head.partition("(")[2], int(fields[1]), int(fields[19]) / os.sysconf("SC_CLK_TCK")


def seconds_since_start() -> float:
    """Age of this process, or of the launcher above it on this machine: all of that is what the user waits for.

    Only an unbroken chain of launchers counts: a script started by mpirun may render one picture after the other.
    """
    try:
        _, parent, started = _process("self")
        with contextlib.suppress(OSError, ValueError, IndexError):  # a parent that may not be looked at
            while parent > 1:
                name, parent, earlier = _process(parent)
                if not name.startswith(LAUNCHERS):
                    break
                started = min(started, earlier)
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - started)
    except (OSError, AttributeError, ValueError, IndexError):
        return time.process_time()  # not Linux: what the processor knows


class Stopwatch:
    """Elapsed seconds and seconds by stage. from_now: count from here, not from the start of the program.

    cpu_zero: CPU seconds of this process when the watch was made; cpu_startup: those of them that belong to the run.
    """

    def __init__(self, from_now: bool = False) -> None:
        age = 0.0 if from_now else seconds_since_start()
        self._zero = time.monotonic() - age
        self.cpu_zero = time.process_time()
        self.cpu_startup = 0.0 if from_now else self.cpu_zero
        self.compiling = 0.0
        self.before = 0.0
        self.stages: dict[str, float] = {} if from_now else {"startup": age}

    def elapsed(self) -> float:
        """Seconds of the run so far, those of earlier starts included and compilation left out."""
        return self.before + time.monotonic() - self._zero - self.compiling

    def go_on_from(self, elapsed: float, stages: Mapping[str, float]) -> None:
        """Count what earlier starts of this run took."""
        self.before = elapsed
        for name, seconds in stages.items():
            self.add(name, seconds)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the block under `name`."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - began)

    def add(self, name: str, seconds: float) -> None:
        """Count seconds under `name`."""
        self.stages[name] = self.stages.get(name, 0.0) + seconds
