"""A render from config to picture: rank 0 coordinates, every rank traces, the reducer merges sums."""

import math
import os
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed import leaving
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import (
    Forecasting,
    PreparedScene,
    needs_forecast,
    prepare_forecast,
    share_scene,
)
from causticmpi.distributed.result import Merged, Result
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.usage import measure_usage
from causticmpi.distributed.warmup import warm_up
from causticmpi.distributed.world import World
from causticmpi.errors import InputError
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.pixels import pixel_order
from causticmpi.output.directory import Claim, check_directory, claim_directory
from causticmpi.output.progress import Progress
from causticmpi.output.report import provenance
from causticmpi.render.features import first_hits
from causticmpi.render.film import Film, quantum_for
from causticmpi.render.methods import make_method
from causticmpi.render.rounds import Batches, divide, equal_round
from causticmpi.scene.content import with_camera
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

DROPPED = 128
"""A rank's word on a round: the number of the signal it got (0: none), plus this if its share is unfinished.

The largest counts for all. A signal that a late rank's DROPPED hides does no harm: the time is over then.
"""
ROUND_SECONDS = 1.0
"""Aim of a round, times the ranks that share a core: what a round costs besides tracing is CPU time of each rank. At
most 1/30 of a time budget is lost with the round that is dropped."""
WRITE_SHARE = 0.05
"""Progressive pictures may cost this share of the time."""
FIRST_WRITE, FIRST_WRITE_PER_PIXEL = 0.3, 1e-6
"""Seconds reserved for writing as long as no picture has been written: libraries to load, and a slow machine."""


@dataclass(frozen=True)
class Request:
    """What rank 0 read from the command line. directory: where the pictures go; command: for the provenance."""

    config: RenderConfig
    scene_file: Path
    force: bool
    command: tuple[str, ...]


def render(world: World, read_request: Callable[[], Request]) -> int:
    """Collective. Render what rank 0's `read_request` asks for; returns the exit code.

    Raises AgreedInputError on all ranks for bad input, before anything is written.
    """
    with StopFlag() as flag:
        render_one(world, read_request, Stopwatch(), flag)
    return 0


def render_one(
    world: World,
    read_request: Callable[[], Request],
    watch: Stopwatch,
    flag: StopFlag,
    snapshots: Snapshots | None = None,
) -> int:
    """Collective. One of several renders in these processes; the world keeps none of its memory.

    The budget counts from the zero of `watch`. snapshots: keeps pictures of the growing run (see there). Returns the
    signal that stopped the run, 0 for none. Raises as `render` does.
    """
    request, scene_data = _read_input(world, read_request, watch)
    config = request.config
    _warm_up(world, config, scene_data, watch)
    with watch.stage("load"):
        scene = share_scene(world, scene_data, config.watertight)
    run = _Run(world, request, scene, _claim(world, request), watch, flag, snapshots)
    if not run.asked_to_stop():
        run.forecast()
        run.trace()
    run.finish()
    scene.embree.close()
    world.release()
    return run.stopped_by


def _read_input(
    world: World, read_request: Callable[[], Request], watch: Stopwatch
) -> tuple[Request, SceneData | None]:
    """Rank 0 reads everything that can be wrong before a rank does any work; all ranks learn of the verdict."""
    error: InputError | None = None
    request = scene = None
    if world.is_root:
        try:
            with watch.stage("load"):
                request = read_request()
                scene = load_scene(request.scene_file)
                if request.config.camera is not None:
                    scene = with_camera(scene, request.config.camera)
            check_directory(request.config.output.directory, force=request.force)
        except InputError as found:
            error = found
    world.agree(error)
    return world.broadcast(request), scene


def _claim(world: World, request: Request) -> Claim | None:
    """Rank 0 takes the directory, once nothing of the input is left that could be wrong."""
    error: InputError | None = None
    claim = None
    if world.is_root:
        try:
            claim = claim_directory(request.config.output.directory, force=request.force)
        except InputError as found:
            error = found
    world.agree(error)
    return claim


def _warm_up(world: World, config: RenderConfig, scene: SceneData | None, watch: Stopwatch) -> None:
    """Compile once per node. Compiling lies outside the budget and is reported, loading compiled code lies within."""
    began = time.perf_counter()
    forecasting = world.broadcast(scene is not None and needs_forecast(config, scene))
    compiled = world.first_on_node(lambda: warm_up(config, world.is_root, forecasting))
    spent = time.perf_counter() - began
    watch.add("warmup", spent)
    if world.all_max(int(compiled)):
        watch.compiling += spent


class _Run:
    """The state of one render on one rank."""

    def __init__(
        self,
        world: World,
        request: Request,
        scene: PreparedScene,
        claim: Claim | None,
        watch: Stopwatch,
        flag: StopFlag,
        snapshots: Snapshots | None,
    ) -> None:
        config = request.config
        self.snapshots = snapshots
        self.world, self.config, self.scene, self.watch, self.flag = world, config, scene, watch, flag
        window = config.film.crop or (0, 0, config.film.width, config.film.height)
        slots = (window[2] - window[0]) * (window[3] - window[1])
        self.camera = camera_array(scene.data.camera, config.film.width, config.film.height)
        self.pixels = pixel_order(window, config.film.width)
        quantum = quantum_for(scene.brightest)
        self.film, self.pending = Film(slots, quantum), Film(slots, quantum)
        self.limit = float(config.budget.time) if config.budget.time is not None else None
        self.rounds = 0
        self.stopped_by = 0
        self.last_write = 0.0
        self.write_cost = 0.0
        self.reserve = FIRST_WRITE + FIRST_WRITE_PER_PIXEL * slots + leaving.expected_seconds(world.node_size)
        if claim is not None:
            facts = {
                "hosts": world.hosts(),
                "mpi": world.library,
                "nodes": world.node_count,
                "embree": scene.embree.version,
                "embree_bytes_per_rank": scene.embree.bytes,
                "ray_packet_width": 16 if scene.embree.native16 else 8,
            }
            source = provenance(shlex.join(request.command), facts, scene.data.content_hash)
            self.progress = Progress(self.limit, config.budget.spp)
            self.result = Result(config, claim, source, self._first_hits())

    def _first_hits(self) -> np.ndarray:
        features = np.zeros((self.film.slots, 7), np.float32)
        first_hits(self.scene.traced, self.camera, ray_buffer(), self.pixels, features)
        return features

    def _say(self, stage: str) -> None:
        if self.world.is_root:
            self.progress.stage(stage)

    def asked_to_stop(self) -> bool:
        """Collective. True on all ranks if a signal has reached any of them."""
        self.stopped_by = self.world.all_max(self.flag.raised)
        return self.stopped_by > 0

    def forecast(self) -> None:
        """The preprocess, on rank 0, and the workspace of the method on every rank."""
        self._say("forecast")
        self.forecasting: Forecasting = prepare_forecast(self.world, self.config, self.scene, self.watch)
        method = make_method(self.config, self.scene.traced, self.camera, self.forecasting.maps, self.scene.extent)
        self.batches = Batches(method, self.pixels, self.film.slots)
        if self.world.is_root:
            for warning in self.forecasting.warnings:
                print(f"causticmpi: warning: {warning}", file=sys.stderr)

    def trace(self) -> None:
        """Rounds until the budget is spent: each is merged whole or dropped whole, the first is always finished.

        All rounds are of one length and the clock of the budget stands still while pictures are written: whatever lets
        the cost of past rounds decide on later ones bends the picture (render.rounds).
        """
        self._say("tracing")
        length = passes = self._round_length()
        self._start_the_clock()
        while passes > 0:
            began = time.perf_counter()
            dropped, self.stopped_by = self._trace_round(passes)
            self.watch.add("tracing", time.perf_counter() - began)
            if dropped:
                break
            self.film.merge(self.pending)
            self.film.passes += passes
            self.rounds += 1
            if self.stopped_by:
                break
            passes = self.world.broadcast(self._next_round(length))
            if self.snapshots is not None and self.snapshots.due(self.film.passes):
                self._take_snapshot(self.snapshots)
            if passes > 0 and self.world.broadcast(self._picture_due()):
                self._write_in_between()

    def _round_length(self) -> int:
        """Collective. Passes of every round, from a pilot on all ranks at once."""
        crowd = self.world.all_max(-(-self.world.node_size // (os.cpu_count() or 1)))
        aim = ROUND_SECONDS * crowd if self.limit is None else max(0.05, min(ROUND_SECONDS * crowd, self.limit / 30))
        self.world.barrier()
        slowest = self.world.all_max(int(1e6 * self.batches.pilot_seconds()))
        length = equal_round(slowest / 1e6, aim, self.world.size)
        return min(length, self.config.budget.spp) if self.config.budget.spp is not None else length

    def _start_the_clock(self) -> None:
        """Collective. All ranks count from rank 0's start, whatever they waited for before; the time left is divided
        into tracing and the writing of progressive pictures."""
        self.world.barrier()  # rank 0 would not wait: who comes late to the broadcast would be late ever after
        elapsed = self.world.broadcast(self.watch.elapsed())
        now = time.monotonic()
        self.clock_zero, self.tracing_zero, self.tracing_since = now - elapsed, now, elapsed
        self.written_for = 0.0
        self.for_writing = self.for_tracing = math.inf
        if self.limit is not None:
            left = max(0.0, self.limit - elapsed - self.reserve)
            pictures = left // self.config.output.interval
            self.for_writing = min(WRITE_SHARE * left, pictures * self.reserve)
            self.for_tracing = left - self.for_writing

    def _elapsed(self) -> float:
        return time.monotonic() - self.clock_zero

    def _time_is_over(self) -> bool:
        return time.monotonic() - self.tracing_zero - self.written_for > self.for_tracing

    def _must_stop(self) -> bool:
        if self.rounds == 0:
            return bool(self.flag.raised)
        if self.world.is_root:
            self._show_progress()
        return self._time_is_over() or bool(self.flag.raised)

    def _trace_round(self, passes: int) -> tuple[bool, int]:
        """Trace a round together. All ranks learn: was it dropped, and the signal that stopped it, or 0."""
        self.pending.clear()
        shares = divide(self.film.passes, passes, len(self.pixels) // 16, self.world.size)
        mine = (shares[i] for i in self.world.hand_out(len(shares)))
        whole = self.batches.trace(mine, self.pending, self._must_stop)
        dropped, signal = divmod(self.world.all_max(self.flag.raised + (0 if whole else DROPPED)), DROPPED)
        return dropped > 0, signal

    def _next_round(self, length: int) -> int:
        """Passes of the next round; 0 ends the run. Rank 0's word counts."""
        if self.config.budget.spp is not None:
            return min(length, self.config.budget.spp - self.film.passes)
        return 0 if self._time_is_over() else length

    def _picture_due(self) -> bool:
        """A progressive picture each interval, as far as the time for writing goes; without a time budget, less often
        where writing costs more than its share."""
        since = self._elapsed() - self.last_write
        if self.limit is None:
            return since > max(self.config.output.interval, self.write_cost / WRITE_SHARE)
        return since > self.config.output.interval and self.written_for + self.write_cost <= self.for_writing

    def _write_in_between(self) -> None:
        began = time.monotonic()
        self._reduce_and_write()
        self.written_for += time.monotonic() - began

    def _take_snapshot(self, snapshots: Snapshots) -> None:
        """Collective. The clock of the budget stands still meanwhile, as for progressive pictures."""
        began = time.monotonic()
        seconds = self._elapsed() - self.written_for
        sums = self.world.reduce_sum(self.film.sums)
        if sums is not None:
            snapshots.take(sums, self.film.passes, seconds)
        self.world.barrier()
        self.written_for += time.monotonic() - began

    def _show_progress(self) -> None:
        elapsed = self._elapsed()
        rays = (self.film.rays + self.pending.rays) * self.world.size / max(elapsed - self.tracing_since, 1e-9)
        self.progress.update(elapsed, self.film.passes, self.film.passes, rays, self.result.error)

    def _reduce_and_write(self) -> None:
        """Collective. Merge the sums of all ranks into a picture, and have rank 0 write it."""
        began = time.perf_counter()
        with self.watch.stage("reduce"):
            sums = self.world.reduce_sum(self.film.sums)
            counts = self.world.reduce_sum(np.array([self.film.rays, self.film.nonfinite], np.int64))
            usage = self.world.gather(measure_usage(self.watch, self.batches))
        if self.world.is_root:
            assert sums is not None and counts is not None and usage is not None
            merged = Merged(sums, self.film.passes, int(counts[0]), int(counts[1]), usage)
            self.watch.add("write", self.result.write(merged, self.forecasting, self.watch))
        self.write_cost, self.last_write = self.world.broadcast((time.perf_counter() - began, self._elapsed()))

    def finish(self) -> None:
        """Collective. The final picture; a run stopped before its first round was finished has none, and says so."""
        passes = self.film.passes
        if passes > 0:
            self._say("writing")
            self._reduce_and_write()
        if not self.world.is_root:
            return
        if passes > 0:
            self._show_progress()
        self.progress.close()
        if self.stopped_by:
            self.result.mark_unfinished(self.stopped_by, passes)
        self._tell_result()

    def _tell_result(self) -> None:
        passes, error = self.film.passes, self.result.error
        words = f"{passes} pass{'' if passes == 1 else 'es'} in {self.watch.elapsed():.1f} s on {self.world.size} rank"
        words += "s" if self.world.size > 1 else ""
        words += "" if error is None else f", estimated relMSE {error:.2g}"
        if self.stopped_by:
            words += f", stopped by signal {self.stopped_by}" + ("" if passes else ": no picture")
        print(f"{self.result.directory}: {words}", flush=True)
