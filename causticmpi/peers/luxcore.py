"""LuxCore on our scenes: `python -m causticmpi.peers.luxcore CONFIG METHOD OUT --seconds 5,15,60`; METHODs: ENGINES.

The clock counts from the start of the session: the tree of rays and the first photons of the caustic cache, which
LuxCore makes then, are in it; importing and parsing lie before it. Spheres are always meshes here.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.config.records import Camera
from causticmpi.peers.export import Surface, surfaces, write_ply
from causticmpi.peers.recording import Recording, Task, load, read_task

ENGINES = {"path": "PATHCPU", "hybrid": "PATHCPU", "photongi": "PATHCPU", "bidir": "BIDIRCPU", "bidirvm": "BIDIRVMCPU"}
DEPTH = 24
SPHERE_LEVEL = 6
"""81,920 triangles a sphere."""
FOOTPRINTS = 4.0
"""Radius of the photon cache's look-up, in widths of a pixel at the camera's target."""
_ALIVE: list[Any] = []
"""LuxCore's objects until the process ends: its destructors crash when Python calls them."""


def scene_properties(found: list[Surface], camera: Camera, width: int, height: int, folder: Path) -> dict[str, Any]:
    """Properties of a scene; its meshes are written into `folder`.

    LuxCore's picture lies one pixel row below everybody else's, so the window on the film is moved down by one.
    """
    aspect, row = width / height, 2.0 / height
    values: dict[str, Any] = {
        "scene.camera.type": "perspective",
        "scene.camera.lookat.orig": list(camera.eye),
        "scene.camera.lookat.target": list(camera.target),
        "scene.camera.up": list(camera.up),
        "scene.camera.fieldofview": camera.fov,
        "scene.camera.screenwindow": [-aspect, aspect, -1.0 - row, 1.0 - row],
        "scene.camera.autofocus.enable": False,
        "scene.camera.lensradius": 0.0,
        "scene.camera.cliphither": 1e-3,
    }
    for surface in found:
        path = folder / f"{surface.name}.ply"
        write_ply(surface, path)
        values[f"scene.shapes.{surface.name}.type"] = "mesh"
        values[f"scene.shapes.{surface.name}.ply"] = str(path)
        values[f"scene.objects.{surface.name}.shape"] = surface.name
        values[f"scene.objects.{surface.name}.material"] = surface.name
        for key, value in _material(surface).items():
            values[f"scene.materials.{surface.name}.{key}"] = value
    return values


def _material(surface: Surface) -> dict[str, Any]:
    if surface.kind == "dielectric":
        white = [1.0, 1.0, 1.0]
        return {"type": "glass", "kr": white, "kt": white, "interiorior": surface.ior, "exteriorior": 1.0}
    if surface.kind == "mirror":
        return {"type": "mirror", "kr": list(surface.reflectance)}
    matte: dict[str, Any] = {"type": "matte", "kd": list(surface.reflectance)}
    return matte if surface.radiance is None else {**matte, "emission": list(surface.radiance)}


def engine_properties(method: str, width: int, height: int, seed: int, footprint: float) -> dict[str, Any]:
    """Properties of the render engine: one thread, box filter, no clamping. footprint: of a pixel [scene units]."""
    values: dict[str, Any] = {
        "renderengine.type": ENGINES[method],
        "renderengine.seed": seed,
        "native.threads.count": 1,
        "sampler.type": "SOBOL",
        "film.width": width,
        "film.height": height,
        "film.filter.type": "NONE",
        "path.maxdepth": DEPTH // 2,
        "light.maxdepth": DEPTH // 2,
        "path.clamping.variance.maxvalue": 0.0,
    }
    for kind in ("total", "diffuse", "glossy", "specular"):
        values[f"path.pathdepth.{kind}"] = DEPTH
    if method == "hybrid":
        values |= {
            "path.hybridbackforward.enable": True,
            "path.hybridbackforward.partition": 0.5,
            "path.hybridbackforward.glossinessthreshold": 0.05,
        }
    if method == "photongi":
        radius = FOOTPRINTS * footprint
        values |= {
            "path.photongi.sampler.type": "METROPOLIS",
            "path.photongi.photon.maxcount": 20_000_000,
            "path.photongi.photon.maxdepth": 8,
            "path.photongi.caustic.enabled": True,
            "path.photongi.caustic.maxsize": 200_000,
            "path.photongi.caustic.lookup.radius": radius,
            "path.photongi.caustic.lookup.minradius": radius / 10,
            "path.photongi.caustic.updatespp": 8,
            "path.photongi.caustic.updatespp.radiusreduction": 0.96,
            "path.photongi.caustic.updatespp.minradius": radius / 10,
        }
    return values


def pixel_footprint(camera: Camera, height: int) -> float:
    """Width of a pixel at the distance of the camera's target [scene units]."""
    distance = float(np.linalg.norm(np.subtract(camera.target, camera.eye)))
    return 2 * float(np.tan(np.radians(camera.fov) / 2)) * distance / height


def render(task: Task) -> tuple[Recording, dict[str, Any]]:
    """One session; this thread sleeps and looks at the clock and at the film."""
    config, data = load(task.config)
    width, height, camera = config.film.width, config.film.height, data.camera
    found = surfaces(data, SPHERE_LEVEL)
    with tempfile.TemporaryDirectory() as folder:
        description = scene_properties(found, camera, width, height, Path(folder))
        # Last of all imports: it replaces malloc, and what another library allocated before must not be freed after.
        import pyluxcore

        pyluxcore.Init()
        pyluxcore.SetLogHandler(lambda message: None)
        scene = pyluxcore.Scene()
        scene.Parse(_properties(pyluxcore, description))
    engine = engine_properties(task.method, width, height, task.seed, pixel_footprint(camera, height))
    settings = pyluxcore.RenderConfig(_properties(pyluxcore, engine), scene)
    session = pyluxcore.RenderSession(settings)
    _ALIVE.extend([scene, settings, session])
    recording, film = Recording(task.seconds), np.zeros((height, width, 3), np.float32)
    before = time.process_time()
    session.Start()
    while not recording.done:
        left = recording.budgets[len(recording.pictures)] - (time.process_time() - before)
        if left > 0:
            time.sleep(max(0.002, min(1.0, 0.9 * left)))
            continue
        seconds = time.process_time() - before
        session.UpdateStats()
        samples = session.GetStats().Get("stats.renderengine.pass").GetInt()
        session.GetFilm().GetOutputFloat(pyluxcore.FilmOutputType.RGB, film, 0)
        recording.take(film[::-1], seconds, 0.0, samples)
    session.Stop()
    return recording, {"renderer": f"LuxCore {pyluxcore.Version()}", "note": "", "uncounted_cpu_seconds": before}


def _properties(pyluxcore: Any, values: dict[str, Any]) -> Any:
    found = pyluxcore.Properties()
    for key, value in values.items():
        found.Set(pyluxcore.Property(key, value))
    return found


if __name__ == "__main__":
    own_task = read_task()
    made, told = render(own_task)
    made.write(own_task, told)
    sys.stdout.flush()
    os._exit(0)  # LuxCore would call the log handler after the interpreter's end
