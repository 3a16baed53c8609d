"""A render from config to picture: what is read and shared before the first ray, the run, and what is left after it."""

import time
from collections.abc import Callable
from contextlib import nullcontext

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.begin import Request, claim, nothing_to_do, read_input
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import needs_forecast, share_scene
from causticmpi.distributed.run import Run
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.warmup import compiled_so_far, compiling_is_told, warm_up, warm_up_parts
from causticmpi.distributed.world import World
from causticmpi.errors import RunError
from causticmpi.scene.data import SceneData


def render(world: World, read_request: Callable[[], Request]) -> int:
    """Collective. Render what rank 0's `read_request` asks for; returns the exit code.

    Raises AgreedInputError on all ranks for bad input, before anything is written, and RunError on all ranks if the
    result could not be written.
    """
    with StopFlag() as flag:
        render_one(world, read_request, Stopwatch(), flag)
    return 0


def render_one(
    world: World,
    read_request: Callable[[], Request],
    watch: Stopwatch,
    flag: StopFlag,
    snapshots: Snapshots | None = None,
) -> int:
    """Collective. One of several renders in these processes; the world keeps none of its memory.

    The budget counts from the zero of `watch`. snapshots: keeps pictures of the growing run (see there). Returns the
    signal that stopped the run, 0 for none. Raises as `render` does.
    """
    given = read_input(world, read_request, watch)
    if world.broadcast(nothing_to_do(given) if world.is_root else None):
        return 0
    config = given.request.config
    _warm_up(world, config, given.scene, watch)
    with watch.stage("load"):
        scene = share_scene(world, given.scene, config.watertight)
    run = Run(world, given, scene, claim(world, given.request), watch, flag, snapshots)
    del given  # a checkpoint's arrays are as large as several films
    stopped = run.asked_to_stop()
    if not stopped:
        run.forecast()
    world.watch(True)
    if not stopped:
        run.trace()
    try:
        run.finish()
    except RunError:  # on all ranks
        world.watch(False)
        raise
    world.watch(False)
    scene.embree.close()
    world.release()
    return run.stopped_by


def _warm_up(world: World, config: RenderConfig, scene: SceneData | None, watch: Stopwatch) -> None:
    """Compile once per node. Compiling lies outside the budget and is reported, loading compiled code lies within."""
    began, before = time.perf_counter(), compiled_so_far()
    forecasting = world.broadcast(scene is not None and needs_forecast(config, scene))
    with compiling_is_told() if world.is_root else nullcontext():
        world.first_on_node(lambda: warm_up(config, world.is_root, forecasting), warm_up_parts(config, forecasting))
    spent = time.perf_counter() - began
    watch.add("warmup", spent)
    if world.all_max(compiled_so_far() - before):
        watch.compiling += spent
