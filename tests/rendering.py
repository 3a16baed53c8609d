"""Rendering without files, MPI or clocks, for tests: a scene and a config in, the films of single passes out."""

from pathlib import Path

import msgspec
import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import PreparedScene, prepare_method, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.render.methods import make_method, whole_pass
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

REPOSITORY = Path(__file__).resolve().parents[1]


def make_config(**sections: object) -> RenderConfig:
    """A config from plain data, validated as a file is: make_config(method="pt", film={"width": 8, "height": 8})."""
    return msgspec.convert({"scene": "unused", **sections}, RenderConfig)


def scene_from(text: str, folder: Path) -> SceneData:
    """Load a scene from YAML text, by way of a file in `folder`."""
    path = folder / "scene.yaml"
    path.write_text(text)
    return load_scene(path)


def prepare(scene: SceneData) -> PreparedScene:
    """The scene ready to trace in this process."""
    return share_scene(SerialWorld(), scene)


def render_passes(
    scene: SceneData,
    config: RenderConfig,
    passes: int,
    first_pass: int = 0,
    maps: ForecastMaps | None = None,
) -> np.ndarray:
    """Films of single passes: (passes, height, width, 6) float32, L_d in the first three channels and L_c in the last.

    maps: use these forecast maps instead of making them from the config, by natural emission and without light tracing.
    """
    prepared = prepare(scene)
    width, height = config.film.width, config.film.height
    camera = camera_array(scene.camera, width, height)
    if maps is None:
        method, _ = prepare_method(SerialWorld(), config, prepared, camera, Stopwatch())
    else:
        method = make_method(config, prepared.traced, camera, maps, prepared.extent)
    pixels = pixel_order((0, 0, width, height), width)
    films = np.zeros((passes, width * height, 6), np.float32)
    for i in range(passes):
        whole_pass(method, first_pass + i, pixels, films[i])
    prepared.embree.close()
    return films.reshape(passes, height, width, 6)


def total(films: np.ndarray) -> np.ndarray:
    """L_d + L_c in float64, (passes, height, width, 3)."""
    return films[..., :3].astype(np.float64) + films[..., 3:]
