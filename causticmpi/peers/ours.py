"""Our own methods under the same clock: `python -m causticmpi.peers.ours CONFIG METHOD OUT --seconds 5,15,60`.

The program's own driver renders, on one rank. The clock counts everything from the shared scene on, photons, clustering
and trees of the forecast too; reading the scene, Embree's tree and the loading of kernels lie before it, as for others.
"""

import contextlib
import signal
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from causticmpi import __version__
from causticmpi.config.load import scene_path
from causticmpi.config.records import Budget, Output
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.job import Request, render_one
from causticmpi.distributed.prepare import needs_forecast
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.warmup import warm_up
from causticmpi.distributed.world import SerialWorld
from causticmpi.peers.recording import Recording, Task, load, read_task
from causticmpi.render.film import resolve

PATIENCE = 1000.0
"""Wall-clock time of a run over its CPU time, at most: other work may hold the machine."""


class CpuClock(Stopwatch):
    """CPU seconds of this process since it was made, the stage `load` left out."""

    def __init__(self) -> None:
        super().__init__(from_now=True)
        self._loading = 0.0

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """As the stopwatch's; CPU time of loading is kept apart."""
        began = time.process_time()
        with super().stage(name):
            yield
        if name == "load":
            self._loading += time.process_time() - began

    def cpu_seconds(self) -> float:
        """CPU seconds counted so far."""
        return time.process_time() - self.cpu_zero - self._loading


class BudgetSnapshots(Snapshots):
    """Takes a picture at each CPU-time budget, and stops the run by a signal after the last."""

    def __init__(self, recording: Recording, clock: CpuClock, shape: tuple[int, int]) -> None:
        super().__init__()
        self._recording, self._clock, self._shape = recording, clock, shape
        self._now = self._step = 0.0

    def due(self, passes: int) -> bool:
        """Asked after every round."""
        now = self._clock.cpu_seconds()
        self._step, self._now = now - self._now, now
        return self._recording.due(now, self._step)

    def take(self, sums: np.ndarray, passes: int, seconds: float) -> None:
        """Keep the picture of these sums."""
        diffusive, caustic, _ = resolve(sums, passes)
        self._recording.take((diffusive + caustic).reshape(*self._shape, 3), self._now, self._step, passes)
        if self._recording.done:
            signal.raise_signal(signal.SIGTERM)


def render(task: Task) -> tuple[Recording, dict[str, Any]]:
    """One run of the program without a time limit that matters, stopped after the last budget."""
    config, scene = load(task.config)
    recording = Recording(task.seconds)
    with tempfile.TemporaryDirectory() as folder:
        config = msgspec.structs.replace(
            config,
            method=task.method,
            seed=task.seed,
            budget=Budget(time=PATIENCE * task.seconds[-1]),
            output=Output(directory=folder, interval=1e9),
        )
        warm_up(config, True, needs_forecast(config, scene))
        request = Request(config, scene_path(task.config, config), True, ("causticmpi", *task.arguments()))
        before, clock = time.process_time(), CpuClock()
        with StopFlag() as flag:
            snapshots = BudgetSnapshots(recording, clock, (config.film.height, config.film.width))
            render_one(SerialWorld(), lambda: request, clock, flag, snapshots)
    if not recording.done:
        raise SystemExit(f"{task.out}: the run ended before its last budget; is the machine overloaded?")
    return recording, {"renderer": f"causticmpi {__version__}", "note": "", "uncounted_cpu_seconds": before}


if __name__ == "__main__":
    own_task = read_task()
    made, told = render(own_task)
    made.write(own_task, told)
