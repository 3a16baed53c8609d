"""Does the forecast pay here? A few passes of a small picture tell, before the first pass of the large one.

It decides how many light paths there are for each pixel, how often the eye looks for lamps, and whether to sample
caustics by the forecast or plainly by the BRDF. Either is unbiased, and no sample of the pilot enters the picture, so
the choice costs and saves time alone. Costs are counted in rays, never by the clock: any machine makes the same choice.

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
from causticmpi.preprocess.lamp_sight import lamp_sight
from causticmpi.render.methods import FORECASTING, Method, VirtualLighting, make_method
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

PIXELS = 8192
"""Of the small picture, at most."""
PASSES = 16
FIRST_PASS = 2**40
"""No picture gets as far: the passes of a pilot are others than those of the run."""
FORECAST_RAY, LIGHT_RAY, SIGHT_RAY = 1.4, 2.6, 3.0
"""CPU time of a ray with its share of the forecast, of one of light tracing with its splats, and of one that looks for
lamps, over that of a ray sampled plainly: 1.1 to 1.7, 1.3 to 3 and 1.8 to 5 on cornell, ring, pool and figurines."""
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
SIGHT_SIDE, MOST_SIDE = 2, 6
"""Side of the grid of looks for lamps in a pixel, without a pilot; at most with one."""


@dataclass(frozen=True)
class Plan:
    """What the pilot chose. plain: sample by the BRDF, leave the maps aside; paths_per_pixel: light paths of a pass for
    every pixel; sight_side: of the grid of looks for lamps; forecast_score, plain_score: mean squared relative error
    of a pass times its rays per pixel."""

    plain: bool
    paths_per_pixel: float
    sight_side: int
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
class Part:
    """One part of the light of a pass. total, squares (slots, 3): sums over passes; rays: of a pass for a pixel,
    weighted by their cost."""

    total: np.ndarray
    squares: np.ndarray
    rays: float

    def error(self, weight: np.ndarray) -> float:
        """Mean relative squared error of one pass; weight (slots, 3): one over the squared level."""
        variance = np.maximum(self.squares - self.total * self.total / PASSES, 0) / (PASSES - 1)
        return float((variance * weight).mean())


@dataclass(frozen=True)
class Trial:
    """What the passes of one way gave: by vertices that eye paths find, by splats of light paths, by lamps in sight;
    caustic, caustic_squares (blocks,): sums of L_c."""

    eye: Part
    light: Part
    lamps: Part
    caustic: np.ndarray
    caustic_squares: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        return (self.eye.total + self.light.total + self.lamps.total) / PASSES


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

    sight = lamp_sight(data, camera, small.film.width, small.film.height, SIGHT_SIDE)

    def try_way(maps: ForecastMaps, guides: Guides, ray: float) -> Trial:
        return _try(make_method(small, scene, camera, maps, extent, guides, sight), small.film, ray)

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
    score, paths, looks = _best(forecast, paths_per_pixel, weight)
    plain_score, _, plain_looks = _best(plain, 0.0, weight)
    pays = plain_score > GAIN * score or not sees(plain, forecast)
    side = round(math.sqrt(looks if pays else plain_looks))
    return Plan(not pays, paths if pays else 0.0, side, score, plain_score)


def _best(trial: Trial, paths_per_pixel: float, weight: np.ndarray) -> tuple[float, float, float]:
    """Least error times cost, the light paths for every pixel and the looks for lamps that give it."""
    eye = trial.eye.error(weight)
    error, rays = eye, trial.eye.rays
    numbers = []
    for part, tried, least, most in (
        (trial.light, paths_per_pixel, FEWEST_PATHS, MOST_PATHS),
        (trial.lamps, float(SIGHT_SIDE**2), 1.0, float(MOST_SIDE**2)),
    ):
        own, more = part.error(weight), 1.0
        if own > 0 and eye > 0:
            # Least (eye + own / more) (eye rays + own rays more); so for each part, whatever the other does.
            more = math.sqrt(own * trial.eye.rays / (eye * part.rays))
            more = min(max(more * tried, least), most) / tried
        error += own / more
        rays += part.rays * more
        numbers.append(tried * more)
    return error * rays, numbers[0], numbers[1]


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


def _try(method: Method, film: Film, ray: float) -> Trial:
    assert isinstance(method, VirtualLighting)
    width, height = film.width, film.height
    pixels = pixel_order((0, 0, width, height), width)
    blocks = [np.arange(0, side, BLOCK) for side in (height, width)]
    samples, lamps = np.zeros((2, width * height, 6), np.float32)
    splats = np.zeros((width * height, 3), np.float32)
    sums = np.zeros((3, 2, width * height, 3))
    caustics = np.zeros((2, len(blocks[0]), len(blocks[1])))
    rays = np.zeros(3)
    for index in range(FIRST_PASS, FIRST_PASS + PASSES):
        samples[:] = lamps[:] = splats[:] = 0
        method.begin_pass(index)  # its rays are the same for a picture of any size
        rays[0] += method.trace_vertices(pixels, samples)
        if method.light_paths:
            rays[1] += method.trace_light(index, 0, method.light_paths, splats)
        rays[2] += method.see_lamps(pixels, lamps)
        parts = np.array([samples[:, :3].astype(np.float64) + samples[:, 3:], splats, lamps[:, :3]])
        sums[:, 0] += parts
        sums[:, 1] += parts * parts
        lit = (samples[:, 3:] + splats).astype(np.float64).sum(axis=1).reshape(height, width)
        lit = np.add.reduceat(np.add.reduceat(lit, blocks[0], axis=0), blocks[1], axis=1)
        caustics[0] += lit
        caustics[1] += lit * lit
    cost = rays * (ray, LIGHT_RAY, SIGHT_RAY) / (PASSES * width * height)
    eye, light, seen = (Part(*both, one) for both, one in zip(sums, cost, strict=True))
    return Trial(eye, light, seen, caustics[0], caustics[1])
