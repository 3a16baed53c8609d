"""Compile, or load from disk, every kernel of a method before the clock matters: on two ranks of each node, the others
asleep."""

import gc
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from msgspec.structs import replace

from causticmpi.config.records import Camera, RenderConfig
from causticmpi.distributed.prepare import PreparedScene, share_maps, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.estimators import (
    brute_force,
    iws_cf,
    iws_mixture,
    iws_pm,
    lamps_in_sight,
    light_tracing,
    path_tracing,
    virtual_lights,
)
from causticmpi.kernels import kdtree
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.jit import compiled_anew
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess import (
    anchors,
    cells,
    chains,
    directions,
    forecast,
    k_means,
    lamp_images,
    lamp_sight,
    packed_photons,
    photon_map,
    photons,
    vector_quantization,
    view,
)
from causticmpi.preprocess import guides as guides_room
from causticmpi.preprocess.forecast import ForecastMaps, build_forecast
from causticmpi.preprocess.guides import learn_guides
from causticmpi.preprocess.photon_map import PhotonMap, build_photon_map, no_photon_map
from causticmpi.preprocess.photons import CausticPoints, no_points, shoot_photons
from causticmpi.render import features, film, precision
from causticmpi.render.film import Film
from causticmpi.render.methods import BY_CHANCE, make_method, traces_light
from causticmpi.render.pilot import needs_pilot
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import camera_array

KERNELS = [
    path_tracing.trace_paths,
    brute_force.trace_paths_brute,
    virtual_lights.trace_virtual_lights,
    iws_cf.trace_iws_cf,
    iws_mixture.trace_iws_mixture,
    iws_pm.trace_iws_pm,
    lamps_in_sight.see_lamps,
    photons._shoot,
    view._see_views,
    guides_room._shoot,
    chains._face,
    anchors._find_runs,
    anchors._gather,
    cells._keys,
    cells._fill,
    cells._gather,
    light_tracing.trace_light_paths,
    vector_quantization._compete,
    vector_quantization.assign,
    k_means._move_to_means,
    lamp_images._search,
    lamp_sight._mark,
    forecast._overlaps,
    photon_map._neighbour_distances,
    packed_photons._pack_all,
    kdtree.build_trees,
    kdtree.box_runs,
    film._accumulate,
    film._accumulate_light,
    precision._group_variance,
    features.first_hits,
]
"""Every kernel of a render but that which makes a mesh, asked after their cache misses."""


def compiled_so_far() -> int:
    """How many kernels this process has compiled rather than loaded from disk."""
    return compiled_anew(KERNELS)


PATIENT = 2.0
"""Seconds of loading kernels after which it is told if they have to be compiled."""


def tiny_scene() -> SceneData:
    """Two lit triangles: all array types of a real scene, nothing to trace.

    Two, for a column of a single row counts as contiguous, another type, and all would be compiled again.
    """
    return SceneData(
        vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        triangles=np.array([[0, 1, 2], [0, 1, 2]], np.int32),
        spheres=np.zeros((0, 4), np.float32),
        primitive_material=np.zeros(2, np.int32),
        primitive_emission=np.zeros(2, np.int32),
        primitive_shape=np.zeros(2, np.int32),
        material_kind=np.zeros(1, np.int32),
        material_reflectance=np.full((1, 3), 0.5, np.float32),
        material_specular=np.zeros((1, 3), np.float32),
        material_exponent=np.zeros(1, np.float32),
        material_ior=np.ones(1, np.float32),
        emission=np.ones((1, 3), np.float32),
        camera=Camera(eye=(0, 0, 1), target=(0, 0, 0)),
        name="tiny",
        content_hash="",
    )


def tiny_maps() -> ForecastMaps:
    """One cluster without photons: all array types of real maps."""
    return forecast.no_forecast()._replace(
        codebook=np.zeros((6, 1), np.float32),
        rank=np.zeros(1, np.int32),
        start=np.zeros(2, np.int64),
        coarse=np.ones((1, directions.COLUMNS * directions.ROWS), np.float32),
    )


@dataclass
class _Tiny:
    """What kernels are tried on: a scene as ranks share it, its camera and all pixels of a film of 4 x 4."""

    scene: PreparedScene
    camera: np.ndarray
    pixels: np.ndarray


@contextmanager
def _tiny() -> Iterator[_Tiny]:
    """Something to try kernels on, without Python's search for cycles meanwhile: compiling makes millions of objects
    that stay, and the search would take a tenth of its time."""
    collecting = gc.isenabled()
    scene = share_scene(SerialWorld(), tiny_scene())
    gc.disable()
    try:
        yield _Tiny(scene, camera_array(scene.data.camera, 4, 4), pixel_order((0, 0, 4, 4), 4))
    finally:
        scene.embree.close()
        if collecting:
            gc.enable()


def warm_up(config: RenderConfig, root: bool, forecasting: bool) -> None:
    """Run the kernels of the configured method on a tiny scene.

    root: also those only rank 0 needs (features, preprocess); forecasting: the scene needs forecast maps.
    """
    if root:
        warm_up_root(config, forecasting)
    warm_up_passes(config, forecasting)


def warm_up_parts(config: RenderConfig, forecasting: bool) -> list[Callable[[], None]]:
    """What of `warm_up` processes can do at the same time, the longer part first."""
    return [partial(warm_up_passes, config, forecasting), partial(warm_up_root, config, forecasting)]


def warm_up_root(config: RenderConfig, forecasting: bool) -> None:
    """Those kernels of a method that rank 0 alone runs."""
    mapping = config.method == "iws+pm"
    with _tiny() as tiny:
        traced, camera = tiny.scene.traced, tiny.camera
        features.first_hits(traced, camera, ray_buffer(), tiny.pixels, np.zeros((16, 7), np.float32))
        if config.method not in BY_CHANCE:
            learn_guides(traced, camera, 4, 4, 0, 1.0, view.see_views(traced, camera, 4, 4, 0))
            mask = lamp_sight.lamp_sight(tiny.scene.data, camera, 4, 4, 1).sides > 0
            lamp_images.find_images(tiny.scene.data, traced, camera, 4, mask)
        if forecasting or mapping:
            shoot_photons(traced, 0, 1)
            points = CausticPoints(*(array + 1 for array in no_points(4)))
            if mapping:
                build_photon_map(points, 1, 2)
            else:
                build_forecast(points, 0, 2, 2, (4, 4), 8, 1, clustering=config.forecast.clustering)
        groups, sums = precision.Precision(4), Film(16, 2.0**-40).sums
        groups.take(sums, 2, 1.0)
        groups.take(sums, 4, 1.0)


def warm_up_passes(config: RenderConfig, forecasting: bool) -> None:
    """Those kernels of a method that passes run."""
    config = replace(config, film=replace(config.film, width=4, height=4, crop=None))
    maps: ForecastMaps | PhotonMap
    if config.method == "iws+pm":
        maps = share_maps(SerialWorld(), no_photon_map(config.photon_map.neighbours))
    else:
        maps = share_maps(SerialWorld(), tiny_maps() if forecasting else forecast.no_forecast())
    with _tiny() as tiny:
        eye = (config, tiny.scene.traced, tiny.camera)
        pass_film = np.zeros((16, 6), np.float32)
        method = make_method(*eye, maps, 1.0, sight=lamp_sight.looks_of(np.ones(16)))
        method.begin_pass(0)
        method.trace(tiny.pixels, pass_film)
        if isinstance(maps, ForecastMaps) and needs_pilot(config, maps):  # which may choose to go without maps
            plain = make_method(*eye, forecast.no_forecast(), 1.0)
            plain.begin_pass(0)
            plain.trace(tiny.pixels, pass_film)
        Film(16, 2.0**-40).add_pass(pass_film)
        if traces_light(config) and forecasting:
            light_film = np.zeros((16, 3), np.float32)
            method.light_paths = 1
            method.trace_light(0, 0, 1, light_film)
            Film(16, 2.0**-40, light=True).add_light(light_film)


@contextmanager
def compiling_is_told() -> Iterator[None]:
    """Around `warm_up`: whoever waits learns why, on stderr, where kernels are compiled rather than loaded."""
    watcher = threading.Timer(PATIENT, _tell_of_compiling)
    watcher.daemon = True
    watcher.start()
    try:
        yield
    finally:
        watcher.cancel()


def _tell_of_compiling() -> None:
    if compiled_so_far():
        told = "compiling kernels, once for each method: a minute or two that no budget counts"
        print(f"causticmpi: {told}", file=sys.stderr, flush=True)
