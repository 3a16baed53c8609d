#!/usr/bin/env python3
"""Path tracing of causticmpi beside Mitsuba 3 (`llvm_ad_rgb`, `path`) in one run: paths per CPU second, one core.

    python scripts/peer_mitsuba.py configs/cornell.yaml [--rounds 5] [--tessellate LEVEL]

needs `pip install -e '.[peers]'` and an LLVM library (16 or later on processors with AVX512-FP16; DRJIT_LIBLLVM_PATH
names it). Both render the same triangles, spheres, camera and lights; --tessellate gives Mitsuba icospheres of that
level instead of its own spheres. Rounds are interleaved; the ratio is taken within each round.
"""

import argparse
import statistics
import time
from typing import Any

import numpy as np

from causticmpi.bench.subjects import Subject
from causticmpi.scene.data import DIELECTRIC, DIFFUSE, MIRROR, SceneData

SAMPLES = 4


def mitsuba_scene(mi: Any, scene: SceneData, width: int, height: int, level: int | None) -> Any:
    """The scene as Mitsuba's; depth 24, roulette from depth 5 on, as its users would have it."""
    camera = scene.camera
    parts: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": camera.fov,
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=list(camera.eye), target=list(camera.target), up=list(camera.up)
            ),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        },
        "integrator": {"type": "path", "max_depth": 24, "rr_depth": 5},
    }
    count = len(scene.triangles)
    groups = np.stack([scene.primitive_material[:count], scene.primitive_emission[:count]], axis=1)
    for i, (material, emission) in enumerate(np.unique(groups, axis=0)):
        faces = scene.triangles[(groups == (material, emission)).all(axis=1)]
        parts[f"mesh{i}"] = _mesh(mi, scene.vertices, faces, _properties(scene, material, emission), f"mesh{i}")
    for i, (x, y, z, radius) in enumerate(scene.spheres.tolist()):
        properties = _properties(scene, scene.primitive_material[count + i], scene.primitive_emission[count + i])
        if level is None:
            shape = {"type": "sphere", "center": [x, y, z], "radius": radius, **properties}
        else:
            import trimesh

            ball = trimesh.creation.icosphere(subdivisions=level, radius=radius)
            shape = _mesh(mi, ball.vertices + [x, y, z], ball.faces, properties, f"sphere{i}")
        parts[f"sphere{i}"] = shape
    return mi.load_dict(parts)


def _properties(scene: SceneData, material: int, emission: int) -> dict[str, Any]:
    def rgb(value: np.ndarray) -> dict[str, Any]:
        return {"type": "rgb", "value": value.tolist()}

    kind = scene.material_kind[material]
    reflectance = scene.material_reflectance[material]
    if kind == DIFFUSE:
        bsdf: dict[str, Any] = {"type": "twosided", "b": {"type": "diffuse", "reflectance": rgb(reflectance)}}
    elif kind == MIRROR:
        bsdf = {"type": "twosided", "b": {"type": "conductor", "specular_reflectance": rgb(reflectance)}}
        bsdf["b"]["material"] = "none"
    elif kind == DIELECTRIC:
        bsdf = {"type": "dielectric", "int_ior": float(scene.material_ior[material]), "ext_ior": 1.0}
    else:
        raise SystemExit("this comparison knows diffuse, mirror and dielectric materials")
    properties: dict[str, Any] = {"bsdf": bsdf}
    if emission >= 0:
        properties["emitter"] = {"type": "area", "radiance": rgb(scene.emission[emission])}
    return properties


def _mesh(mi: Any, vertices: np.ndarray, faces: np.ndarray, properties: dict[str, Any], name: str) -> Any:
    props = mi.Properties()
    for key, value in properties.items():
        props[key] = mi.load_dict(value)
    mesh = mi.Mesh(name, len(vertices), len(faces), props=props, has_vertex_normals=False)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    parameters.update()
    return mesh


def main() -> None:
    """Run the rounds and print a line for each renderer and one for the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tessellate", type=int, metavar="LEVEL")
    arguments = parser.parse_args()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    subject = Subject(arguments.config)
    film = subject.config.film
    scene = mitsuba_scene(mi, subject.scene.data, film.width, film.height, arguments.tessellate)
    np.array(mi.render(scene, spp=SAMPLES, seed=0))
    ours, theirs = [], []
    for i in range(arguments.rounds):
        subject.path_tracing()
        ours.append(subject.path_rates[-1])
        began = time.process_time()
        picture = np.array(mi.render(scene, spp=SAMPLES, seed=1 + i))
        seconds = time.process_time() - began
        theirs.append(film.width * film.height * SAMPLES / seconds / 1e6)
    mean = subject.film.reshape(-1, 2, 3).sum(axis=1).mean() / len(ours)
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    for name, values in (("causticmpi pt", ours), (f"mitsuba {mi.__version__} path", theirs)):
        print(
            f"{name:24} {statistics.median(values):.3f} Mpaths per CPU second ({min(values):.3f} - {max(values):.3f})"
        )
    print(f"{'ratio':24} {statistics.median(ratios):.2f} ({min(ratios):.2f} - {max(ratios):.2f})")
    print(f"{'mean radiance':24} ours {mean:.4f}, theirs {picture.mean():.4f}")


if __name__ == "__main__":
    main()
