"""The memory that a render will need, told before it is asked for."""

import os
from dataclasses import dataclass

from causticmpi.config.records import RenderConfig
from causticmpi.errors import InputError
from causticmpi.preprocess.anchors import SHORTEST
from causticmpi.render.film import CHANNELS, LIGHT_CHANNELS
from causticmpi.render.methods import FORECASTING, traces_light
from causticmpi.scene.content import has_specular
from causticmpi.scene.data import SceneData

MB = 2.0**20
PHOTON_BYTES = 3 * 40
"""Per photon and node: forecast maps, with overlaps of the clusters; a photon map takes less."""
NEIGHBOUR_BYTES = 3 * 16 / SHORTEST
"""The same for each neighbour that its anchor knows."""
TRIANGLE_BYTES = 150
"""Of Embree's tree, which each rank has."""
PROCESS_MB = 150
"""Interpreter, numba and compiled kernels of one rank."""


@dataclass(frozen=True)
class Memory:
    """MB: of each rank, and of each node besides."""

    rank: float
    node: float


def wanted_photons(config: RenderConfig, scene: SceneData) -> int:
    """Caustic points that the method will collect in this scene; 0 for a method without."""
    if not has_specular(scene):
        return 0
    if config.method in FORECASTING:
        return config.forecast.photons
    return config.photon_map.photons if config.method == "iws+pm" else 0


def memory_needed(config: RenderConfig, scene: SceneData) -> Memory:
    """What this render will take, roughly."""
    pixels = config.film.pixels
    channels = CHANNELS + (LIGHT_CHANNELS if traces_light(config) and has_specular(scene) else 0)
    rank = PROCESS_MB + pixels * 4 * 9 / MB + len(scene.triangles) * TRIANGLE_BYTES / MB  # films of one pass: float32
    node = pixels * 2 * 8 * channels / MB  # merged and pending sums: float64
    node += sum(getattr(scene, name).nbytes for name in scene.ARRAYS) / MB
    photon = PHOTON_BYTES + config.forecast.neighbours * NEIGHBOUR_BYTES
    node += wanted_photons(config, scene) * photon / MB
    return Memory(rank, node)


def check_memory(config: RenderConfig, scene: SceneData) -> None:
    """Raises InputError where this machine could not hold the render even with a single rank."""
    needed = memory_needed(config, scene)
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / MB
    if needed.rank + needed.node > there:
        film = config.film
        photons = wanted_photons(config, scene)
        raise InputError(
            f"found a film of {film.width} x {film.height} with {film.pixels} pixels to render"
            f"{f' and {photons} photons' if photons else ''}, which need {(needed.rank + needed.node) / 1024:.0f} GB; "
            f"allowed: what fits the {there / 1024:.0f} GB of this machine; render parts by film.crop, or less"
        )
