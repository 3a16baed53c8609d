"""A render from config to picture: rank 0 coordinates, every rank traces, the reducer merges sums."""

import resource
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import Forecasting, PreparedScene, prepare_forecast, share_scene
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.warmup import warm_up
from causticmpi.distributed.world import World
from causticmpi.errors import InputError
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.pixels import pixel_order
from causticmpi.output.directory import UNFINISHED, Claim, claim_directory, write_run, write_whole
from causticmpi.output.picture import Picture, estimated_relmse
from causticmpi.output.progress import Progress
from causticmpi.output.report import attributes_from_report, build_report, provenance
from causticmpi.render.features import first_hits
from causticmpi.render.film import Film, quantum_for, resolve
from causticmpi.render.methods import BIASED, make_method
from causticmpi.render.rounds import Batches, deal
from causticmpi.scene.content import with_camera
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

FINISHED, DROPPED, SIGNALLED = 0, 1, 2
"""What ranks say of a round; the largest counts for all."""
ROUND_SECONDS = 1.0
"""Aim of a round under a time budget; at most 1/30 of the budget is lost with the round that is dropped."""
WRITE_SHARE = 0.05
"""Progressive pictures may cost this share of the time."""


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
    watch = Stopwatch()
    with StopFlag() as flag:
        request, scene_data, claim = _read_input(world, read_request, watch)
        config = request.config
        _warm_up(world, config, watch)
        with watch.stage("load"):
            scene = share_scene(world, scene_data)
        run = _Run(world, request, scene, claim, watch, flag)
        run.forecast()
        run.trace()
        run.finish()
    return 0


def _read_input(
    world: World, read_request: Callable[[], Request], watch: Stopwatch
) -> tuple[Request, SceneData | None, Claim | None]:
    """Rank 0 reads everything that can be wrong before a rank does any work; all ranks learn of the verdict."""
    error: InputError | None = None
    request = scene = claim = None
    if world.is_root:
        try:
            with watch.stage("load"):
                request = read_request()
                scene = load_scene(request.scene_file)
                if request.config.camera is not None:
                    scene = with_camera(scene, request.config.camera)
            claim = claim_directory(request.config.output.directory, force=request.force)
        except InputError as found:
            error = found
    world.agree(error)
    return world.broadcast(request), scene, claim


def _warm_up(world: World, config: RenderConfig, watch: Stopwatch) -> None:
    """Compile once per node. Compiling lies outside the budget and is reported; loading compiled code lies within it."""
    began = time.perf_counter()
    compiled = world.first_on_node(lambda: warm_up(config, world.is_root))
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
    ) -> None:
        config = request.config
        self.world, self.request, self.config = world, request, config
        self.scene, self.claim, self.watch, self.flag = scene, claim, watch, flag
        film = config.film
        self.window = film.crop or (0, 0, film.width, film.height)
        self.size = (self.window[3] - self.window[1], self.window[2] - self.window[0])
        self.camera = camera_array(scene.data.camera, film.width, film.height)
        self.pixels = pixel_order(self.window, film.width)
        slots = self.size[0] * self.size[1]
        quantum = quantum_for(scene.brightest)
        self.film, self.pending = Film(slots, quantum), Film(slots, quantum)
        self.limit = float(config.budget.time) if config.budget.time is not None else None
        self.rounds = 0
        self.stopped_by = 0
        self.error: float | None = None
        self.last_write = 0.0
        self.write_cost = 0.0
        self.world_facts = {
            "hosts": world.hosts(),
            "mpi": world.library,
            "nodes": world.node_count,
            "embree": scene.embree.version,
            "embree_bytes_per_rank": scene.embree.bytes,
            "ray_packet_width": 16 if scene.embree.native16 else 8,
        }
        if world.is_root:
            self.provenance = provenance(shlex.join(request.command), self.world_facts, scene.data.content_hash)
            self.progress = Progress(self.limit, config.budget.spp)
            self.features = self._first_hits()

    def _first_hits(self) -> np.ndarray:
        features = np.zeros((self.film.slots, 7), np.float32)
        first_hits(self.scene.traced, self.camera, ray_buffer(), self.pixels, features)
        return features

    def _say(self, stage: str) -> None:
        if self.world.is_root:
            self.progress.stage(stage)

    def forecast(self) -> None:
        """The preprocess, on rank 0, and the workspace of the method on every rank."""
        self._say("forecast")
        self.forecasting: Forecasting = prepare_forecast(self.world, self.config, self.scene, self.watch)
        self.film.rays += self.forecasting.rays
        method = make_method(self.config, self.scene.traced, self.camera, self.forecasting.maps, self.scene.extent)
        self.batches = Batches(method, self.pixels, self.film.slots)
        if self.world.is_root:
            for warning in self.forecasting.warnings:
                print(f"causticmpi: warning: {warning}", file=sys.stderr)

    def trace(self) -> None:
        """Rounds until the budget is spent: each is merged whole or dropped whole, the first is always finished."""
        self._say("tracing")
        passes = 1  # of the next round: the first one is as small as can be, since it must be finished
        self._agree_on_the_clock()
        while passes > 0:
            began = time.perf_counter()
            verdict = self._trace_round(passes)
            seconds = time.perf_counter() - began
            self.watch.add("tracing", seconds)
            if verdict != FINISHED:
                self.stopped_by = verdict - SIGNALLED if verdict >= SIGNALLED else 0
                break
            self.film.merge(self.pending)
            self.film.passes += passes
            self.rounds += 1
            passes = self.world.broadcast(self._next_round(passes, seconds))
            if passes > 0 and self.world.broadcast(self._picture_due()):
                self._reduce_and_write()

    def _agree_on_the_clock(self) -> None:
        """All ranks count from rank 0's start, whatever they waited for before."""
        elapsed = self.world.broadcast(self.watch.elapsed())
        self.clock_zero = time.monotonic() - elapsed

    def _elapsed(self) -> float:
        return time.monotonic() - self.clock_zero

    def _must_stop(self) -> bool:
        if self.rounds == 0:
            return bool(self.flag.raised)
        late = self.limit is not None and self._elapsed() > self.limit - self.write_cost
        if self.world.is_root:
            self._show_progress()
        return late or bool(self.flag.raised)

    def _trace_round(self, passes: int) -> int:
        """Trace this rank's share of a round; the verdict of all ranks."""
        self.pending.clear()
        tiles = len(self.pixels) // 16
        shares = deal(self.film.passes, passes, tiles, self.world.size, self.world.rank)
        whole = self.batches.trace(shares, self.pending, self._must_stop)
        verdict = FINISHED if whole else DROPPED
        if self.flag.raised:
            verdict = SIGNALLED + self.flag.raised
        return self.world.all_max(verdict)

    def _next_round(self, passes: int, seconds: float) -> int:
        """Passes of the next round; 0 ends the run. Rank 0's word counts.

        Rounds of about a second, of whole passes per rank where that fits: the choice moves no sample, only the
        number of passes that a budget has room for.
        """
        size = self.world.size
        aim = ROUND_SECONDS if self.limit is None else max(0.25, min(ROUND_SECONDS, self.limit / 30))
        wanted = max(1, int(passes * aim / max(seconds, 1e-9)))
        wanted = min(wanted, 4 * passes)
        if wanted > size:
            wanted -= wanted % size
        if self.config.budget.spp is not None:
            return min(wanted, self.config.budget.spp - self.film.passes)
        assert self.limit is not None
        return wanted if self._elapsed() < self.limit - self.write_cost else 0

    def _picture_due(self) -> bool:
        """A progressive picture each interval, or less often where writing costs more than its share of the time."""
        interval = max(self.config.output.interval, self.write_cost / WRITE_SHARE)
        return self._elapsed() - self.last_write > interval

    def _show_progress(self) -> None:
        elapsed = self._elapsed()
        rays = (self.film.rays + self.pending.rays) * self.world.size / max(elapsed, 1e-9)
        self.progress.update(elapsed, self.film.passes, self.film.passes, rays, self.error)

    def _reduce_and_write(self, final: bool = False) -> None:
        """Merge the sums of all ranks into a picture, and have rank 0 write it."""
        began = time.perf_counter()
        with self.watch.stage("reduce"):
            sums = self.world.reduce_sum(self.film.sums)
            counts = self.world.reduce_sum(np.array([self.film.rays, self.film.nonfinite], np.int64))
            memory = self.world.gather(_peak_memory_mb())
        if self.world.is_root:
            assert sums is not None and counts is not None and memory is not None and self.claim is not None
            picture = self._picture(sums)
            if self.film.passes > 1:
                self.error = estimated_relmse(picture.rgb, picture.variance)
            stages = dict(self.watch.stages, total=self.watch.elapsed())
            report = build_report(
                picture,
                method=self.config.method,
                biased=self.config.method in BIASED,
                ranks=self.world.size,
                passes=self.film.passes,
                spp=self.film.passes,
                seed=self.config.seed,
                nonfinite_samples=int(counts[1]),
                seconds=stages,
                rays=int(counts[0]),
                rays_per_second=float(counts[0]) / max(stages.get("tracing", 0.0), 1e-9),
                memory_mb=float(sum(memory)),
                provenance=self.provenance,
                warnings=self.forecasting.warnings,
            )
            report["forecast"] = {
                "photons": self.forecasting.photons,
                "particles": self.forecasting.emitted,
                "search_radius": self.forecasting.maps.radius if self.forecasting.photons else None,
            }
            report["memory_mb_per_rank"] = [round(m, 1) for m in memory]
            text = msgspec.json.encode(self.config).decode()
            self.watch.add(
                "write",
                write_run(self.claim.directory, picture, report, attributes_from_report(report, text)),
            )
            self.claim.discard_stale()
            if final and self.stopped_by:
                write_whole(self.claim.directory / UNFINISHED, self._mark)
        self.write_cost, self.last_write = self.world.broadcast((time.perf_counter() - began, self._elapsed()))

    def _mark(self, path: Path) -> None:
        path.write_text(f"stopped by signal {self.stopped_by} after {self.film.passes} passes\n")

    def _picture(self, sums: np.ndarray) -> Picture:
        height, width = self.size
        diffusive, caustic, variance = (a.reshape(height, width, 3) for a in resolve(sums, self.film.passes))
        features = self.features.reshape(height, width, 7)
        film = self.config.film
        return Picture(
            rgb=diffusive + caustic,
            diffusive=diffusive,
            caustic=caustic,
            variance=variance,
            albedo=features[..., :3],
            normal=features[..., 3:6],
            depth=features[..., 6],
            film_size=(film.width, film.height),
            crop=film.crop,
        )

    def finish(self) -> None:
        """The final picture; a run stopped before its first round has none."""
        if self.film.passes == 0:
            if self.world.is_root and self.claim is not None:
                write_whole(self.claim.directory / UNFINISHED, self._mark)
                self.progress.close()
            return
        self._say("writing")
        self._reduce_and_write(final=True)
        if self.world.is_root and self.claim is not None:
            self._show_progress()
            self.progress.close()
            error = "" if self.error is None else f", estimated relMSE {self.error:.2g}"
            print(
                f"{self.claim.directory}: {self.film.passes} passes in {self.watch.elapsed():.1f} s on "
                f"{self.world.size} rank{'s' if self.world.size > 1 else ''}{error}",
                flush=True,
            )


def _peak_memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
