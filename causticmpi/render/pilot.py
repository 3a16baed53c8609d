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
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast
from causticmpi.preprocess.guides import Guides
from causticmpi.preprocess.lamp_images import LampImages, find_images
from causticmpi.preprocess.lamp_sight import LampSight, lamp_sight, seen_in_passing, with_images
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
SIGHT_SIDE, MOST_SIDE = 2, 3
"""Side of the grid of looks for lamps in a pixel, without a pilot; at most with one."""
EVEN, AT_RANDOM = 3.0, 2.0
"""Powers of the side by which the error of a grid falls: looks at random, and evenly spaced ones at an edge."""
LOOK_PASSES = 4
"""Passes of looks that tell whether the eye sees a lamp at all."""


@dataclass(frozen=True)
class Plan:
    """What the pilot chose. plain: sample by the BRDF, leave the maps aside; paths_per_pixel: light paths of a pass for
    every pixel; sight_side: of the grid of looks for lamps, 0 in passing; forecast_score, plain_score: mean squared
    relative error of a pass times its rays per pixel."""

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
class LampPasses:
    """The part of lamps in sight. passes (PASSES, slots, 3): what each pass saw of them; rays: as of a Part."""

    passes: np.ndarray
    rays: float

    def errors(self, rest: np.ndarray, floor: float) -> np.ndarray:
        """Relative squared error of one pass (slots,); rest (slots, 3): radiance without lamps.

        The level of a pass is that of all others: a glint met once must not pass for a bright pixel.
        """
        others = (self.passes.sum(axis=0) - self.passes) / (PASSES - 1)
        squares = (self.passes - others) ** 2 * ((PASSES - 1) / PASSES)
        errors: np.ndarray = (squares / ((rest + others) ** 2 + floor)).mean(axis=(0, 2))
        return errors


@dataclass(frozen=True)
class LampTrial:
    """Looks for lamps, the same for both ways: a grid of SIGHT_SIDE a side, and single ones."""

    grid: LampPasses
    single: LampPasses

    def of(self, side: int, rest: np.ndarray, floor: float) -> tuple[float, float]:
        """Mean relative squared error that side x side looks leave in a pass, and their rays for a pixel; 0: a single
        one, that comes for nothing. rest (slots, 3): radiance without lamps.

        Without the worst pixel: one glint met once does not tell how often it is met.
        """
        grid, single = (
            float(np.sort(lamps.errors(rest, floor))[:-1].sum() / len(rest)) for lamps in (self.grid, self.single)
        )
        power = math.log2(single / grid) / math.log2(SIGHT_SIDE) if grid > 0 and single > 0 else AT_RANDOM
        error = grid * (SIGHT_SIDE / max(1, side)) ** min(max(power, AT_RANDOM), EVEN)
        each = (self.grid.rays - self.single.rays) / (SIGHT_SIDE**2 - 1)
        return error, self.single.rays + each * (side**2 - 1) if side else 0.0


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

    looks = _try_looks(scene, camera, sight, small.film, config.seed)

    def try_way(maps: ForecastMaps, guides: Guides, ray: float) -> Trial:
        return _try(make_method(small, scene, camera, maps, extent, guides, sight), small.film, ray)

    if not config.forecast.light_tracing:
        guides = guides._replace(paths_per_pixel=0.0)
    forecast = try_way(maps, guides, FORECAST_RAY)
    plain = try_way(no_forecast(), guides, 1.0)
    return choose(forecast, plain, looks, guides.paths_per_pixel, sight, floor)


def small_film(film: Film) -> Film:
    """Of the same shape, with PIXELS at most."""
    shrink = min(1.0, math.sqrt(PIXELS / (film.width * film.height)))
    return Film(width=max(1, int(film.width * shrink)), height=max(1, int(film.height * shrink)))


def find_lamps(data: SceneData, scene: TracedScene, film: Film, seed: int) -> tuple[LampSight, LampImages]:
    """Where the eye may see a lamp in the small picture of a film, in passing if looks at it see none; and images."""
    small = small_film(film)
    eye = camera_array(data.camera, small.width, small.height)
    sight = lamp_sight(data, eye, small.width, small.height, SIGHT_SIDE)
    images = find_images(data, scene, eye, small.width, sight.mask)
    sight = with_images(sight, images, small.width, small.height)
    if sight.knows_images:
        return sight, images
    seen = np.zeros((small.width * small.height, 6), np.float32)
    pixels, work = pixel_order(small.window, small.width), sight_work(SIGHT_SIDE)
    for index in range(FIRST_PASS, FIRST_PASS + LOOK_PASSES):
        see_lamps(scene, eye, work, sight, pixels, seed, index, seen)
    return sight if seen.any() else seen_in_passing(), images


def choose(
    forecast: Trial, plain: Trial, looks: LampTrial, paths_per_pixel: float, sight: LampSight, floor: float
) -> Plan:
    """The way of less error times cost; paths_per_pixel: what `forecast` was tried with, sight: what `looks` were, the
    best paths and side are found; floor: of the relative squared error [radiance^2]."""
    rest = (forecast.rest + plain.rest) / 2
    score, paths, best_side = _best(forecast, looks, paths_per_pixel, sight, rest, floor)
    plain_score, _, plain_side = _best(plain, looks, 0.0, sight, rest, floor)
    pays = plain_score > GAIN * score or not sees(plain, forecast)
    return Plan(not pays, paths if pays else 0.0, best_side if pays else plain_side, score, plain_score)


def _best(
    trial: Trial, looks: LampTrial, paths_per_pixel: float, sight: LampSight, rest: np.ndarray, floor: float
) -> tuple[float, float, int]:
    """Least error times cost, and what gives it: light paths for every pixel, side of the grid of looks for lamps."""
    weight = 1 / ((rest + looks.grid.passes.mean(axis=0)) ** 2 + floor)
    eye, light = trial.eye.error(weight), trial.light.error(weight)
    more = 1.0  # light paths, over those that were tried
    if light > 0 and eye > 0:
        # Where (eye + light / more) (eye rays + light rays more) is least.
        more = math.sqrt(light * trial.eye.rays / (eye * trial.light.rays))
        more = min(max(more * paths_per_pixel, FEWEST_PATHS), MOST_PATHS) / paths_per_pixel
    error, rays = eye + light / more, trial.eye.rays + trial.light.rays * more

    def score(side: int) -> float:
        """Error times cost with a grid of so many looks a side."""
        lamps, more_rays = looks.of(side, rest, floor)
        return (error + lamps) * (rays + more_rays)

    # Small images that are known have looks of their own: a grid is there to share what chance meets of them.
    fewest = 1 if sight.knows_images else 0
    best = min(range(fewest, MOST_SIDE + 1), key=score) if looks.of(1, rest, floor)[0] > 0 else fewest or sight.side
    return score(best), more * paths_per_pixel, best


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


def _try_looks(scene: TracedScene, camera: np.ndarray, sight: LampSight, film: Film, seed: int) -> LampTrial:
    """PASSES passes of looks at a film, of what is not seen in passing."""
    pixels, work = pixel_order(film.window, film.width), sight_work(SIGHT_SIDE)
    seen = np.zeros((2, PASSES, film.width * film.height, 3), np.float32)
    rays = np.zeros(2)
    for i, side in enumerate((SIGHT_SIDE, 1)):
        for index in range(0 if sight.in_passing else PASSES):
            lamps = np.zeros((film.width * film.height, 6), np.float32)
            own = sight._replace(side=side)
            rays[i] += see_lamps(scene, camera, work, own, pixels, seed, FIRST_PASS + index, lamps)
            seen[i, index] = lamps[:, :3]
    cost = rays * SIGHT_RAY / (PASSES * film.width * film.height)
    return LampTrial(*(LampPasses(passes, float(a)) for passes, a in zip(seen, cost, strict=True)))


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
