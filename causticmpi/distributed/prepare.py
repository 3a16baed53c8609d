"""Before the first pass: the scene on every rank, compiled kernels on every node, forecast maps from rank 0."""

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.world import World
from causticmpi.kernels.embree import EmbreeScene
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.preprocess.aim import aim_that_pays, emission_aim
from causticmpi.preprocess.forecast import ClusterStatistics, ForecastMaps, build_forecast, no_forecast
from causticmpi.preprocess.guides import Guides, learn_guides, no_guides
from causticmpi.preprocess.lamp_images import LampImages, no_images, on_other_film
from causticmpi.preprocess.lamp_sight import (
    LampSight,
    looks_of,
    seen_in_passing,
    sides_on_other_film,
    with_images,
)
from causticmpi.preprocess.photon_map import PhotonMap, build_photon_map, no_photon_map
from causticmpi.preprocess.photons import CausticPoints, shoot_photons
from causticmpi.preprocess.view import extent_in_view, see_views
from causticmpi.render.foresight import of_photon_map, of_photons
from causticmpi.render.methods import BY_CHANCE, FORECASTING, Method, bound_of, make_method
from causticmpi.render.pilot import Plan, find_lamps, needs_pilot, run_pilot, small_film
from causticmpi.scene.content import extent, has_specular
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import primitive_arrays, traced_scene


@dataclass
class PreparedScene:
    """A scene ready to trace on this rank. extent: diagonal of its bounding box; brightest: largest radiance."""

    data: SceneData
    embree: EmbreeScene
    traced: TracedScene
    extent: float
    brightest: float


def share_scene(world: World, scene: SceneData | None, watertight: bool = False) -> PreparedScene:
    """Collective. Rank 0's scene on every rank: arrays once per node, Embree's tree once per process."""
    arrays = None
    small = None
    if scene is not None:
        derived = primitive_arrays(scene)
        arrays = {name: getattr(scene, name) for name in SceneData.ARRAYS}
        arrays.update({f"derived.{name}": array for name, array in derived.items()})
        small = {f.name: getattr(scene, f.name) for f in fields(scene) if f.name not in SceneData.ARRAYS}
    shared = world.share(arrays)
    small = world.broadcast(small)
    fields_of_data: dict[str, Any] = {name: shared[name] for name in SceneData.ARRAYS}
    data = SceneData(**fields_of_data, **small)
    derived = {name.removeprefix("derived."): array for name, array in shared.items() if name.startswith("derived.")}
    embree = EmbreeScene(data.vertices, data.triangles, data.spheres, padded=world.size > 1, watertight=watertight)
    return PreparedScene(data, embree, traced_scene(data, embree, derived), extent(data), float(data.emission.max()))


@dataclass
class Forecasting:
    """`ForecastMaps` on this rank, or the `PhotonMap` of `iws+pm`, and what their making told: photons found, particles
    emitted, rays, warnings. extent: of what the eye sees [scene units]."""

    maps: Any
    photons: int = 0
    emitted: int = 0
    rays: int = 0
    warnings: tuple[str, ...] = ()
    extent: float = 0.0
    guides: Guides = field(default_factory=no_guides)
    sight: LampSight = field(default_factory=seen_in_passing)
    plan: Plan | None = None


def needs_forecast(config: RenderConfig, scene: SceneData) -> bool:
    """Caustics are forecast only where the method asks for it and a surface is specular."""
    return config.method in FORECASTING and has_specular(scene) and config.forecast.photons > 0


def prepare_method(
    world: World, config: RenderConfig, scene: PreparedScene, camera: np.ndarray, watch: Stopwatch
) -> tuple[Method, Forecasting]:
    """Collective. The whole preprocess, and the method on every rank. camera: see kernels.camera."""
    made = prepare_forecast(world, config, scene, watch)
    made.extent, made.guides = _prepare_guides(world, config, scene, camera, watch)
    small_sight, images = _look_for_lamps(world, config, scene, watch)
    sides = small_sight.sides
    if needs_pilot(config, made.maps):
        made.plan = _prepare_plan(world, config, scene, made, small_sight, watch)
        made.guides = made.guides._replace(paths_per_pixel=made.plan.paths_per_pixel)
        sides = made.plan.sides
        if made.plan.plain:
            made.maps = no_forecast()
    made.sight = _prepare_sight(world, config, sides, images, watch)
    return make_method(config, scene.traced, camera, made.maps, made.extent, made.guides, made.sight), made


def _prepare_guides(
    world: World, config: RenderConfig, scene: PreparedScene, camera: np.ndarray, watch: Stopwatch
) -> tuple[float, Guides]:
    """Rank 0 learns how far what the eye sees extends [scene units], that of the scene if it sees nothing, and where
    from the lights it is lit; path tracing has no use for it."""
    extent_seen, guides = scene.extent, no_guides()
    if world.is_root and config.method not in BY_CHANCE:
        picture = (scene.traced, camera, config.film.width, config.film.height, config.seed)
        with watch.stage("guides"):
            views = see_views(*picture)
            extent_seen = extent_in_view(views) or scene.extent
            guides = learn_guides(*picture, bound_of(config, extent_seen), views)
    seen: tuple[float, Guides] = world.broadcast((extent_seen, guides))
    return seen


def _look_for_lamps(
    world: World, config: RenderConfig, scene: PreparedScene, watch: Stopwatch
) -> tuple[LampSight, LampImages]:
    """Rank 0 looks where a small picture shows lamps: its `sight` and images there, elsewhere lamps are seen in
    passing."""
    if not world.is_root or config.method in BY_CHANCE:
        return seen_in_passing(), no_images()
    with watch.stage("guides"):
        return find_lamps(scene.data, scene.traced, config.film, config.seed)


def _prepare_sight(
    world: World, config: RenderConfig, sides: np.ndarray, images: LampImages, watch: Stopwatch
) -> LampSight:
    """The looks of the whole film on every rank. sides (pixels,): of grids of looks in the small picture, images: in
    it, as rank 0 knows them."""
    if not world.broadcast(bool(sides.any())):
        return seen_in_passing()
    arrays = None
    if world.is_root:
        with watch.stage("guides"):
            film, small = config.film, small_film(config.film)
            sizes = (small.width, small.height), (film.width, film.height)
            sight = looks_of(sides_on_other_film(sides, *sizes))
            arrays = with_images(sight, on_other_film(images, *sizes), *sizes[1])._asdict()
    return LampSight(**world.share(arrays))


def _prepare_plan(
    world: World,
    config: RenderConfig,
    scene: PreparedScene,
    made: Forecasting,
    small_sight: LampSight,
    watch: Stopwatch,
) -> Plan:
    """Rank 0 finds out which way of sampling pays."""
    plan = None
    if world.is_root:
        with watch.stage("pilot"):
            common = (config, scene.data, scene.traced)
            plan = run_pilot(*common, made.maps, made.extent, made.guides, small_sight, RELMSE_FLOOR)
    shared: Plan = world.broadcast(plan)
    return shared


def prepare_forecast(world: World, config: RenderConfig, scene: PreparedScene, watch: Stopwatch) -> Forecasting:
    """Collective. Rank 0 shoots, clusters and indexes the photons; every node gets the maps once.

    A scene without a specular surface skips all of it. The maps of `iws+pm` are a photon map.
    """
    if config.method == "iws+pm":
        return _prepare_photon_map(world, config, scene, watch)
    if not needs_forecast(config, scene.data):
        return Forecasting(share_maps(world, no_forecast() if world.is_root else None))
    made = Forecasting(no_forecast())
    if world.is_root:
        made = make_forecast(config, scene, watch)[0]
    with watch.stage("broadcast"):
        made.maps = share_maps(world, made.maps if world.is_root else None)
    return made


def make_forecast(
    config: RenderConfig, scene: PreparedScene, watch: Stopwatch
) -> tuple[Forecasting, CausticPoints, ClusterStatistics | None]:
    """Shoot, cluster and index the photons here; statistics are None, and the maps empty, where none is found."""
    made, settings = Forecasting(no_forecast()), config.forecast
    with watch.stage("photons"):
        aim = emission_aim(settings.aim, scene.data)
        if settings.aim == "auto":
            aim = aim_that_pays(aim, scene.traced, config.seed)
        points, made.emitted, made.rays = shoot_photons(scene.traced, config.seed, settings.photons, aim)
    made.photons = len(points.power)
    made.warnings = of_photons(made.photons, settings.photons, made.emitted)
    if not made.photons:
        return made, points, None
    made.maps, statistics, seconds = build_forecast(
        points,
        config.seed,
        settings.clusters,
        settings.neighbours,
        settings.table,
        settings.max_rank,
        settings.splitting,
        None if settings.radius == "auto" else float(settings.radius),
        None if settings.overlap == "auto" else float(settings.overlap),
        settings.clustering,
        settings.sampling,
    )
    for stage, spent in seconds.items():
        watch.add(stage, spent)
    return made, points, statistics


def _prepare_photon_map(world: World, config: RenderConfig, scene: PreparedScene, watch: Stopwatch) -> Forecasting:
    settings = config.photon_map
    made = Forecasting(no_photon_map(settings.neighbours))
    if world.is_root and has_specular(scene.data):
        with watch.stage("photons"):
            points, made.emitted, made.rays = shoot_photons(scene.traced, config.seed, settings.photons)
        made.photons = len(points.power)
        made.warnings = of_photon_map(made.photons, settings.photons, made.emitted)
        if made.photons:
            radius = None if settings.radius == "auto" else float(settings.radius)
            with watch.stage("trees"):
                made.maps = build_photon_map(points, made.emitted, settings.neighbours, radius)
    with watch.stage("broadcast"):
        made.maps = share_maps(world, made.maps if world.is_root else None)
    return made


Maps = TypeVar("Maps", ForecastMaps, PhotonMap)


def share_maps(world: World, maps: Maps | None) -> Maps:
    """Collective. Rank 0's maps on every rank, arrays once per node and as buffers, never pickled."""
    arrays = scalars = None
    kind = world.broadcast(type(maps))
    if maps is not None:
        arrays = {k: v for k, v in maps._asdict().items() if isinstance(v, np.ndarray)}
        scalars = {k: v for k, v in maps._asdict().items() if k not in arrays}
    shared: dict[str, Any] = dict(world.share(arrays))
    made: Maps = kind(**shared, **world.broadcast(scalars))
    return made
