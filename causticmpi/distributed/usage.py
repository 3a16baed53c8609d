"""What each rank uses of its machine: memory, and CPU seconds apart by what they went into."""

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from causticmpi.distributed.clock import Stopwatch
from causticmpi.render.rounds import Batches


@dataclass(frozen=True)
class Usage:
    """Of one rank. memory_mb: peak resident memory, where what ranks share is counted by each. CPU seconds:

    startup   interpreter, imports, MPI
    prepare   from there to the first round: kernels loaded or compiled, scene, preprocess
    rounds    all since: tracing, sums, waiting, reductions, and on rank 0 progressive pictures
    tracing   the part of `rounds` inside the kernels of the method
    """

    memory_mb: float
    startup: float
    prepare: float
    rounds: float
    tracing: float


def measure_usage(watch: Stopwatch, batches: Batches) -> Usage:
    """Of this rank until now."""
    now = time.process_time()
    began = now if batches.began is None else batches.began
    return Usage(peak_memory_mb(), watch.cpu_startup, began - watch.cpu_zero, now - began, batches.kernel_seconds)


def cpu_summary(ranks: Sequence[Usage]) -> dict[str, Any]:
    """Sums over ranks, and which share of the CPU time since the first round went into the kernels, by rank too."""
    sums = {name: sum(getattr(one, name) for one in ranks) for name in ("startup", "prepare", "rounds", "tracing")}
    shares = [round(one.tracing / one.rounds, 4) if one.rounds > 0 else None for one in ranks]
    share = sums["tracing"] / sums["rounds"] if sums["rounds"] > 0 else None
    return {**sums, "tracing_share": share, "tracing_share_per_rank": shares}


def peak_memory_mb() -> float:
    """Peak resident memory of this process [MB]; what ranks share is counted by each."""
    try:
        # Not ru_maxrss, which a process takes over from the one that started it, however large that was.
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
