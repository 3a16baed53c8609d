"""The rendering methods behind one interface: begin a pass, then trace runs of its pixels.

A method knows neither clock nor rank; the same seed and pass index give the same samples anywhere.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.estimators.brute_force import trace_paths_brute
from causticmpi.estimators.caustic_forecast import forecast_work
from causticmpi.estimators.density_estimate import density_work
from causticmpi.estimators.full_radiance import pass_work
from causticmpi.estimators.iws_cf import trace_iws_cf
from causticmpi.estimators.iws_mixture import trace_iws_mixture
from causticmpi.estimators.iws_pm import trace_iws_pm
from causticmpi.estimators.lamps_in_sight import see_lamps, sight_work
from causticmpi.estimators.light_tracing import trace_light_paths
from causticmpi.estimators.mixture_rays import mixture_work
from causticmpi.estimators.path_tracing import trace_paths
from causticmpi.estimators.virtual_lights import empty_virtual_lights, trace_virtual_lights
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.material_kinds import MIRROR, PHONG
from causticmpi.kernels.particle_waves import particle_work
from causticmpi.kernels.path_layout import FIRST_SPLIT, SECOND_SPLIT, path_work
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.preprocess.guides import Guides, no_guides
from causticmpi.preprocess.lamp_sight import LampSight, seen_in_passing
from causticmpi.preprocess.photon_map import PhotonMap

FORECASTING = ("iws+cf",)
"""Methods whose preprocess shoots photons and builds forecast maps."""
BY_CHANCE = ("pt", "pt-brute")
"""Methods that meet a light behind specular surfaces by chance alone."""
BIASED = ("iws+pm",)
"""Methods that do not converge to the true picture: named in every table and file they touch."""


class Method(Protocol):
    """One estimator with its workspace. light_paths: light paths of a pass, 0 for most methods."""

    light_paths: int

    def begin_pass(self, pass_index: int) -> int:
        """What a pass needs before its pixels; returns rays traced."""

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        """Add one sample for each row of `pixels` (see kernels.pixels) to the pass film; returns rays traced."""

    def trace_light(self, pass_index: int, first: int, last: int, film: np.ndarray) -> int:
        """Add light paths first … last-1 of a pass to a film (slots, 3) of L_c of their own; returns rays traced."""


def whole_pass(method: Method, pass_index: int, pixels: np.ndarray, film: np.ndarray) -> int:
    """Add all of a pass, its light paths too, to a film (slots, 6); returns rays traced."""
    rays = method.begin_pass(pass_index) + method.trace(pixels, film)
    if method.light_paths:
        light = np.zeros((len(film), 3), np.float32)
        rays += method.trace_light(pass_index, 0, method.light_paths, light)
        film[:, 3:] += light
    return rays


@dataclass(kw_only=True)
class EyePaths:
    """What all methods share, and what most of them do: begin a pass without work, and trace no light paths."""

    scene: TracedScene
    camera: np.ndarray
    seed: int
    pass_index: int = 0
    light_paths: int = 0

    def begin_pass(self, pass_index: int) -> int:
        self.pass_index = pass_index
        return 0

    def trace_light(self, pass_index: int, first: int, last: int, film: np.ndarray) -> int:
        return 0


@dataclass(kw_only=True)
class PathTracing(EyePaths):
    """`pt`."""

    def __post_init__(self) -> None:
        self.work, self.queues = path_work()
        specular = bool((self.scene.kind >= MIRROR).any())
        self.splits = np.array([FIRST_SPLIT, SECOND_SPLIT] if specular else [1, 1], np.int64)

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        workspace = (self.work, self.queues, self.splits)
        return trace_paths(self.scene, self.camera, *workspace, pixels, self.seed, self.pass_index, film)


@dataclass(kw_only=True)
class BruteForce(EyePaths):
    """`pt-brute`."""

    def __post_init__(self) -> None:
        self.rays = ray_buffer()

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        return trace_paths_brute(self.scene, self.camera, self.rays, pixels, self.seed, self.pass_index, film)


@dataclass(kw_only=True)
class VirtualLighting(EyePaths, ABC):
    """What the methods of weak singularities share: virtual lights renewed every pass, lamps seen on their own."""

    guides: Guides
    sight: LampSight
    paths: int
    few: int
    bound: float
    lights: Any = None
    light_count: int = 0

    def __post_init__(self) -> None:
        self.rays = ray_buffer()
        most_side = self.sight.most
        self.looks, self.sight_work = most_side > 0, sight_work(most_side)
        self.peak = most_peak(self.scene)
        self.lights = empty_virtual_lights(8 * self.paths)

    def begin_pass(self, pass_index: int) -> int:
        self.pass_index = pass_index
        while True:
            count, rays = trace_virtual_lights(
                self.scene, self.rays, self.guides.virtual_lights, self.seed, pass_index, self.paths, self.lights
            )
            if count <= len(self.lights.offset):
                self.light_count = count
                return rays
            self.lights = empty_virtual_lights(2 * count)

    def trace(self, pixels: np.ndarray, film: np.ndarray) -> int:
        return self.trace_vertices(pixels, film) + self.see_lamps(pixels, film)

    def see_lamps(self, pixels: np.ndarray, film: np.ndarray) -> int:
        """Add the lamps themselves to L_d where they get looks of their own; returns rays traced."""
        if not self.looks:
            return 0
        eye = (self.scene, self.camera, self.sight_work, self.sight)
        rays: int = see_lamps(*eye, pixels, self.seed, self.pass_index, film)
        return rays

    @abstractmethod
    def trace_vertices(self, pixels: np.ndarray, film: np.ndarray) -> int:
        """Add what comes from the first non-specular vertices, all but what `see_lamps` adds; returns rays traced."""


@dataclass(kw_only=True)
class WeakSingularities(VirtualLighting):
    """`iws` (L_d alone) and `iws+cf`."""

    maps: ForecastMaps
    window: tuple[int, int, int, int]
    caustics: bool
    sampling: str

    def __post_init__(self) -> None:
        super().__post_init__()
        # Without a cluster there is nothing to mix: the first kernel samples by the BRDF alone then.
        self.mixture = self.sampling == "mixture" and self.caustics and self.maps.codebook.shape[1] > 0
        if not self.mixture:
            self.light_paths = 0
        tables = self.sampling if self.sampling != "mixture" else "two"
        self.light_work = particle_work()
        forecast = mixture_work(self.maps) if self.mixture else forecast_work(self.maps, tables)
        self.work = pass_work(forecast, 2 + 2 * self.maps.splitting)

    def trace_vertices(self, pixels: np.ndarray, film: np.ndarray) -> int:
        eye = (self.scene, self.camera, self.work, pixels, self.seed, self.pass_index)
        light = (self.lights, self.light_count, self.maps, self.few, self.bound)
        if self.mixture:
            rays, lost = trace_iws_mixture(*eye, *light, self.peak, self.light_paths > 0, self.sight.sides, film)
        else:
            rays, lost = trace_iws_cf(*eye, *light, self.peak, self.caustics, self.sight.sides, film)
        return none_lost(rays, lost)

    def trace_light(self, pass_index: int, first: int, last: int, film: np.ndarray) -> int:
        x0, y0, x1, y1 = self.window
        if len(film) != (x1 - x0) * (y1 - y0):  # the kernel writes where the camera sees: past the end otherwise
            raise ValueError(f"{len(film)} slots for the {(x1 - x0) * (y1 - y0)} pixels of the window {self.window}")
        rays: int = trace_light_paths(
            self.scene,
            self.camera,
            *self.light_work,
            self.guides.light_tracing,
            np.array(self.window, np.float32),
            self.seed,
            pass_index,
            first,
            last,
            np.float32(1 / self.light_paths),
            film,
        )
        return rays


@dataclass(kw_only=True)
class PhotonMapping(VirtualLighting):
    """`iws+pm`."""

    photons: PhotonMap

    def __post_init__(self) -> None:
        super().__post_init__()
        self.work = pass_work(density_work(self.photons), 1)

    def trace_vertices(self, pixels: np.ndarray, film: np.ndarray) -> int:
        eye = (self.scene, self.camera, self.work, pixels, self.seed, self.pass_index)
        light = (self.lights, self.light_count, self.photons, self.few, self.bound)
        return none_lost(*trace_iws_pm(*eye, *light, self.peak, self.sight.sides, film))


def none_lost(rays: int, lost: int) -> int:
    """The rays; raises RuntimeError if vertices were lost."""
    if lost:
        raise RuntimeError(f"{lost} path vertices did not fit the stack: the picture would be biased")
    return rays


def make_method(
    config: RenderConfig,
    scene: TracedScene,
    camera: np.ndarray,
    maps: ForecastMaps | PhotonMap,
    extent: float,
    guides: Guides | None = None,
    sight: LampSight | None = None,
) -> Method:
    """The configured method. maps: a photon map for `iws+pm`; extent: diagonal of what the eye sees [scene
    units], for the automatic bound; guides: natural emission, and no light tracing, if there are none; sight: lamps are
    seen in passing if there is none."""
    common: dict[str, Any] = {"scene": scene, "camera": camera, "seed": config.seed}
    if config.method == "pt":
        return PathTracing(**common)
    if config.method == "pt-brute":
        return BruteForce(**common)
    guides = guides or no_guides()
    common |= {
        "guides": guides,
        "sight": sight or seen_in_passing(),
        "paths": config.iws.paths,
        "few": config.iws.deep_lights,
        "bound": bound_of(config, extent),
    }
    if isinstance(maps, PhotonMap):
        return PhotonMapping(**common, photons=maps)
    film = config.film
    return WeakSingularities(
        **common,
        maps=maps,
        window=film.window,
        # Of the whole film, whatever the crop: a crop has the same samples.
        light_paths=int(guides.paths_per_pixel * film.width * film.height) if traces_light(config) else 0,
        caustics=config.method == "iws+cf",
        sampling=config.forecast.sampling,
    )


def traces_light(config: RenderConfig) -> bool:
    """Whether the method leaves the caustics that the eye sees directly to light tracing, if there are any."""
    return config.method == "iws+cf" and config.forecast.sampling == "mixture" and config.forecast.light_tracing


def bound_of(config: RenderConfig, extent: float) -> float:
    """The bound b [units^-2] of the config, or the automatic one."""
    return automatic_bound(extent) if config.iws.bound == "auto" else float(config.iws.bound)


BOUND_FACTOR = 100.0


def automatic_bound(extent: float) -> float:
    """b [units^-2] from the diagonal of what the eye sees: connections shorter than a tenth of it are compensated."""
    return BOUND_FACTOR / (extent * extent)


def most_peak(scene: TracedScene) -> float:
    """Largest `bsdf.peak` of any material of the scene."""
    gloss = scene.kind == PHONG
    if not gloss.any():
        return 1.0
    diffuse, lobe = scene.reflectance[gloss].max(axis=1), scene.specular[gloss].max(axis=1)
    return max(1.0, float((diffuse + lobe * (scene.exponent[gloss] + 2) / 2).max()))
