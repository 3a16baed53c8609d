"""What there is to inspect: the scene, some passes' virtual lights, caustic points and their clusters."""

from dataclasses import dataclass

import msgspec
import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import Forecasting, PreparedScene, make_forecast, needs_forecast, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.estimators.virtual_lights import VirtualLights, empty_virtual_lights, trace_virtual_lights
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.emission import natural_emission
from causticmpi.preprocess.forecast import ClusterStatistics, no_forecast
from causticmpi.preprocess.photons import CausticPoints, no_points
from causticmpi.preprocess.vector_quantization import assign, features
from causticmpi.scene.content import has_specular
from causticmpi.scene.data import SceneData

SHOWN_PATHS = 256
"""Particle paths of virtual lights that are looked at: those of one pass are too few to see where they go."""


@dataclass(frozen=True)
class Findings:
    """What was found on one rank.

    lights: their rows are those of `light_passes` passes; points, clusters (n,) int32 and statistics belong together,
    and points are empty and the others None where there is nothing to forecast, for the reason `silence`.
    seconds: by stage, as in a render's report.
    """

    config: RenderConfig
    scene: PreparedScene
    lights: VirtualLights
    light_passes: int
    forecasting: Forecasting
    points: CausticPoints
    clusters: np.ndarray | None
    statistics: ClusterStatistics | None
    silence: str
    seconds: dict[str, float]


def find(config: RenderConfig, data: SceneData, watch: Stopwatch) -> Findings:
    """Do what a render's rank 0 does with a sound scene before its first pass; `watch` takes the time of its stages.

    Caustics are forecast whatever the method of the config is.
    """
    config = msgspec.structs.replace(config, method="iws+cf")
    with watch.stage("load"):
        scene = share_scene(SerialWorld(), data, config.watertight)
    passes = -(-SHOWN_PATHS // config.iws.paths)
    lights = _virtual_lights(config, scene, passes)
    nothing = no_points(0)
    if not needs_forecast(config, data):
        silence = "forecast.photons is 0" if has_specular(data) else "no surface of the scene is specular"
        forecasting = Forecasting(no_forecast())
        return Findings(config, scene, lights, passes, forecasting, nothing, None, None, silence, watch.stages)
    forecasting, points, statistics = make_forecast(config, scene, watch)
    clusters = None
    if statistics is not None:
        feature, _ = features(points.position, points.normal)
        clusters = np.empty(feature.shape[1], np.int32)
        codebook = forecasting.maps.codebook
        assign(codebook, feature, np.empty(codebook.shape[1], np.float32), clusters)
    silence = "" if statistics is not None else "no photon met a specular surface before a diffuse one"
    return Findings(config, scene, lights, passes, forecasting, points, clusters, statistics, silence, watch.stages)


def _virtual_lights(config: RenderConfig, scene: PreparedScene, passes: int) -> VirtualLights:
    """The lights of the first passes, one after the other, without unused rows."""
    rays, room, found = ray_buffer(), empty_virtual_lights(64 * config.iws.paths), []
    for index in range(passes):
        count, _ = trace_virtual_lights(
            scene.traced, rays, natural_emission(), config.seed, index, config.iws.paths, room
        )
        if count > len(room.offset):
            room = empty_virtual_lights(2 * count)
            count, _ = trace_virtual_lights(
                scene.traced, rays, natural_emission(), config.seed, index, config.iws.paths, room
            )
        found.append([column[:count].copy() for column in room])
    return VirtualLights(*(np.concatenate(columns) for columns in zip(*found, strict=True)))
