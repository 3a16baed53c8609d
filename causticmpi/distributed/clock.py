"""Wall clock of a run: the budget counts from the start of the process, compilation left out, stages apart."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path


def seconds_since_process_start() -> float:
    """Age of this process: interpreter start and imports are part of what the user waits for."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - started)
    except (OSError, AttributeError, ValueError, IndexError):
        return time.process_time()  # not Linux: what the processor knows


class Stopwatch:
    """Elapsed seconds and seconds by stage."""

    def __init__(self) -> None:
        self._zero = time.monotonic() - seconds_since_process_start()
        self.compiling = 0.0
        self.stages: dict[str, float] = {}

    def elapsed(self) -> float:
        """Seconds of the run so far, compilation left out."""
        return time.monotonic() - self._zero - self.compiling

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
