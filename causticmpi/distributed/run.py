"""One render on one rank: preprocess, rounds of passes until the budget is spent, sums merged and handed to rank 0."""

import math
import os
import time
from collections.abc import Sequence

import numpy as np

from causticmpi.distributed import leaving
from causticmpi.distributed.begin import Input
from causticmpi.distributed.budget_clock import BudgetClock
from causticmpi.distributed.checkpoint import State
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.films import Films
from causticmpi.distributed.prepare import PreparedScene, prepare_method
from causticmpi.distributed.recorder import Recorder
from causticmpi.distributed.result import Merged
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.until import Part, Until
from causticmpi.distributed.usage import measure_usage
from causticmpi.distributed.world import World
from causticmpi.errors import RunError
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.pixels import pixel_order
from causticmpi.output.directory import Claim
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.render.features import first_hits
from causticmpi.render.film import quantum_for
from causticmpi.render.methods import traces_light
from causticmpi.render.precision import Precision
from causticmpi.render.rounds import Batches, divide, equal_round
from causticmpi.scene.content import has_specular
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


class Run:
    """The state of one render. film: sums of the merged rounds, of all ranks of this node; pending: of the round being
    traced; recorder: on rank 0 alone; stopped_by: a signal, 0 for none."""

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
        self.world, self.config, self.scene, self.watch, self.flag = world, config, scene, watch, flag
        self.snapshots = snapshots
        self.state: State | None = world.broadcast(given.state)
        self.arrays_before = given.arrays
        if self.state is not None:
            watch.go_on_from(self.state.elapsed, self.state.stages)
        self.clock = BudgetClock(self.state)
        self.camera = camera_array(scene.data.camera, config.film.width, config.film.height)
        self.pixels = pixel_order(config.film.window, config.film.width)
        quantum = quantum_for(scene.brightest)
        light = traces_light(config) and has_specular(scene.data)
        self.films = Films(world, config.film.pixels, quantum, light, halves=config.budget.until is not None)
        self.film, self.pending = self.films.merged, self.films.pending
        width = config.film.window[2] - config.film.window[0]
        self.precision = Precision(width)
        self.until = None if config.budget.until is None else Until(float(config.budget.until), width, given.arrays)
        self.limit = float(config.budget.time) if config.budget.time is not None else None
        self.rounds = self.round_passes = 0
        self.stopped_by = 0
        self.reserve = (
            FIRST_WRITE + FIRST_WRITE_PER_PIXEL * config.film.pixels + leaving.expected_seconds(world.node_size)
        )
        if claim is not None:
            features = np.zeros((config.film.pixels, 7), np.float32)
            first_hits(scene.traced, self.camera, ray_buffer(), self.pixels, features)
            self.recorder = Recorder(world, given, scene, claim, watch, features)
            self.reserve += self.recorder.keeper.save_cost

    def _say(self, stage: str) -> None:
        if self.world.is_root:
            self.recorder.progress.stage(stage)

    def asked_to_stop(self) -> bool:
        """Collective. True on all ranks if a signal has reached any of them."""
        self.stopped_by = self.world.all_max(self.flag.raised)
        return self.stopped_by > 0

    def forecast(self) -> None:
        """The preprocess, on rank 0, and the workspace of the method on every rank."""
        self._say("preparing")
        method, forecasting = prepare_method(self.world, self.config, self.scene, self.camera, self.watch)
        self.batches = Batches(method, self.pixels, self.film.slots)
        if self.world.is_root:
            self.recorder.take_forecast(forecasting)

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
            self._merge_round(passes)
            over = self._good_enough()  # of a stopped run too: the next start would not ask about this round
            if self.stopped_by or over:
                break
            passes = self._meet_for_next_round()
            if self.snapshots is not None and self.snapshots.due(self.film.passes):
                self._take_snapshot(self.snapshots)
            picture, checkpoint = self.world.broadcast(self._writing_due(seconds))
            if passes > 0 and (picture or checkpoint):
                with self.clock.standing_still():
                    self._merge_and_write(picture, checkpoint)

    def _round_length(self) -> int:
        """Collective. Passes of every round, from a pilot on all ranks at once: its CPU time, times the ranks that
        share a core. A resumed run keeps to what it had, for the length must not hang on the cost of rounds before."""
        if self.state is not None:
            return self.state.round_passes
        crowd = self.world.all_max(-(-self.world.node_size // (os.cpu_count() or 1)))
        aim = ROUND_SECONDS * crowd if self.limit is None else max(0.05, min(ROUND_SECONDS * crowd, self.limit / 30))
        self.world.barrier()
        slowest = self.world.all_max(int(1e6 * self.batches.pilot_seconds()))
        return equal_round(crowd * slowest / 1e6, aim, self.world.size)

    def _start_the_clock(self) -> None:
        """Collective. The time left is divided into tracing and the writing of progressive pictures.

        The division of a resumed run hangs on what all its starts spent on preparing, never on what its rounds cost.
        """
        self.world.barrier()  # rank 0 would not wait: who comes late to the broadcast would be late ever after
        self.clock.start(self.world.broadcast(self.watch.elapsed()))
        self.clock.for_tracing = self.world.broadcast(self._time_for_tracing() if self.world.is_root else None)
        if self.limit is not None:
            self.clock.end = self.limit - self.reserve

    def _time_for_tracing(self) -> float:
        keeper = self.recorder.keeper
        keeper.begin(self.clock.elapsed())
        if self.limit is None:
            return math.inf
        left = max(0.0, self.limit - self.clock.preparing - self.reserve)
        return left - keeper.allow(left, self.reserve)

    def _take_up(self) -> None:
        """Put what the checkpoint has into the film: rank 0 holds the sums of all ranks."""
        if self.state is None:
            return
        self.film.passes, self.rounds = self.state.passes, self.state.rounds
        if self.arrays_before is not None:
            self.films.take_up(self.arrays_before)
            self.film.rays, self.film.nonfinite = self.state.rays, self.state.nonfinite
            self.arrays_before = None

    def _must_stop(self) -> bool:
        self.world.pulse()
        if self.rounds == 0:
            return bool(self.flag.raised)
        if self.world.is_root:
            self._show_progress()
        return self.clock.is_over() or bool(self.flag.raised)

    def _trace_round(self, passes: int) -> tuple[bool, int]:
        """Trace a round together. All ranks learn: was it dropped, and the signal that stopped it, or 0."""
        shares = divide(
            self.film.passes, passes, len(self.pixels) // 16, self.world.size, self.batches.method.light_paths > 0
        )
        mine = (shares[i] for i in self.world.hand_out(len(shares)))
        whole = self.batches.trace(mine, self.pending, self._must_stop)
        dropped, signal = divmod(self.world.all_max(self.flag.raised + (0 if whole else DROPPED)), DROPPED)
        return dropped > 0, signal

    def _merge_round(self, passes: int) -> None:
        self.films.merge(passes, second=self.until is not None and self.until.half(self.film.passes) == 1)
        self.rounds += 1
        self.clock.keep_round()

    def _meet_for_next_round(self) -> int:
        """Collective. Passes of the next round, once all ranks have merged the last one."""
        return self.world.all_max(self._next_round() if self.world.is_root else 0)

    def _next_round(self) -> int:
        """Passes of the next round; 0 ends the run. Rank 0's word counts."""
        length = self.round_passes
        if self.until is not None:
            if self.until.over:
                return 0
            length = min(length, self.until.to_border(self.film.passes))
        if self.config.budget.spp is not None:
            return max(0, min(length, self.config.budget.spp - self.film.passes))
        if self.state is not None and self.state.covers(self.config.budget):
            return 0
        return 0 if self.rounds > 0 and self.clock.is_over() else length

    def _good_enough(self) -> bool:
        """Collective. At the end of a group of passes: how well the error is known; and whether that ends the run."""
        passes = self.film.passes
        group_ends = self.precision.due(passes)
        asked = self.until is not None and self.until.asks(passes)
        if not (group_ends or asked):
            return False
        with self.watch.stage("reduce"):
            self.world.barrier()
            sums = self.films.total()
            second = self.films.total_of_second() if asked else None
        over = False
        if sums is not None:
            if group_ends:
                self.precision.take(sums, passes, RELMSE_FLOOR)
                self.recorder.result.known = self.precision.known
            over = self.until is not None and second is not None and self.until.decide(sums, second, passes)
        return bool(self.world.broadcast(over))

    def _writing_due(self, round_seconds: float) -> tuple[bool, bool]:
        """Whether a picture, and whether a checkpoint, is to be written between two rounds. Rank 0's word counts."""
        if not self.world.is_root:
            return False, False
        keeper, elapsed = self.recorder.keeper, self.clock.elapsed()
        return keeper.picture_due(elapsed, self.clock.written_for), keeper.save_due(elapsed, round_seconds)

    def _take_snapshot(self, snapshots: Snapshots) -> None:
        """Collective. The clock of the budget stands still meanwhile, as for progressive pictures."""
        with self.clock.standing_still():
            seconds = self.clock.elapsed() - self.clock.written_for
            sums = self.films.total()
            if sums is not None:
                snapshots.take(sums, self.film.passes, seconds)
            self.world.barrier()

    def _show_progress(self) -> None:
        elapsed = self.clock.elapsed()
        traced = self.film.rays + self.pending.rays - (self.state.rays if self.state is not None else 0)
        rays = traced * self.world.size / max(elapsed - self.clock.before_tracing, 1e-9)
        self.recorder.show_progress(elapsed, self.film.passes, rays)

    def _merge_and_write(self, picture: bool, checkpoint: bool, last: bool = False) -> None:
        """Collective. Merge the sums of all ranks, and have rank 0 write a checkpoint and a picture of them."""
        taken = self.clock.elapsed()
        with self.watch.stage("reduce"):
            counts = self.world.reduce_sum(np.array([self.film.rays, self.film.nonfinite], np.int64))
            sums = self.films.total()  # the ranks have met over the counts
            second = self.films.total_of_second() if self.until is not None else None
            usage = self.world.gather(measure_usage(self.watch, self.batches))
        if self.world.is_root:
            self.world.pulse(writing=True)
            assert sums is not None and counts is not None and usage is not None
            parts: Sequence[Part] = [(sums, self.film.passes)]
            arrays = {"sums": sums}
            if self.until is not None and second is not None:
                arrays |= self.until.kept(second)
                parts = self.until.parts(sums, second, self.film.passes)
            reached = self.until is not None and self.until.over
            merged = Merged(parts, self.film.passes, int(counts[0]), int(counts[1]), usage, reached)
            if checkpoint:
                complete = last and not self.stopped_by
                state = self.recorder.state_of(merged, self.rounds, self.round_passes, self.clock, complete)
                self.recorder.save(state, arrays, taken, last)
            if picture:
                self.recorder.write_picture(merged, self.clock.elapsed, last)
            self.world.pulse(writing=False)
        self.world.barrier()

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
            failure = self.recorder.close(self.stopped_by, passes)
        failure = self.world.broadcast(failure)
        if failure:
            raise RunError(failure)
        if self.world.is_root:
            wanted = "" if self.until is None else self.until.remark(passes)
            late = self.limit is not None and self.rounds == 1
            overrun = self.clock.overrun(float(self.limit or 0), passes) if late else ""
            self.recorder.tell_result(passes, self.world.size, self.stopped_by, wanted, overrun)
