"""The rendering methods behind one interface: begin a pass, then trace runs of its pixels.

A method knows neither clock nor rank; the same seed and pass index give the same samples anywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.estimators.caustic_forecast import forecast_work
from causticmpi.estimators.caustic_mixture import mixture_work
from causticmpi.estimators.density_estimate import density_work
from causticmpi.estimators.full_radiance import pass_work
from causticmpi.estimators.iws_cf import trace_iws_cf
from causticmpi.estimators.iws_mixture import trace_iws_mixture
from causticmpi.estimators.iws_pm import trace_iws_pm
from causticmpi.estimators.path_tracing import trace_paths, trace_paths_brute
from causticmpi.estimators.virtual_lights import empty_virtual_lights, trace_virtual_lights
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.preprocess.photon_map import PhotonMap

FORECASTING = ("iws+cf",)
"""Methods whose preprocess shoots photons and builds forecast maps."""
BIASED = ("iws+pm",)
"""Methods that do not converge to the true picture: named in every table and file they touch."""


class Method(Protocol):
    """One estimator with its workspace."""

    def begin_pass(self, pass_index: int) -> int:
        """What a pass needs before its pixels; returns rays traced."""

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        """Add one sample for each row of `pixels` (see kernels.pixels) to the pass film; returns rays traced."""


@dataclass
class PathTracing:
    """`pt` and `pt-brute`."""

    kernel: Callable[..., int]
    scene: TracedScene
    camera: np.ndarray
    seed: int
    pass_index: int = 0

    def __post_init__(self) -> None:
        self.rays = ray_buffer()

    def begin_pass(self, pass_index: int) -> int:
        self.pass_index = pass_index
        return 0

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        return self.kernel(self.scene, self.camera, self.rays, pixels, self.seed, self.pass_index, film)


@dataclass(kw_only=True)
class VirtualLighting:
    """What the methods of weak singularities share: virtual lights renewed every pass."""

    scene: TracedScene
    camera: np.ndarray
    seed: int
    paths: int
    few: int
    bound: float
    pass_index: int = 0
    lights: Any = None
    light_count: int = 0

    def __post_init__(self) -> None:
        self.rays = ray_buffer()
        self.peak = most_peak(self.scene)
        self.lights = empty_virtual_lights(8 * self.paths)

    def begin_pass(self, pass_index: int) -> int:
        self.pass_index = pass_index
        while True:
            count, rays = trace_virtual_lights(self.scene, self.rays, self.seed, pass_index, self.paths, self.lights)
            if count <= len(self.lights.offset):
                self.light_count = count
                return rays
            self.lights = empty_virtual_lights(2 * count)


@dataclass(kw_only=True)
class WeakSingularities(VirtualLighting):
    """`iws` (L_d alone) and `iws+cf`."""

    maps: ForecastMaps
    caustics: bool
    sampling: str

    def __post_init__(self) -> None:
        super().__post_init__()
        # Without a cluster there is nothing to mix: the first kernel samples by the BRDF alone then.
        self.mixture = self.sampling == "mixture" and self.caustics and self.maps.codebook.shape[1] > 0
        tables = self.sampling if self.sampling != "mixture" else "two"
        self.work = pass_work(mixture_work(self.maps) if self.mixture else forecast_work(self.maps, tables))

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        eye = (self.scene, self.camera, self.work, pixels, self.seed, self.pass_index)
        light = (self.lights, self.light_count, self.maps, self.few, self.bound)
        if self.mixture:
            rays, lost = trace_iws_mixture(*eye, *light, film)
        else:
            rays, lost = trace_iws_cf(*eye, *light, self.peak, self.caustics, film)
        if lost:
            raise RuntimeError(f"{lost} path vertices did not fit the stack: the picture would be biased")
        return rays


@dataclass(kw_only=True)
class PhotonMapping(VirtualLighting):
    """`iws+pm`."""

    photons: PhotonMap

    def __post_init__(self) -> None:
        super().__post_init__()
        self.work = pass_work(density_work(self.photons))

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        eye = (self.scene, self.camera, self.work, pixels, self.seed, self.pass_index)
        light = (self.lights, self.light_count, self.photons, self.few, self.bound)
        rays: int = trace_iws_pm(*eye, *light, self.peak, film)
        return rays


def make_method(
    config: RenderConfig, scene: TracedScene, camera: np.ndarray, maps: ForecastMaps | PhotonMap, extent: float
) -> Method:
    """The configured method. maps: a photon map for `iws+pm`; extent: diagonal of the scene [scene units], for the
    automatic bound."""
    if config.method == "pt":
        return PathTracing(trace_paths, scene, camera, config.seed)
    if config.method == "pt-brute":
        return PathTracing(trace_paths_brute, scene, camera, config.seed)
    bound = automatic_bound(extent) if config.iws.bound == "auto" else float(config.iws.bound)
    common: dict[str, Any] = {
        "scene": scene,
        "camera": camera,
        "seed": config.seed,
        "paths": config.iws.paths,
        "few": config.iws.deep_lights,
        "bound": bound,
    }
    if isinstance(maps, PhotonMap):
        return PhotonMapping(**common, photons=maps)
    return WeakSingularities(**common, maps=maps, caustics=config.method == "iws+cf", sampling=config.forecast.sampling)


BOUND_FACTOR = 100.0


def automatic_bound(extent: float) -> float:
    """b [units^-2] from the scene's diagonal: connections shorter than about a tenth of it are compensated."""
    return BOUND_FACTOR / (extent * extent)


def most_peak(scene: TracedScene) -> float:
    """Largest `bsdf.peak` of any material of the scene."""
    gloss = scene.kind == 1
    if not gloss.any():
        return 1.0
    diffuse, lobe = scene.reflectance[gloss].max(axis=1), scene.specular[gloss].max(axis=1)
    return max(1.0, float((diffuse + lobe * (scene.exponent[gloss] + 2) / 2).max()))
