"""`causticmpi check`: is the input sound, and what will a run need? Renders no picture, writes nothing."""

import argparse

from causticmpi.cli.render import overrides
from causticmpi.config.load import load_config, scene_path
from causticmpi.output.directory import check_directory


def check(arguments: argparse.Namespace) -> int:
    """Validate all that `render` would read; print what it will need. Raises InputError."""
    from causticmpi.distributed.begin import sound_scene
    from causticmpi.distributed.estimate import estimate
    from causticmpi.render.foresight import of_scene
    from causticmpi.render.memory import memory_needed, wanted_photons
    from causticmpi.render.methods import BIASED, FORECASTING

    config = load_config(arguments.config, overrides(arguments))
    scene = sound_scene(config, scene_path(arguments.config, config), arguments.ranks)
    check_directory(config.output.directory, force=True)
    x0, y0, x1, y1 = config.film.window
    photons = wanted_photons(config, scene)
    how = "forecast from {} photons" if config.method in FORECASTING else "from a map of {} photons"
    memory = memory_needed(config, scene)
    method = config.method + (" (biased)" if config.method in BIASED else "")
    budget = f"{config.budget.time} s" if config.budget.time is not None else f"{config.budget.spp} samples per pixel"
    print(f"{arguments.config}: sound")
    primitives = f"{len(scene.triangles)} triangles, {len(scene.spheres)} spheres, {scene.dropped_triangles} dropped"
    print(f"scene    {scene.name}: {primitives}")
    print(f"picture  {x1 - x0} x {y1 - y0} pixels, method {method}, budget {budget}")
    print(f"caustics {how.format(photons) if photons else 'not forecast'}")
    for warning in of_scene(config, scene):
        print(f"warning  {warning}")
    each = f"{memory.rank:.0f} MB per rank and {memory.node:.0f} MB per node"
    ranks = arguments.ranks
    print(f"memory   about {each}: {memory.total(ranks):.0f} MB with {ranks} here", flush=True)
    who = "1 rank" if ranks == 1 else f"{ranks} ranks, a core each"
    print(f"time     {estimate(config, scene).text(config, ranks)} with {who}")
    return 0
