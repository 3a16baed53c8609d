"""Does the forecast pay here? A few passes of a small picture tell, before the first pass of the large one.

It decides how many light paths there are for each pixel, how often the eye looks for lamps, and whether to sample
caustics by the forecast or plainly by the BRDF. Either is unbiased, and no sample of the pilot enters the picture, so
the choice costs and saves time alone. Costs are counted in rays, never by the clock: any machine makes the same choice.

A way that never met a small light has no variance to show. Plain sampling is therefore believed only where it sees what
the forecast sees, in every block of the picture.
"""

import math
from dataclasses import dataclass, field

import msgspec
import numpy as np

from causticmpi.config.records import Film, RenderConfig
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast
from causticmpi.preprocess.guides import Guides
from causticmpi.preprocess.lamp_images import LampImages, find_images
from causticmpi.preprocess.lamp_sight import LampSight, lamp_sight, seen_in_passing, with_images
from causticmpi.render.looks import FIRST_PASS, PASSES, SIGHT_SIDE, LampTrial, LookNeeds, try_looks
from causticmpi.render.methods import FORECASTING, Method, VirtualLighting, make_method
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

PIXELS = 8192
"""Of the small picture, at most."""
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
LOOK_PASSES = 4
"""Passes of looks that tell whether the eye sees a lamp at all."""


@dataclass(frozen=True)
class Plan:
    """What the pilot chose. plain: sample by the BRDF, leave the maps aside; paths_per_pixel: light paths of a pass for
    every pixel; sides (pixels of the small picture,) uint8: of grids of looks for lamps, see LampSight; forecast_score,
    plain_score: mean squared relative error of a pass times its rays per pixel."""

    plain: bool
    paths_per_pixel: float
    sides: np.ndarray = field(compare=False)
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
    """What the passes of one way gave: by vertices that eye paths find, by splats of light paths; caustic,
    caustic_squares (blocks,): sums of L_c."""

    eye: Part
    light: Part
    caustic: np.ndarray
    caustic_squares: np.ndarray

    @property
    def rest(self) -> np.ndarray:
        """Mean radiance without the lamps."""
        return (self.eye.total + self.light.total) / PASSES


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
    sight: LampSight,
    floor: float,
) -> Plan:
    """Try both ways on the same small picture, of the film's shape, not of its crop's.

    extent: diagonal of the scene [scene units]; sight: by `find_lamps`; floor: of the relative squared error
    [radiance^2].
    """
    small = msgspec.structs.replace(config, film=small_film(config.film))
    camera = camera_array(data.camera, small.film.width, small.film.height)

    looks = try_looks(data, scene, camera, sight, small.film, config.seed)

    def try_way(maps: ForecastMaps, guides: Guides, ray: float) -> Trial:
        return _try(make_method(small, scene, camera, maps, extent, guides, sight), small.film, ray)

    if not config.forecast.light_tracing:
        guides = guides._replace(paths_per_pixel=0.0)
    forecast = try_way(maps, guides, FORECAST_RAY)
    plain = try_way(no_forecast(), guides, 1.0)
    return choose(forecast, plain, looks, guides.paths_per_pixel, floor)


def small_film(film: Film) -> Film:
    """Of the same shape, with PIXELS at most."""
    shrink = min(1.0, math.sqrt(PIXELS / (film.width * film.height)))
    return Film(width=max(1, int(film.width * shrink)), height=max(1, int(film.height * shrink)))


def find_lamps(data: SceneData, scene: TracedScene, film: Film, seed: int) -> tuple[LampSight, LampImages]:
    """Where the eye may see a lamp in the small picture of a film, in passing if looks at it see none; and images."""
    small = small_film(film)
    eye = camera_array(data.camera, small.width, small.height)
    sight = lamp_sight(data, eye, small.width, small.height, SIGHT_SIDE)
    images = find_images(data, scene, eye, small.width, sight.sides > 0)
    sight = with_images(sight, images, small.width, small.height)
    if sight.knows_images:
        return sight, images
    seen = np.zeros((small.width * small.height, 6), np.float32)
    pixels, work = pixel_order(small.window, small.width), sight_work(SIGHT_SIDE)
    for index in range(FIRST_PASS, FIRST_PASS + LOOK_PASSES):
        see_lamps(scene, eye, work, sight, pixels, seed, index, seen)
    return sight if seen.any() else seen_in_passing(), images


def choose(forecast: Trial, plain: Trial, looks: LampTrial, paths_per_pixel: float, floor: float) -> Plan:
    """The way of less error times cost; paths_per_pixel: what `forecast` was tried with, the best paths and looks are
    found; floor: of the relative squared error [radiance^2]."""
    rest = (forecast.rest + plain.rest) / 2
    weight, needs = 1 / ((rest + looks.level) ** 2 + floor), looks.needs(rest, floor)
    score, paths, best_sides = _best(forecast, needs, paths_per_pixel, weight)
    plain_score, _, plain_sides = _best(plain, needs, 0.0, weight)
    pays = plain_score > GAIN * score or not sees(plain, forecast)
    return Plan(not pays, paths if pays else 0.0, best_sides if pays else plain_sides, score, plain_score)


def _best(
    trial: Trial, needs: LookNeeds, paths_per_pixel: float, weight: np.ndarray
) -> tuple[float, float, np.ndarray]:
    """Least error times cost, and what gives it: light paths for every pixel, sides of grids of looks for lamps.
    weight: see `Part.error`."""
    eye, light = trial.eye.error(weight), trial.light.error(weight)
    more = 1.0  # light paths, over those that were tried
    if light > 0 and eye > 0:
        # Where (eye + light / more) (eye rays + light rays more) is least.
        more = math.sqrt(light * trial.eye.rays / (eye * trial.light.rays))
        more = min(max(more * paths_per_pixel, FEWEST_PATHS), MOST_PATHS) / paths_per_pixel
    error, rays = eye + light / more, trial.eye.rays + trial.light.rays * more
    score, sides = needs.best(error, rays)
    return score, more * paths_per_pixel, sides


def sees(plain: Trial, other: Trial) -> bool:
    """Whether plain sampling met the caustics that the other way met, as a whole and in every block."""
    mine, mine_error = _mean_and_error(plain.caustic, plain.caustic_squares)
    theirs, their_error = _mean_and_error(other.caustic, other.caustic_squares)
    whole, error = mine.sum(), math.sqrt((mine_error**2).sum())
    dark = theirs - mine > BLIND * np.sqrt(mine_error**2 + their_error**2) + 1e-6 * theirs.mean()
    return bool(error <= KNOWN * whole and not dark.any())


def _mean_and_error(total: np.ndarray, squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of a pass and its standard error, from sums over passes."""
    mean = total / PASSES
    return mean, np.sqrt(np.maximum(squares / PASSES - mean * mean, 0) / (PASSES - 1))


def _try(method: Method, film: Film, ray: float) -> Trial:
    """PASSES passes of a film. ray: cost of a ray of an eye path, over that of one sampled plainly."""
    assert isinstance(method, VirtualLighting)
    width, height = film.width, film.height
    pixels = pixel_order(film.window, width)
    blocks = [np.arange(0, side, BLOCK) for side in (height, width)]
    samples = np.zeros((width * height, 6), np.float32)
    splats = np.zeros((width * height, 3), np.float32)
    sums = np.zeros((2, 2, width * height, 3))
    caustics = np.zeros((2, len(blocks[0]), len(blocks[1])))
    rays = np.zeros(2)
    for index in range(FIRST_PASS, FIRST_PASS + PASSES):
        samples[:] = splats[:] = 0
        method.begin_pass(index)  # its rays are the same for a picture of any size
        rays[0] += method.trace_vertices(pixels, samples)
        if method.light_paths:
            rays[1] += method.trace_light(index, 0, method.light_paths, splats)
        parts = np.array([samples[:, :3].astype(np.float64) + samples[:, 3:], splats])
        sums[:, 0] += parts
        sums[:, 1] += parts * parts
        caustic = (samples[:, 3:] + splats).astype(np.float64).sum(axis=1).reshape(height, width)
        lit = np.add.reduceat(np.add.reduceat(caustic, blocks[0], axis=0), blocks[1], axis=1)
        caustics[0] += lit
        caustics[1] += lit * lit
    cost = rays * (ray, LIGHT_RAY) / (PASSES * width * height)
    eye, light = (Part(sums[i, 0], sums[i, 1], float(cost[i])) for i in range(2))
    return Trial(eye, light, caustics[0], caustics[1])
