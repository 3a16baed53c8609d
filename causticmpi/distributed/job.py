"""A render from config to picture: rank 0 coordinates, every rank traces, the reducer merges sums."""

import math
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed import leaving
from causticmpi.distributed.begin import Input, Request, claim, nothing_to_do, read_input
from causticmpi.distributed.checkpoint import State, maps_hash, sample_keys, samples_version
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.keeper import Keeper
from causticmpi.distributed.prepare import (
    Forecasting,
    PreparedScene,
    needs_forecast,
    prepare_method,
    share_scene,
)
from causticmpi.distributed.result import Merged, Result
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.until import Part, Until
from causticmpi.distributed.usage import measure_usage
from causticmpi.distributed.warmup import warm_up
from causticmpi.distributed.world import World
from causticmpi.errors import RunError
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.pixels import pixel_order
from causticmpi.output.directory import UNFINISHED, Claim
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.output.progress import Progress
from causticmpi.output.report import provenance
from causticmpi.render.features import first_hits
from causticmpi.render.film import Film, quantum_for
from causticmpi.render.foresight import of_scene
from causticmpi.render.methods import BIASED, traces_light
from causticmpi.render.precision import Precision
from causticmpi.render.rounds import Batches, divide, equal_round
from causticmpi.scene.content import has_specular
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

DROPPED = 128
"""A rank's word on a round: the number of the signal it got (0: none), plus this if its share is unfinished.

The largest counts for all. A signal that a late rank's DROPPED hides does no harm: the time is over then.
"""
ROUND_SECONDS = 1.0
"""Aim of a round, times the ranks that share a core: what a round costs besides tracing is CPU time of each rank. At
most 1/30 of a time budget is lost with the round that is dropped."""
FIRST_WRITE, FIRST_WRITE_PER_PIXEL = 0.3, 1e-6
"""Seconds reserved for writing as long as no picture has been written: libraries to load, and a slow machine."""


def render(world: World, read_request: Callable[[], Request]) -> int:
    """Collective. Render what rank 0's `read_request` asks for; returns the exit code.

    Raises AgreedInputError on all ranks for bad input, before anything is written, and RunError on all ranks if the
    result could not be written.
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
    given = read_input(world, read_request, watch)
    if world.broadcast(nothing_to_do(given) if world.is_root else None):
        return 0
    config = given.request.config
    _warm_up(world, config, given.scene, watch)
    with watch.stage("load"):
        scene = share_scene(world, given.scene, config.watertight)
    run = _Run(world, given, scene, claim(world, given.request), watch, flag, snapshots)
    stopped = run.asked_to_stop()
    if not stopped:
        run.forecast()
    world.watch(True)
    if not stopped:
        run.trace()
    try:
        run.finish()
    except RunError:  # on all ranks
        world.watch(False)
        raise
    world.watch(False)
    scene.embree.close()
    world.release()
    return run.stopped_by


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
        given: Input,
        scene: PreparedScene,
        claim: Claim | None,
        watch: Stopwatch,
        flag: StopFlag,
        snapshots: Snapshots | None,
    ) -> None:
        config = given.request.config
        self.snapshots = snapshots
        self.state: State | None = world.broadcast(given.state)
        self.sums_before = given.sums
        self.world, self.config, self.scene, self.watch, self.flag = world, config, scene, watch, flag
        if self.state is not None:
            watch.go_on_from(self.state.elapsed, self.state.stages)
        window = config.film.crop or (0, 0, config.film.width, config.film.height)
        slots = (window[2] - window[0]) * (window[3] - window[1])
        self.camera = camera_array(scene.data.camera, config.film.width, config.film.height)
        self.pixels = pixel_order(window, config.film.width)
        quantum = quantum_for(scene.brightest)
        light = traces_light(config) and has_specular(scene.data)
        self.film, self.pending = Film(slots, quantum, light), Film(slots, quantum, light)
        self.precision = Precision()
        self.until = None if config.budget.until is None else Until(float(config.budget.until))
        self.second = Film(slots if self.until else 0, quantum, light)
        self.limit = float(config.budget.time) if config.budget.time is not None else None
        self.rounds = self.round_passes = 0
        self.stopped_by = 0
        self.tracing_kept = 0.0
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
            source = provenance(shlex.join(given.request.command), facts, scene.data.content_hash)
            self.progress = Progress(self.limit, config.budget.spp)
            self.result = Result(config, claim, source, self._first_hits())
            output, resumed = config.output, self.state is not None
            checkpoint = output.checkpoint if self.until is None else 0.0  # its halves are not kept
            limited = self.limit is not None
            self.keeper = Keeper(claim.directory, output.interval, checkpoint, slots, limited=limited, resumed=resumed)
            self.reserve += self.keeper.save_cost

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
        self.forecasting: Forecasting
        method, self.forecasting = prepare_method(self.world, self.config, self.scene, self.camera, self.watch)
        self.batches = Batches(method, self.pixels, self.film.slots)
        if self.world.is_root:
            self.forecasting.warnings = (*of_scene(self.config, self.scene.data), *self.forecasting.warnings)
            for warning in self.forecasting.warnings:
                print(f"causticmpi: warning: {warning}", file=sys.stderr)
            self.maps_hash = maps_hash(self.forecasting.maps, self.forecasting.guides)
            if self.state is not None and self.state.maps != self.maps_hash:
                print(
                    "causticmpi: warning: this machine makes other forecast maps of the same seed: the picture stays "
                    "unbiased, but is not bit for bit that of a run on one machine",
                    file=sys.stderr,
                )

    def trace(self) -> None:
        """Rounds until the budget is spent: each is merged whole or dropped whole, the first is always finished.

        All rounds are of one length, or end at borders known before, and the clock of the budget stands still while
        pictures are written: whatever lets the cost of past rounds decide on later ones bends the picture
        (render.rounds).
        """
        self._say("tracing")
        self.round_passes = self._round_length()
        self._start_the_clock()
        self._take_up()
        passes = self.world.broadcast(self._next_round())
        while passes > 0:
            began = time.perf_counter()
            dropped, self.stopped_by = self._trace_round(passes)
            seconds = time.perf_counter() - began
            self.watch.add("tracing", seconds)
            if dropped:
                break
            if self.until is not None and self.until.half(self.film.passes):
                self.second.merge(self.pending)
            self.film.merge(self.pending)
            self.film.passes += passes
            self.rounds += 1
            self.tracing_kept = self._tracing_clock()
            if self.stopped_by:
                break
            if self._good_enough():
                break
            passes = self.world.broadcast(self._next_round())
            if self.snapshots is not None and self.snapshots.due(self.film.passes):
                self._take_snapshot(self.snapshots)
            picture, checkpoint = self.world.broadcast(self._writing_due(seconds))
            if passes > 0 and (picture or checkpoint):
                self._write_in_between(picture, checkpoint)

    def _round_length(self) -> int:
        """Collective. Passes of every round, from a pilot on all ranks at once; a resumed run keeps to what it had, for
        the length must not hang on the cost of rounds before."""
        if self.state is not None:
            return self.state.round_passes
        crowd = self.world.all_max(-(-self.world.node_size // (os.cpu_count() or 1)))
        aim = ROUND_SECONDS * crowd if self.limit is None else max(0.05, min(ROUND_SECONDS * crowd, self.limit / 30))
        self.world.barrier()
        slowest = self.world.all_max(int(1e6 * self.batches.pilot_seconds()))
        return equal_round(slowest / 1e6, aim, self.world.size)

    def _start_the_clock(self) -> None:
        """Collective. All ranks count from rank 0's start, whatever they waited for before; the time left is divided
        into tracing and the writing of progressive pictures.

        The division of a resumed run hangs on what all its starts spent on preparing, never on what its rounds cost.
        """
        self.world.barrier()  # rank 0 would not wait: who comes late to the broadcast would be late ever after
        elapsed = self.world.broadcast(self.watch.elapsed())
        now = time.monotonic()
        self.clock_zero, self.tracing_since = now - elapsed, elapsed
        self.written_for = self.state.writing if self.state is not None else 0.0
        self.tracing_kept = self.state.tracing if self.state is not None else 0.0
        self.tracing_zero = now - self.written_for - self.tracing_kept
        self.preparing = elapsed - self.written_for - self.tracing_kept
        self.for_tracing = self.world.broadcast(self._time_for_tracing() if self.world.is_root else None)

    def _time_for_tracing(self) -> float:
        self.keeper.begin(self._elapsed())
        if self.limit is None:
            return math.inf
        left = max(0.0, self.limit - self.preparing - self.reserve)
        return left - self.keeper.allow(left, self.reserve)

    def _take_up(self) -> None:
        """Put what the checkpoint has into the film: rank 0 holds the sums of all ranks."""
        if self.state is None:
            return
        self.film.passes, self.rounds = self.state.passes, self.state.rounds
        if self.sums_before is not None:
            self.film.sums[:] = self.sums_before
            self.film.touched[:] = True
            self.film.rays, self.film.nonfinite = self.state.rays, self.state.nonfinite
            self.sums_before = None

    def _elapsed(self) -> float:
        return time.monotonic() - self.clock_zero

    def _tracing_clock(self) -> float:
        """Seconds of the budget spent on tracing: this clock stands still while something is written."""
        return time.monotonic() - self.tracing_zero - self.written_for

    def _time_is_over(self) -> bool:
        return self._tracing_clock() > self.for_tracing

    def _must_stop(self) -> bool:
        self.world.pulse()
        if self.rounds == 0:
            return bool(self.flag.raised)
        if self.world.is_root:
            self._show_progress()
        return self._time_is_over() or bool(self.flag.raised)

    def _trace_round(self, passes: int) -> tuple[bool, int]:
        """Trace a round together. All ranks learn: was it dropped, and the signal that stopped it, or 0."""
        self.pending.clear()
        shares = divide(
            self.film.passes, passes, len(self.pixels) // 16, self.world.size, self.batches.method.light_paths > 0
        )
        mine = (shares[i] for i in self.world.hand_out(len(shares)))
        whole = self.batches.trace(mine, self.pending, self._must_stop)
        dropped, signal = divmod(self.world.all_max(self.flag.raised + (0 if whole else DROPPED)), DROPPED)
        return dropped > 0, signal

    def _next_round(self) -> int:
        """Passes of the next round; 0 ends the run. Rank 0's word counts."""
        length = self.round_passes
        if self.until is not None:
            length = min(length, self.until.to_border(self.film.passes))
        if self.config.budget.spp is not None:
            return max(0, min(length, self.config.budget.spp - self.film.passes))
        if self.state is not None and self.state.covers(self.config.budget):
            return 0
        return 0 if self.rounds > 0 and self._time_is_over() else length

    def _good_enough(self) -> bool:
        """Collective. At the end of a group of passes: how well the error is known; and whether that ends the run."""
        passes = self.film.passes
        group_ends = self.precision.due(passes)
        asked = self.until is not None and self.until.asks(passes)
        if not (group_ends or asked):
            return False
        with self.watch.stage("reduce"):
            sums = self.world.reduce_sum(self.film.sums)
            second = self.world.reduce_sum(self.second.sums) if asked else None
        over = False
        if sums is not None:
            if group_ends:
                self.precision.take(sums, passes, RELMSE_FLOOR)
                self.result.known = self.precision.known
            over = self.until is not None and second is not None and self.until.decide(sums, second, passes)
        return bool(self.world.broadcast(over))

    def _writing_due(self, round_seconds: float) -> tuple[bool, bool]:
        """Whether a picture, and whether a checkpoint, is to be written between two rounds. Rank 0's word counts."""
        if not self.world.is_root:
            return False, False
        elapsed = self._elapsed()
        return self.keeper.picture_due(elapsed, self.written_for), self.keeper.save_due(elapsed, round_seconds)

    def _write_in_between(self, picture: bool, checkpoint: bool) -> None:
        began = time.monotonic()
        self._merge_and_write(picture, checkpoint)
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
        traced = self.film.rays + self.pending.rays - (self.state.rays if self.state is not None else 0)
        rays = traced * self.world.size / max(elapsed - self.tracing_since, 1e-9)
        self.progress.update(
            elapsed, self.film.passes, self.film.passes, rays, *(self.result.known or (self.result.error, None))
        )

    def _merge_and_write(self, picture: bool, checkpoint: bool, last: bool = False) -> None:
        """Collective. Merge the sums of all ranks, and have rank 0 write a checkpoint and a picture of them."""
        taken = self._elapsed()
        with self.watch.stage("reduce"):
            sums = self.world.reduce_sum(self.film.sums)
            counts = self.world.reduce_sum(np.array([self.film.rays, self.film.nonfinite], np.int64))
            second = self.world.reduce_sum(self.second.sums) if last and self.until is not None else None
            usage = self.world.gather(measure_usage(self.watch, self.batches))
        if self.world.is_root:
            self.world.pulse(writing=True)
            assert sums is not None and counts is not None and usage is not None
            parts: Sequence[Part] = [(sums, self.film.passes)]
            if self.until is not None and second is not None:
                parts = self.until.parts(sums, second, self.film.passes)
            reached = self.until is not None and self.until.over
            merged = Merged(parts, self.film.passes, int(counts[0]), int(counts[1]), usage, reached)
            if checkpoint:
                with self.watch.stage("write"):
                    self.keeper.save(self._state(merged, complete=last and not self.stopped_by), sums, taken, last)
            if picture:
                self.keeper.write_picture(lambda: self._write_picture(merged), self._elapsed, last)
            self.world.pulse(writing=False)
        self.world.barrier()

    def _write_picture(self, merged: Merged) -> None:
        self.watch.add("write", self.result.write(merged, self.forecasting, self.watch))

    def _state(self, merged: Merged, complete: bool) -> State:
        return State(
            version=samples_version(),
            config=sample_keys(self.config),
            scene=self.scene.data.content_hash,
            seeds=(self.config.seed,),
            maps=self.maps_hash,
            passes=merged.passes,
            rays=merged.rays,
            nonfinite=merged.nonfinite,
            rounds=self.rounds,
            round_passes=self.round_passes,
            budget=self.config.budget,
            complete=complete,
            preparing=self.preparing,
            tracing=self.tracing_kept,
            writing=self.written_for,
            stages=dict(self.watch.stages),
        )

    def finish(self) -> None:
        """Collective. The last checkpoint and picture; a run stopped before its first round was finished has none, and
        says so. Raises RunError on all ranks if they cannot be written."""
        passes = self.film.passes
        if passes > 0:
            self._say("writing")
            self._merge_and_write(picture=True, checkpoint=True, last=True)
        failure = ""
        if self.world.is_root:
            if passes > 0:
                self._show_progress()
            self.progress.close()
            self._leave_marker(passes)
            failure = self.keeper.failure()
        failure = self.world.broadcast(failure)
        if failure:
            raise RunError(failure)
        if self.world.is_root:
            self._tell_result()

    def _leave_marker(self, passes: int) -> None:
        """The file that tells a batch script to start the run again, there exactly while it is unfinished."""
        if self.stopped_by:
            kept = passes or (self.state.passes if self.state is not None else 0)
            self.keeper.keep("marker", lambda: self.result.mark_unfinished(self.stopped_by, kept), last=True)
        else:
            (self.result.directory / UNFINISHED).unlink(missing_ok=True)

    def _tell_result(self) -> None:
        passes, error = self.film.passes, self.result.error
        words = f"{passes} pass{'' if passes == 1 else 'es'} in {self.watch.elapsed():.1f} s on {self.world.size} rank"
        words += "s" if self.world.size > 1 else ""
        words += f", {self.config.method} (biased)" if self.config.method in BIASED else ""
        words += "" if error is None else f", estimated relMSE {error:.2g}"
        words += "" if self.until is None or self.until.over else f" (wanted: {self.until.target:.2g})"
        if self.stopped_by:
            words += f", stopped by signal {self.stopped_by}"
            if not passes:
                words += ": no picture" if self.state is None else f": the {self.state.passes} passes of before stay"
        print(f"{self.result.directory}: {words}", flush=True)
