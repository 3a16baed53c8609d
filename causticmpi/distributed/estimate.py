"""How long a run will take, by a pilot on one core of this machine: the preparation as it is, and a part of a pass."""

from dataclasses import dataclass

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import needs_forecast, prepare_method, share_scene
from causticmpi.distributed.warmup import compiling_is_told, warm_up
from causticmpi.distributed.world import SerialWorld
from causticmpi.kernels.pixels import pixel_order
from causticmpi.render.rounds import Batches
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array


@dataclass(frozen=True)
class Estimate:
    """Seconds: preparing once, on one core; and per pass, of one core."""

    preparing: float
    per_pass: float

    def text(self, config: RenderConfig, ranks: int) -> str:
        """One line on what the budget means with so many ranks, each on a core like this one."""
        costs = f"{self.preparing:.2g} s of preparation, then {self.per_pass:.2g} s of a core for each pass:"
        if config.budget.spp is not None:
            return f"{costs} about {self.preparing + config.budget.spp * self.per_pass / ranks:.2g} s in all"
        left = max(0.0, float(config.budget.time or 0) - self.preparing)
        return f"{costs} about {max(1, int(left / self.per_pass * ranks))} passes in the time"


def estimate(config: RenderConfig, scene: SceneData) -> Estimate:
    """Measure on the scene as the config sees it (`sound_scene`); compiles kernels first where they are not on disk."""
    world = SerialWorld()
    with compiling_is_told():
        warm_up(config, True, needs_forecast(config, scene))
    watch = Stopwatch(from_now=True)
    prepared = share_scene(world, scene, config.watertight)
    film = config.film
    camera = camera_array(prepared.data.camera, film.width, film.height)
    method, _ = prepare_method(world, config, prepared, camera, watch)
    preparing = watch.elapsed()
    per_pass = Batches(method, pixel_order(film.window, film.width), film.pixels).pilot_seconds()
    prepared.embree.close()
    return Estimate(preparing, max(per_pass, 1e-9))
