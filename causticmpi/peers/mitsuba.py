"""Mitsuba 3 on our scenes: `python -m causticmpi.peers.mitsuba CONFIG path|ptracer OUT --seconds 5,15,60`.

The clock counts rendering. Importing, loading (Embree's tree is built then), and the compilation by Dr.Jit, which the
first picture pays, lie before it; their CPU seconds are written down.
"""

import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.peers.export import Surface, surfaces
from causticmpi.peers.recording import Recording, Task, load, read_task
from causticmpi.scene.data import SceneData

SAMPLES = 4
"""Per pixel and pass; ptracer: as many light paths per pixel."""
DEPTH, ROULETTE_DEPTH = 24, 5
OLDEST_LLVM = 16
"""Older ones abort on processors with AVX-512: "Cannot select"."""


def choose_variant() -> tuple[str, str]:
    """The fastest variant that works here, and a note on it. Sets DRJIT_LIBLLVM_PATH where the user did not."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = sorted((llvm_version(path), path) for folder in _LIBRARIES for path in folder.glob("libLLVM*.so*"))
        new = [path for version, path in found if version >= OLDEST_LLVM]
        if new:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(new[-1])
        elif not found or "avx512f" in _processor():
            return (
                "scalar_rgb",
                f"scalar_rgb, for want of LLVM >= {OLDEST_LLVM} (Debian, Ubuntu: apt install libllvm19)",
            )
    return "llvm_ad_rgb", "llvm_ad_rgb"


_LIBRARIES = [*Path("/usr/lib").glob("*-linux-gnu"), Path("/usr/lib64"), *Path("/usr/lib").glob("llvm-*/lib")]


def llvm_version(library: Path) -> int:
    """Major version by the name of the file, 0 if it has none: libLLVM-16.so.1, libLLVM.so.19.1."""
    found = re.search(r"libLLVM(?:-|\.so\.)(\d+)", library.name)
    return int(found.group(1)) if found else 0


def _processor() -> str:
    try:
        return Path("/proc/cpuinfo").read_text()
    except OSError:
        return ""


def mitsuba_scene(mi: Any, scene: SceneData, width: int, height: int, level: int | None, method: str = "path") -> Any:
    """The scene as Mitsuba's. level: of `export.surfaces`; method: its integrator, of depth 24, roulette from 5 on."""
    camera = scene.camera
    parts: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": camera.fov,
            "fov_axis": "y",
            "near_clip": 1e-3,
            "far_clip": 1e5,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=list(camera.eye), target=list(camera.target), up=list(camera.up)
            ),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        },
        "integrator": {"type": method, "max_depth": DEPTH, "rr_depth": ROULETTE_DEPTH},
    }
    for surface in surfaces(scene, level):
        parts[surface.name] = _shape(mi, surface)
    return mi.load_dict(parts)


def _shape(mi: Any, surface: Surface) -> Any:
    properties: dict[str, Any] = {"bsdf": _bsdf(surface)}
    if surface.radiance is not None:
        properties["emitter"] = {"type": "area", "radiance": _rgb(surface.radiance)}
    if surface.sphere is not None:
        return {"type": "sphere", "center": list(surface.sphere[:3]), "radius": surface.sphere[3], **properties}
    props = mi.Properties()
    for key, value in properties.items():
        props[key] = mi.load_dict(value)
    mesh = mi.Mesh(surface.name, len(surface.vertices), len(surface.triangles), props=props, has_vertex_normals=False)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(surface.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(surface.triangles, np.uint32).ravel()
    parameters.update()
    return mesh


def _bsdf(surface: Surface) -> dict[str, Any]:
    if surface.kind == "dielectric":
        return {"type": "dielectric", "int_ior": surface.ior, "ext_ior": 1.0}
    if surface.kind == "mirror":
        one_sided = {"type": "conductor", "material": "none", "specular_reflectance": _rgb(surface.reflectance)}
    else:
        one_sided = {"type": "diffuse", "reflectance": _rgb(surface.reflectance)}
    return {"type": "twosided", "b": one_sided}


def _rgb(value: tuple[float, ...]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def render(task: Task) -> tuple[Recording, dict[str, Any]]:
    """Passes of SAMPLES samples until the last budget is spent."""
    variant, note = choose_variant()
    import drjit
    import mitsuba

    mi: Any = mitsuba  # a module whose contents follow the variant
    mi.set_variant(variant)
    drjit.set_thread_count(1)
    config, data = load(task.config)
    film = config.film
    scene = mitsuba_scene(mi, data, film.width, film.height, None, task.method)
    np.array(mi.render(scene, spp=SAMPLES, seed=2**31 - 1))
    recording, total, passes = Recording(task.seconds), np.zeros((film.height, film.width, 3)), 0
    before = time.process_time()
    while not recording.done:
        total += np.array(mi.render(scene, spp=SAMPLES, seed=100_003 * task.seed + passes))
        passes += 1
        seconds = time.process_time() - before
        if recording.due(seconds, seconds / passes):
            recording.take(total / passes, seconds, seconds / passes, passes * SAMPLES)
    return recording, {"renderer": f"Mitsuba {mi.__version__}", "note": note, "uncounted_cpu_seconds": before}


if __name__ == "__main__":
    own_task = read_task()
    made, told = render(own_task)
    made.write(own_task, told)
