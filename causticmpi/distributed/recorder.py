"""What rank 0 tells and keeps of a run: progress, warnings, checkpoints, pictures, the last words."""

import shlex
import sys
from collections.abc import Callable, Mapping

import numpy as np

from causticmpi.distributed.begin import Input
from causticmpi.distributed.budget_clock import BudgetClock
from causticmpi.distributed.checkpoint import State, maps_hash, sample_keys, samples_version
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.keeper import Keeper
from causticmpi.distributed.prepare import Forecasting, PreparedScene
from causticmpi.distributed.result import Merged, Result
from causticmpi.distributed.until import HELD
from causticmpi.distributed.world import World
from causticmpi.output.directory import UNFINISHED, Claim
from causticmpi.output.progress import Progress
from causticmpi.output.report import provenance
from causticmpi.render.foresight import of_scene
from causticmpi.render.methods import BIASED


class Recorder:
    """Of one run, on rank 0 alone. features: first hits, see `Result`; before: the state that a resumed run began with;
    elapsed: seconds of the run."""

    def __init__(
        self,
        world: World,
        given: Input,
        scene: PreparedScene,
        claim: Claim,
        watch: Stopwatch,
        features: np.ndarray,
    ) -> None:
        self.config, self.before, self.scene, self.watch = given.request.config, given.state, scene.data, watch
        facts = {
            "hosts": world.hosts(),
            "mpi": world.library,
            "nodes": world.node_count,
            "embree": scene.embree.version,
            "embree_bytes_per_rank": scene.embree.bytes,
            "ray_packet_width": 16 if scene.embree.native16 else 8,
        }
        source = provenance(shlex.join(given.request.command), facts, scene.data.content_hash)
        budget, output = self.config.budget, self.config.output
        limit = None if budget.time is None else float(budget.time)
        self.progress = Progress(limit, budget.spp)
        self.result = Result(self.config, claim, source, features)
        slots = len(features) * (1 if budget.until is None else HELD)
        limited, resumed = limit is not None, self.before is not None
        self.keeper = Keeper(
            claim.directory, output.interval, output.checkpoint, slots, limited=limited, resumed=resumed
        )

    def take_forecast(self, made: Forecasting) -> None:
        """The preprocess is done: tell its warnings, and whether a resumed run has the maps it had."""
        self.forecasting = made
        made.warnings = (*of_scene(self.config, self.scene), *made.warnings)
        for warning in made.warnings:
            print(f"causticmpi: warning: {warning}", file=sys.stderr)
        if made.plan is not None:
            self.progress.stage(f"caustics {made.plan.words}")
        self.maps_hash = maps_hash(made.maps, made.guides, made.sight)
        if self.before is not None and self.before.maps != self.maps_hash:
            print(
                "causticmpi: warning: this machine makes other forecast maps of the same seed: the picture stays "
                "unbiased, but is not bit for bit that of a run on one machine",
                file=sys.stderr,
            )

    def show_progress(self, elapsed: float, passes: int, rays_per_second: float) -> None:
        """The bar, or a line."""
        error = self.result.known or (self.result.error, None)
        self.progress.update(elapsed, passes, passes, rays_per_second, *error)

    def state_of(self, merged: Merged, rounds: int, round_passes: int, clock: BudgetClock, complete: bool) -> State:
        """What a checkpoint tells of the run."""
        return State(
            version=samples_version(),
            config=sample_keys(self.config),
            scene=self.scene.content_hash,
            seeds=(self.config.seed,),
            maps=self.maps_hash,
            passes=merged.passes,
            rays=merged.rays,
            nonfinite=merged.nonfinite,
            rounds=rounds,
            round_passes=round_passes,
            budget=self.config.budget,
            complete=complete,
            preparing=clock.preparing,
            tracing=clock.tracing_kept,
            writing=clock.written_for,
            stages=dict(self.watch.stages),
        )

    def save(self, state: State, arrays: Mapping[str, np.ndarray], taken: float, last: bool) -> None:
        """Write a checkpoint of the sums after `taken` seconds."""
        with self.watch.stage("write"):
            self.keeper.save(state, arrays, taken, last)

    def write_picture(self, merged: Merged, elapsed: Callable[[], float], last: bool) -> None:
        """Write picture and report."""

        def write() -> None:
            self.watch.add("write", self.result.write(merged, self.forecasting, self.watch))

        self.keeper.write_picture(write, elapsed, last)

    def close(self, stopped_by: int, passes: int) -> str:
        """The end of the run: one line on what could not be written, "" if all could.

        A file tells a batch script to start the run again, there exactly while it is unfinished.
        """
        self.progress.close()
        if stopped_by:
            kept = passes or (self.before.passes if self.before is not None else 0)
            self.keeper.keep("marker", lambda: self.result.mark_unfinished(stopped_by, kept), last=True)
        else:
            (self.result.directory / UNFINISHED).unlink(missing_ok=True)
        return self.keeper.failure()

    def tell_result(self, passes: int, ranks: int, stopped_by: int, wanted: str, overrun: str) -> None:
        """The last line. wanted, overrun: what is to be said of the wanted error and of the budget."""
        error = self.result.error
        words = f"{passes} pass{'' if passes == 1 else 'es'} in {self.watch.elapsed():.1f} s on {ranks} rank"
        words += "s" if ranks > 1 else ""
        words += f", {self.config.method} (biased)" if self.config.method in BIASED else ""
        words += "" if error is None else f", estimated relMSE {error:.2g}"
        words += wanted + overrun
        if stopped_by:
            words += f", stopped by signal {stopped_by}"
            if not passes:
                words += ": no picture" if self.before is None else f": the {self.before.passes} passes of before stay"
        print(f"{self.result.directory}: {words}", flush=True)
