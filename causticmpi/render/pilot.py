"""Does the forecast pay here? A few passes of a small picture tell, before the first pass of the large one.

It decides how many light paths there are for each pixel, and whether to sample caustics by the forecast or plainly by
the BRDF. Either is unbiased, and no sample of the pilot enters the picture, so the choice costs and saves time alone.
Costs are counted in rays, never by the clock: any machine makes the same choice.

A way that never met a small light has no variance to show. Plain sampling is therefore believed only where it sees what
the forecast sees, in every block of the picture.
"""

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from causticmpi.config.records import Film, RenderConfig
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast
from causticmpi.preprocess.guides import Guides
from causticmpi.render.methods import FORECASTING, Method, make_method
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

PIXELS = 8192
"""Of the small picture, at most."""
PASSES = 16
FIRST_PASS = 2**40
"""No picture gets as far: the passes of a pilot are others than those of the run."""
FORECAST_RAY, LIGHT_RAY = 1.4, 2.6
"""CPU time of a ray with its share of the forecast, and of one of light tracing with its splats, over that of a ray
sampled plainly: 1.1 to 1.7 and 1.3 to 3 on cornell, ring, pool and figurines."""
GAIN = 0.8
"""Plain sampling must promise no more than this part of the forecast's error times cost: its estimate is the one that
tends to be too low."""
BLOCK = 8
"""Side of a block [pixels of the small picture]."""
BLIND = 4.0
"""Standard errors by which a block of caustics may be darker than the forecast's."""
KNOWN = 0.1
"""Relative standard error up to which the caustics of the whole picture count as seen."""
FEWEST_PATHS, MOST_PATHS = 1 / 16, 16.0
"""Light paths for every pixel and pass."""


@dataclass(frozen=True)
class Plan:
    """What the pilot chose. plain: sample by the BRDF, leave the maps aside; paths_per_pixel: light paths of a pass for
    every pixel; forecast_score, plain_score: mean squared relative error of a pass times its rays per pixel."""

    plain: bool
    paths_per_pixel: float
    forecast_score: float
    plain_score: float

    @property
    def words(self) -> str:
        if self.plain:
            return "by the BRDF: the forecast does not pay here"
        if self.paths_per_pixel:
            return f"by the forecast, with {self.paths_per_pixel:.2g} light paths a pixel"
        return "by the forecast"


@dataclass(frozen=True)
class Trial:
    """Sums over the passes of one way. eye, light: sums (slots, 3) and sums of squares of what eye paths and splats
    add; caustic, caustic_squares (blocks,): of L_c; eye_rays, light_rays: per pass, weighted."""

    eye: np.ndarray
    eye_squares: np.ndarray
    light: np.ndarray
    light_squares: np.ndarray
    caustic: np.ndarray
    caustic_squares: np.ndarray
    eye_rays: float
    light_rays: float

    @property
    def mean(self) -> np.ndarray:
        return (self.eye + self.light) / PASSES


def needs_pilot(config: RenderConfig, maps: ForecastMaps) -> bool:
    """Whether there is anything to choose."""
    settings = config.forecast
    return (
        config.method in FORECASTING
        and settings.sampling == "mixture"
        and settings.pilot
        and maps.codebook.shape[1] > 0
    )


def run_pilot(
    config: RenderConfig,
    data: SceneData,
    scene: TracedScene,
    maps: ForecastMaps,
    extent: float,
    guides: Guides,
    floor: float,
) -> Plan:
    """Try both ways on the same small picture, of the film's shape, not of its crop's. floor: of the relative error."""
    small = msgspec.structs.replace(config, film=small_film(config.film))
    camera = camera_array(data.camera, small.film.width, small.film.height)

    def try_way(maps: ForecastMaps, guides: Guides, ray: float) -> Trial:
        return _try(make_method(small, scene, camera, maps, extent, guides), small.film, ray)

    if not config.forecast.light_tracing:
        guides = guides._replace(paths_per_pixel=0.0)
    forecast = try_way(maps, guides, FORECAST_RAY)
    return choose(forecast, try_way(no_forecast(), guides, 1.0), guides.paths_per_pixel, floor)


def small_film(film: Film) -> Film:
    """Of the same shape, with PIXELS at most."""
    shrink = min(1.0, math.sqrt(PIXELS / (film.width * film.height)))
    return Film(width=max(1, int(film.width * shrink)), height=max(1, int(film.height * shrink)))


def choose(forecast: Trial, plain: Trial, paths_per_pixel: float, floor: float) -> Plan:
    """The way of less error times cost; paths_per_pixel: what `forecast` was tried with, the best number is found;
    floor: of the relative squared error [radiance^2]."""
    level = (forecast.mean + plain.mean) / 2
    weight = 1 / (level * level + floor)
    eye = _error(forecast.eye, forecast.eye_squares, weight)
    light = _error(forecast.light, forecast.light_squares, weight)
    more = 1.0
    if light > 0 and eye > 0:
        # Least (eye + light / more) (eye rays + light rays more).
        more = math.sqrt(light * forecast.eye_rays / (eye * forecast.light_rays))
        more = min(max(more * paths_per_pixel, FEWEST_PATHS), MOST_PATHS) / paths_per_pixel
    score = (eye + light / more) * (forecast.eye_rays + forecast.light_rays * more)
    plain_score = _error(plain.eye, plain.eye_squares, weight) * plain.eye_rays
    pays = plain_score > GAIN * score or not sees(plain, forecast)
    return Plan(not pays, more * paths_per_pixel if pays else 0.0, score, plain_score)


def sees(plain: Trial, other: Trial) -> bool:
    """Whether plain sampling met the caustics that the other way met, as a whole and in every block."""
    mine, mine_error = _mean_and_error(plain.caustic, plain.caustic_squares)
    theirs, their_error = _mean_and_error(other.caustic, other.caustic_squares)
    whole, error = mine.sum(), math.sqrt((mine_error**2).sum())
    dark = theirs - mine > BLIND * np.sqrt(mine_error**2 + their_error**2) + 1e-6 * theirs.mean()
    return bool(error <= KNOWN * whole and not dark.any())


def _mean_and_error(total: np.ndarray, squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mean = total / PASSES
    return mean, np.sqrt(np.maximum(squares / PASSES - mean * mean, 0) / (PASSES - 1))


def _error(total: np.ndarray, squares: np.ndarray, weight: np.ndarray) -> float:
    """Mean relative squared error of one pass."""
    variance = np.maximum(squares - total * total / PASSES, 0) / (PASSES - 1)
    return float((variance * weight).mean())


def _try(method: Method, film: Film, ray: float) -> Trial:
    width, height = film.width, film.height
    pixels = pixel_order((0, 0, width, height), width)
    blocks = [np.arange(0, side, BLOCK) for side in (height, width)]
    samples = np.zeros((width * height, 6), np.float32)
    splats = np.zeros((width * height, 3), np.float32)
    sums = [np.zeros((width * height, 3)) for _ in range(4)]
    caustics = np.zeros((2, len(blocks[0]), len(blocks[1])))
    eye_rays = light_rays = 0
    for index in range(FIRST_PASS, FIRST_PASS + PASSES):
        samples[:] = splats[:] = 0
        method.begin_pass(index)  # its rays are the same for a picture of any size
        eye_rays += method.trace(pixels, samples)
        if method.light_paths:
            light_rays += method.trace_light(index, 0, method.light_paths, splats)
        eye, light = samples[:, :3].astype(np.float64) + samples[:, 3:], splats.astype(np.float64)
        for total, value in zip(sums, (eye, eye * eye, light, light * light), strict=True):
            total += value
        lit = (samples[:, 3:] + splats).astype(np.float64).sum(axis=1).reshape(height, width)
        lit = np.add.reduceat(np.add.reduceat(lit, blocks[0], axis=0), blocks[1], axis=1)
        caustics[0] += lit
        caustics[1] += lit * lit
    pixel_passes = PASSES * width * height
    rays = ray * eye_rays / pixel_passes, LIGHT_RAY * light_rays / pixel_passes
    return Trial(sums[0], sums[1], sums[2], sums[3], caustics[0], caustics[1], *rays)
