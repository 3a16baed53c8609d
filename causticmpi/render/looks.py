"""How many looks for lamps are worth their cost, and at which pixels.

Where looks of a pilot often met a lamp their own variance tells. Glints are met too seldom for that, each outshines its
pixel, and a few pixels hold most of their noise: there single looks at lamps many times as wide tell where real ones
might meet them, and that more come than were met. Nothing of this enters a picture; it costs and saves time alone.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter

from causticmpi.config.records import Film
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.kernels.pixels import pixel_order
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.lamp_sight import LARGER, MOST_SIDE, LampSight, at_most, with_larger_lamps
from causticmpi.scene.data import SceneData

PASSES = 16
LARGER_PASSES = 32
FIRST_PASS = 2**40
"""No picture gets as far: the passes of a pilot are others than those of the run."""
SIGHT_SIDE = 2
"""Side of the grid of looks for lamps in a pixel, without a pilot and in its trial."""
SIGHT_RAY = 3.0
"""CPU time of a ray that looks for lamps, over that of a ray sampled plainly: 1.8 to 5 on cornell, ring, pool and
figurines."""
OFTEN, MOSTLY = 4, 12
"""Passes of the trial that met a lamp in a pixel, from which on its error is known, and how it falls with the side."""
EVEN, AT_RANDOM = 3.0, 2.0
"""Powers of the side by which the error of a grid falls: evenly spaced looks at an edge, and looks at random."""
SURE = 2.0
"""Standard errors by which the noise of glints may be less than LARGER lamps tell."""
AMOUNTS = np.geomspace(0.25, 256, 21)
"""Looks at a pixel of mean error: what is tried."""
MOST_LOOKS = 6
"""At a pixel that may show a lamp, on average: what a pilot makes of glints met once or twice is mostly too much."""


@dataclass(frozen=True)
class LampPasses:
    """What passes of looks saw: mean, variance (slots, 3) of one pass; met (slots,): how many of PASSES met a lamp;
    rays: of a pass for a pixel of the film, weighted by their cost."""

    mean: np.ndarray
    variance: np.ndarray
    met: np.ndarray
    rays: float


@dataclass(frozen=True)
class LookNeeds:
    """What grids of looks leave and cost. errors (slots,): relative squared error of a pass by grids of SIGHT_SIDE;
    powers (slots,): of the side by which it falls; least (slots,) uint8: side that a pixel has at least; each: rays of
    one look for a pixel of the film, weighted by their cost; images: of all looks at images; most: looks in all."""

    errors: np.ndarray
    powers: np.ndarray
    least: np.ndarray
    each: float
    images: float
    most: int

    def error(self, sides: np.ndarray) -> float:
        """Mean relative squared error of a pass with these sides (slots,)."""
        return float((self.errors * (SIGHT_SIDE / np.maximum(sides, 1)) ** self.powers).mean())

    def rays(self, sides: np.ndarray) -> float:
        """Rays of a pass for a pixel of the film; a side of 0 comes for nothing, by the path that is traced anyway."""
        return float(self.images + self.each * np.square(sides, dtype=np.float64).sum())

    def sides(self, amount: float) -> np.ndarray:
        """Sides (slots,) uint8 of least error at a price: that at which a pixel of mean error gets so many looks."""
        side = np.arange(MOST_SIDE + 1)[:, None]
        price = self.errors.mean() * (SIGHT_SIDE / amount) ** 2
        cost = self.errors * (SIGHT_SIDE / np.maximum(side, 1)) ** self.powers + price * side**2
        return np.maximum(cost.argmin(axis=0), self.least).astype(np.uint8)

    def best(self, error: float, rays: float) -> tuple[float, np.ndarray]:
        """Least error times cost of a pass that has so much of both without looks, and the sides (slots,) for it."""
        made = [self.sides(amount) for amount in AMOUNTS] if self.errors.any() else []
        made = [self.least, *(sides for sides in made if np.square(sides, dtype=np.int64).sum() <= self.most)]
        scores = [(error + self.error(sides)) * (rays + self.rays(sides)) for sides in made]
        best = int(np.argmin(scores))
        return scores[best], made[best]


@dataclass(frozen=True)
class LampTrial:
    """Looks of a pilot: grids of SIGHT_SIDE a side, single ones, and single ones at LARGER lamps.

    shape: height and width of the film; seen, least (slots,): whether there were looks, sides wanted at least.
    """

    shape: tuple[int, int]
    grid: LampPasses
    single: LampPasses
    larger: LampPasses
    seen: np.ndarray
    least: np.ndarray

    @cached_property
    def often(self) -> np.ndarray:
        """Where enough passes met a lamp (slots,)."""
        often: np.ndarray = self.grid.met >= OFTEN
        return often

    @cached_property
    def level(self) -> np.ndarray:
        """Radiance of the lamps (slots, 3): what was seen, where that is little evened out as LARGER ones tell."""
        level: np.ndarray = np.where(self.often[:, None], self.grid.mean, self._shared(self.grid.mean, self._blurred))
        return level

    @cached_property
    def _blurred(self) -> np.ndarray:
        """Radiance of LARGER lamps (slots, 3), each pixel with its neighbours."""
        blurred = uniform_filter(self.larger.mean.reshape(*self.shape, 3), (3, 3, 1), mode="nearest").reshape(-1, 3)
        made: np.ndarray = np.maximum(blurred, 0) * self.seen[:, None]
        return made

    def _shared(self, whole: np.ndarray, shares: np.ndarray, least: float = 0.0) -> np.ndarray:
        """`shares` times what makes it sum up to `whole` where lamps were seldom met, or to `least` where that is
        more, and nowhere more than there at most; `whole` itself where nothing has a share."""
        seldom = ~self.often
        if not shares[seldom].any():
            return (whole.T * seldom).T
        made = shares * (max(whole[seldom].sum(), least) / shares[seldom].sum())
        return np.minimum(made, made[seldom].max())

    def _surely(self, level2: np.ndarray) -> float:
        """Sum of relative squared errors of grids of SIGHT_SIDE where lamps were seldom met, at least: as LARGER ones
        tell, less SURE standard errors, since single pixels may account for most of it; in part where real lamps were
        met less often than LARGER ones promise, for something may hide them."""
        seldom, wider = ~self.often, LARGER**2
        errors = (self.larger.variance / level2).mean(axis=1)[seldom] / (wider * SIGHT_SIDE**2)
        least = errors.sum() - SURE * math.sqrt(np.square(errors).sum())
        promised = self.larger.met[seldom].sum() / (LARGER_PASSES * wider) * PASSES * SIGHT_SIDE**2
        met = self.grid.met[seldom].sum() + OFTEN  # benefit of the doubt for those that were to be met a few times
        return float(least * min(1.0, met / max(1.0, promised)))

    def needs(self, rest: np.ndarray, floor: float) -> LookNeeds:
        """rest (slots, 3): radiance without lamps; floor: of the relative squared error [radiance^2]."""
        level2 = (rest + self.level) ** 2 + floor
        grid, single = ((lamps.variance / level2).mean(axis=1) for lamps in (self.grid, self.single))
        # The root tells better how pixels compare than the mean does, or its square: few hits rule it less.
        foretold = self._shared(grid, np.sqrt((self._blurred / np.sqrt(level2)).mean(axis=1)), self._surely(level2))
        mostly = self.grid.met >= MOSTLY
        known, known_single = grid[mostly].sum(), single[mostly].sum()
        power = math.log2(known_single / known) / math.log2(SIGHT_SIDE) if known > 0 and known_single > 0 else AT_RANDOM
        looks = max(1, int(self.seen.sum()))
        each = (self.grid.rays - self.single.rays) / ((SIGHT_SIDE**2 - 1) * looks)
        return LookNeeds(
            np.maximum(np.where(self.often, grid, 0), foretold),
            np.where(mostly, min(max(power, AT_RANDOM), EVEN), AT_RANDOM),
            self.least,
            each,
            max(0.0, self.single.rays - each * looks),
            MOST_LOOKS * looks,
        )


def try_looks(
    data: SceneData, scene: TracedScene, camera: np.ndarray, sight: LampSight, film: Film, seed: int
) -> LampTrial:
    """Look for lamps on a film by a `sight` of SIGHT_SIDE; none are found where lamps are seen in passing."""
    slots = film.width * film.height
    pixels, work = pixel_order(film.window, film.width), sight_work(SIGHT_SIDE)

    def look(sight: LampSight, passes: int) -> LampPasses:
        sums, met, rays = np.zeros((2, slots, 3)), np.zeros(slots, np.int64), 0
        for index in range(passes if sight.most else 0):
            lamps = np.zeros((slots, 6), np.float32)
            rays += see_lamps(scene, camera, work, sight, pixels, seed, FIRST_PASS + index, lamps)
            seen = lamps[:, :3].astype(np.float64)
            sums += seen, seen * seen
            met += seen.any(axis=1)
        mean = sums[0] / passes
        variance = np.maximum(sums[1] - passes * mean**2, 0) / (passes - 1)
        return LampPasses(mean, variance, met, rays * SIGHT_RAY / (passes * slots))

    none = np.zeros(slots, np.bool_)
    return LampTrial(
        (film.height, film.width),
        look(sight, PASSES),
        look(at_most(sight, 1), PASSES),
        look(with_larger_lamps(at_most(sight, 1), data), LARGER_PASSES),
        sight.sides > 0 if sight.most else none,
        (np.diff(sight.first) > 0 if sight.knows_images else none).astype(np.uint8),
    )
