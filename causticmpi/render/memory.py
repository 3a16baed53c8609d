"""The memory that a render will need, told before it is asked for."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.errors import InputError
from causticmpi.preprocess.anchors import SHORTEST, columns_for
from causticmpi.preprocess.packed_photons import PACKED
from causticmpi.preprocess.parallax import ROWS
from causticmpi.render.film import CHANNELS, LIGHT_CHANNELS
from causticmpi.render.methods import FORECASTING, traces_light
from causticmpi.scene.content import has_specular
from causticmpi.scene.data import SceneData

MB = 2.0**20
PHOTON_BYTES = 3 * 40
"""Per photon and node: forecast maps of tables, with overlaps of the clusters; trees and cells of mixture sampling, or
a photon map, take no more."""
ANCHOR_BYTES = ROWS * np.dtype(PACKED).itemsize / SHORTEST
"""Per photon and neighbour that its anchor knows."""
TRIANGLE_BYTES = 150
"""Of Embree's tree, which each rank has."""
PROCESS_MB = 150
"""Interpreter, numba and compiled kernels of one rank."""


@dataclass(frozen=True)
class Memory:
    """MB: of each rank, and of each node besides."""

    rank: float
    node: float

    def total(self, ranks: int) -> float:
        """MB of a node with so many ranks."""
        return ranks * self.rank + self.node


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
    films = 2 if config.budget.until is None else 8  # merged and pending sums; with `until` those of its halves
    node = pixels * films * 8 * channels / MB  # float64
    node += sum(getattr(scene, name).nbytes for name in scene.ARRAYS) / MB
    mixture = config.method in FORECASTING and config.forecast.sampling == "mixture"
    photon = PHOTON_BYTES + (ANCHOR_BYTES * columns_for(config.forecast.neighbours) if mixture else 0)
    node += wanted_photons(config, scene) * photon / MB
    return Memory(rank, node)


def cgroup_limit(groups: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")) -> float:
    """MB that this process's cgroups allow (v2 and v1), inf where nothing says so. groups: the kernel's list."""
    least = math.inf
    for line in _text(groups).splitlines():
        _, controllers, own = line.split(":", 2)
        if controllers == "":
            root, name = mount, "memory.max"
        elif "memory" in controllers.split(","):
            root, name = mount / "memory", "memory.limit_in_bytes"
        else:
            continue
        here = root / own.lstrip("/")  # not there where a container sees its own group as the root
        for folder in (here, *here.parents):  # a group above limits those below
            allowed = _text(folder / name).strip()
            least = min(least, int(allowed) / MB if allowed.isdigit() else math.inf)
            if folder == root:
                break
    return least


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def memory_there(env: Mapping[str, str] = os.environ) -> tuple[float, str]:
    """MB that the ranks on this node may take, and in words what says so, "" for the machine itself."""
    node, cpu, cpus = (
        int(value) if value.isdigit() and int(value) > 0 else math.inf  # 0: all of it
        for value in (env.get(f"SLURM_{name}", "") for name in ("MEM_PER_NODE", "MEM_PER_CPU", "CPUS_ON_NODE"))
    )
    return min(
        (os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / MB, ""),
        (cgroup_limit(), " (the limit of its cgroup)"),
        (float(node), " (SLURM_MEM_PER_NODE)"),
        (float(cpu * cpus), f" (SLURM_MEM_PER_CPU on {cpus} CPUs)"),
    )


def check_memory(config: RenderConfig, scene: SceneData, ranks: int = 1) -> None:
    """Raises InputError where this machine, or what this job may have of it, could not hold the render with so many
    ranks."""
    needed = memory_needed(config, scene)
    there, source = memory_there()
    total = needed.total(ranks)
    if total > there:
        film = config.film
        photons = wanted_photons(config, scene)
        raise InputError(
            f"found a film of {film.width} x {film.height} with {film.pixels} pixels to render"
            f"{f' and {photons} photons' if photons else ''}, which need {total / 1024:.1f} GB"
            f"{f' on {ranks} ranks' if ranks > 1 else ''}; allowed: what fits the {there / 1024:.1f} GB of this machine"
            f"{source}; render parts by film.crop, or less{', or take fewer ranks of a node' if ranks > 1 else ''}"
        )
