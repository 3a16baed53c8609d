"""One contender in one cell: independent batches of passes within a CPU time, without files or ranks."""

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.compare.statistics import block_means, fewest_hits
from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import PreparedScene, needs_forecast, prepare_method, share_maps, share_scene
from causticmpi.distributed.usage import peak_memory_mb
from causticmpi.distributed.warmup import warm_up
from causticmpi.distributed.world import SerialWorld
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess.forecast import ForecastMaps, build_forecast
from causticmpi.preprocess.photons import shoot_photons
from causticmpi.preprocess.view import extent_in_view, see_views
from causticmpi.render.foresight import of_scene
from causticmpi.render.methods import BIASED, BY_CHANCE, FORECASTING, Method, automatic_bound, make_method, whole_pass
from causticmpi.render.rounds import PILOT_PASS
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array
from causticmpi.stability.lies import LIES

FAR_PASS = 2**41
"""Neither a run nor its pilot gets as far: from here on the passes are others than theirs."""
BLOCKS = 4
"""Squares along a side of the film whose means are compared: few, so that rare bright paths even out in each."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What a contender did in a cell. rgb, variance (H, W, 3): mean picture and its variance, by independent batches.

    blocks (batches, k): means of squares of the film, by colour; hits: rare bright ones that make its noise, by the
    skew of the squares' means, without colour, in all passes (`fewest_hits`); caustic: mean luminance of L_c; seconds:
    CPU time of tracing, `preprocess` apart; slowest: the longest pass over the mean one; brightest: largest radiance
    of a light; radius: the search radius used (nan: none); bound: what `auto` means for b; seed: of its config;
    by_chance: whether it meets lights behind specular surfaces by chance alone; warnings: that a run would give
    beforehand; again: whether this is a second measurement, for the mean of a first one was wrong.
    """

    label: str
    biased: bool
    passes: int
    seconds: float
    preprocess: float
    rays: int
    slowest: float
    memory_mb: float
    nonfinite: int
    rgb: np.ndarray
    variance: np.ndarray
    blocks: np.ndarray
    hits: float
    caustic: float
    brightest: float
    radius: float
    bound: float
    seed: int
    by_chance: bool = False
    warnings: tuple[str, ...] = ()
    again: bool = False

    @property
    def pass_seconds(self) -> float:
        """CPU seconds of a pass."""
        return self.seconds / self.passes

    @property
    def samples(self) -> int:
        """Eye paths traced."""
        return self.passes * self.rgb.shape[0] * self.rgb.shape[1]


@dataclass
class Bench:
    """A scene in this process and one method with its forecast, ready for passes.

    extent: of what the eye sees [scene units]; preprocess: CPU seconds that the forecast took; pixels (n, 4): the
    film's, as by `pixel_order`.
    """

    scene: PreparedScene
    config: RenderConfig
    method: Method
    maps: ForecastMaps
    extent: float
    preprocess: float
    pixels: np.ndarray

    def add_pass(self, index: int, film: np.ndarray) -> int:
        """One pass added to `film` (slots, 6), L_d and L_c in RGB; returns the rays traced."""
        return whole_pass(self.method, index, self.pixels, film)

    def close(self) -> None:
        """Free Embree's tree."""
        self.scene.embree.close()


def config_for(side: int, seed: int, settings: Mapping[str, Any]) -> RenderConfig:
    """A render config from dotted keys. Raises msgspec.ValidationError for a value that is not allowed."""
    plain: dict[str, Any] = {"scene": "", "film": {"width": side, "height": side}, "seed": seed}
    for key, value in settings.items():
        *sections, last = key.split(".")
        at = plain
        for section in sections:
            at = at.setdefault(section, {})
        at[last] = value
    return msgspec.convert(plain, RenderConfig)


def set_up(scene_file: Path, config: RenderConfig, lie: str = "none") -> Bench:
    """Load, shoot, cluster. lie: of the forecast's photons, a key of `LIES`. Raises InputError for a refused scene."""
    world = SerialWorld()
    data = load_scene(scene_file)
    _compile(config, needs_forecast(config, data))
    scene = share_scene(world, data)
    began = time.process_time()
    film = config.film
    camera = camera_array(data.camera, film.width, film.height)
    if lie == "none":
        method, made = prepare_method(world, config, scene, camera, Stopwatch(from_now=True))
        maps, extent = made.maps, made.extent
    else:
        views = see_views(scene.traced, camera, film.width, film.height, config.seed)
        extent = extent_in_view(views) or scene.extent
        maps = share_maps(world, _lying_maps(config, data, lie))
        method = make_method(config, scene.traced, camera, maps, extent)
    preprocess = time.process_time() - began
    pixels = pixel_order(film.window, film.width)
    return Bench(scene, config, method, maps, extent, preprocess, pixels)


_COMPILED: set[tuple[str, str, bool]] = set()
"""Kinds of method whose kernels this process has loaded."""


def _compile(config: RenderConfig, forecasting: bool) -> None:
    """Load or compile a method's kernels once per process: no cell pays for it. forecasting: whether it has maps."""
    kind = (config.method, config.forecast.sampling, forecasting)
    if kind not in _COMPILED:
        _COMPILED.add(kind)
        warm_up(config, True, forecasting)


def _lying_maps(config: RenderConfig, data: SceneData, lie: str) -> ForecastMaps:
    shot_in = share_scene(SerialWorld(), _lights_moved(data) if lie == "wrong light" else data)
    points, _, _ = shoot_photons(shot_in.traced, config.seed, config.forecast.photons)
    shot_in.embree.close()
    f = config.forecast
    points = LIES[lie](points, np.random.default_rng(7))
    settings = (f.clusters, f.neighbours, f.table, f.max_rank, f.splitting)
    return build_forecast(points, config.seed, *settings, sampling=f.sampling)[0]


def _lights_moved(data: SceneData) -> SceneData:
    """All emitting triangles a third of the scene aside."""
    vertices = data.vertices.copy()
    emitting = np.unique(data.triangles[data.primitive_emission[: len(data.triangles)] >= 0])
    vertices[emitting, 0] += np.float32(np.ptp(vertices[:, 0]) / 3)
    return dataclasses.replace(data, vertices=vertices)


def _without_photons(config: RenderConfig) -> bool:
    return config.method in FORECASTING and config.forecast.photons == 0


def passes_within(bench: Bench, seconds: float) -> float:
    """How many passes, not rounded, take about `seconds` of CPU time.

    By a pilot whose samples are thrown away: what the picture costs has no say in what it shows. Of two passes at
    least: the first of a process may load kernels that the warm-up did not.
    """
    one = np.zeros((len(bench.pixels), 6), np.float32)
    costs: list[float] = []
    for i in range(3):
        began = time.process_time()
        bench.add_pass(PILOT_PASS + i, one)
        costs.append(time.process_time() - began)
        if i > 0 and sum(costs) > seconds / 4:
            break
    return seconds / max(min(costs), 1e-6)


@dataclass
class _Tally:
    """What passes cost. rays: traced; nonfinite: samples; seconds, slowest: CPU time of all, of the longest."""

    rays: int = 0
    nonfinite: int = 0
    seconds: float = 0.0
    slowest: float = 0.0


def _trace(bench: Bench, index: int, film: np.ndarray, tally: _Tally) -> None:
    """One pass alone in `film` (slots, 6), 0 where it is not finite."""
    film[:] = 0
    began = time.process_time()
    tally.rays += bench.add_pass(index, film)
    seconds = time.process_time() - began
    tally.seconds, tally.slowest = tally.seconds + seconds, max(tally.slowest, seconds)
    bad = ~np.isfinite(film).all(axis=1)
    tally.nonfinite += int(bad.sum())
    film[bad] = 0


def measure(bench: Bench, label: str, passes: int, batches: int, first_pass: int = 0) -> Measured:
    """Independent batches of `passes` passes each."""
    shape = (bench.config.film.height, bench.config.film.width)
    side = max(1, shape[0] // BLOCKS)
    film = np.zeros((shape[0] * shape[1], 6), np.float32)
    means = np.zeros((batches, *shape, 3))
    squares = []  # by pass: a few batches are too few values to show a skew
    caustic, tally = 0.0, _Tally()
    for b in range(batches):
        total = np.zeros(film.shape)
        for i in range(passes):
            _trace(bench, first_pass + b * passes + i, film, tally)
            total += film
            squares.append(block_means(film.sum(axis=1, dtype=np.float64).reshape(*shape, 1), side))
        total /= passes
        means[b] = (total[:, :3] + total[:, 3:]).reshape(*shape, 3)
        caustic += float(total[:, 3:].mean()) / batches
    return Measured(
        label=label,
        biased=bench.config.method in BIASED,
        passes=batches * passes,
        seconds=tally.seconds,
        preprocess=bench.preprocess,
        rays=tally.rays,
        slowest=tally.slowest * batches * passes / max(tally.seconds, 1e-9),
        memory_mb=peak_memory_mb(),
        nonfinite=tally.nonfinite,
        rgb=means.mean(axis=0),
        variance=means.var(axis=0, ddof=1) / batches,
        blocks=np.array([block_means(mean, side) for mean in means]),
        hits=fewest_hits(np.array(squares)),
        caustic=caustic,
        brightest=bench.scene.brightest,
        radius=float(getattr(bench.maps, "radius", float("nan"))),
        bound=automatic_bound(bench.extent),
        seed=bench.config.seed,
        by_chance=bench.config.method in BY_CHANCE or _without_photons(bench.config),
        warnings=of_scene(bench.config, bench.scene.data),
    )
