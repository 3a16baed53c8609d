"""`causticmpi check`: is the input sound, and what will a run need? Renders no picture, writes nothing."""

import argparse

from causticmpi.cli.render import overrides
from causticmpi.config.load import load_config, scene_path
from causticmpi.output.directory import check_directory

PHOTON_BYTES = 3 * 40
"""Per photon and node: forecast maps, with overlaps of the clusters; a photon map takes less."""
MANY = 20
"""Ranks that the time is told for besides one: the paper's."""
PROCESS_MB = 150
"""Interpreter, numba and compiled kernels of one rank."""


def check(arguments: argparse.Namespace) -> int:
    """Validate all that `render` would read; print what it will need. Raises InputError."""
    from causticmpi.distributed.environment import launcher_rank
    from causticmpi.distributed.estimate import estimate
    from causticmpi.render.film import CHANNELS, LIGHT_CHANNELS
    from causticmpi.render.foresight import of_scene
    from causticmpi.render.methods import BIASED, FORECASTING, traces_light
    from causticmpi.scene.content import has_specular
    from causticmpi.scene.load import load_scene

    if launcher_rank() > 0:
        return 0  # under mpirun one of us is enough
    config = load_config(arguments.config, overrides(arguments))
    scene = load_scene(scene_path(arguments.config, config))
    check_directory(config.output.directory, force=True)
    if not isinstance(config.forecast.aim, str):
        from causticmpi.preprocess.aim import emission_aim

        emission_aim(config.forecast.aim, scene)
    film = config.film
    x0, y0, x1, y1 = film.crop or (0, 0, film.width, film.height)
    pixels = (x1 - x0) * (y1 - y0)
    triangles, spheres = len(scene.triangles), len(scene.spheres)
    channels = CHANNELS + (LIGHT_CHANNELS if traces_light(config) and has_specular(scene) else 0)
    rank_mb = PROCESS_MB + pixels * 4 * 9 / 2**20 + triangles * 150 / 2**20  # the films of one pass (float32)
    node_mb = pixels * 2 * 8 * channels / 2**20  # merged and pending sums (float64)
    node_mb += sum(getattr(scene, name).nbytes for name in scene.ARRAYS) / 2**20
    caustics, photons = "not forecast", 0
    if has_specular(scene) and config.method in FORECASTING:
        photons = config.forecast.photons
        caustics = f"forecast from {photons} photons"
    elif has_specular(scene) and config.method == "iws+pm":
        photons = config.photon_map.photons
        caustics = f"from a map of {photons} photons"
    node_mb += photons * PHOTON_BYTES / 2**20
    method = config.method + (" (biased)" if config.method in BIASED else "")
    budget = f"{config.budget.time} s" if config.budget.time is not None else f"{config.budget.spp} samples per pixel"
    print(f"{arguments.config}: sound")
    print(f"scene    {scene.name}: {triangles} triangles, {spheres} spheres, {scene.dropped_triangles} dropped")
    print(f"picture  {x1 - x0} x {y1 - y0} pixels, method {method}, budget {budget}")
    print(f"caustics {caustics}")
    for warning in of_scene(config, scene):
        print(f"warning  {warning}")
    print(f"memory   about {rank_mb:.0f} MB per rank and {node_mb:.0f} MB per node", flush=True)
    print(f"time     {estimate(config, scene).text(config, MANY)}")
    return 0
