"""Compile, or load from disk, every kernel of a method before the clock matters: once per node, the others asleep."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from msgspec.structs import replace

from causticmpi.config.records import Camera, RenderConfig
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
"""Every kernel of the program, asked after their cache misses."""
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


def warm_up(config: RenderConfig, root: bool, forecasting: bool) -> bool:
    """Run the kernels of the configured method on a tiny scene. True if anything had to be compiled.

    root: also those only rank 0 needs (features, preprocess); forecasting: the scene needs forecast maps.
    """
    from causticmpi.distributed.prepare import share_maps, share_scene

    before = compiled_anew(KERNELS)
    config = replace(config, film=replace(config.film, width=4, height=4, crop=None))
    world = SerialWorld()
    scene = share_scene(world, tiny_scene())
    camera = camera_array(scene.data.camera, 4, 4)
    pixels = pixel_order((0, 0, 4, 4), 4)
    rays = ray_buffer()
    if root:
        features.first_hits(scene.traced, camera, rays, pixels, np.zeros((16, 7), np.float32))
    mapping = config.method == "iws+pm"
    if root and config.method not in BY_CHANCE:
        learn_guides(scene.traced, camera, 4, 4, 0, 1.0, view.see_views(scene.traced, camera, 4, 4, 0))
        mask = lamp_sight.lamp_sight(scene.data, camera, 4, 4, 1).sides > 0
        lamp_images.find_images(scene.data, scene.traced, camera, 4, mask)
    if root and (forecasting or mapping):
        shoot_photons(scene.traced, 0, 1)
        points = CausticPoints(*(array + 1 for array in no_points(4)))
        if mapping:
            build_photon_map(points, 1, 2)
        else:
            build_forecast(points, 0, 2, 2, (4, 4), 8, 1, clustering=config.forecast.clustering)
    maps: ForecastMaps | PhotonMap
    if mapping:
        maps = share_maps(world, no_photon_map(config.photon_map.neighbours))
    else:
        maps = share_maps(world, tiny_maps() if forecasting else forecast.no_forecast())
    everywhere = lamp_sight.looks_of(np.ones(16))
    method = make_method(config, scene.traced, camera, maps, 1.0, sight=everywhere)
    method.begin_pass(0)
    pass_film = np.zeros((16, 6), np.float32)
    method.trace(pixels, pass_film)
    if isinstance(maps, ForecastMaps) and needs_pilot(config, maps):  # which may choose to go without maps
        plain = make_method(config, scene.traced, camera, forecast.no_forecast(), 1.0)
        plain.begin_pass(0)
        plain.trace(pixels, pass_film)
    sums = Film(16, 2.0**-40)
    sums.add_pass(pass_film)
    if root:
        groups = precision.Precision(4)
        groups.take(sums.sums, 2, 1.0)
        groups.take(sums.sums, 4, 1.0)
    if traces_light(config) and forecasting:
        light_film = np.zeros((16, 3), np.float32)
        method.light_paths = 1
        method.trace_light(0, 0, 1, light_film)
        Film(16, 2.0**-40, light=True).add_light(light_film)
    scene.embree.close()
    return compiled_anew(KERNELS) > before


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
    if compiled_anew(KERNELS):
        told = "compiling kernels, once for each method: a minute or two that no budget counts"
        print(f"causticmpi: {told}", file=sys.stderr, flush=True)
