"""A scene as a list of surfaces, one material each: what every other renderer's exporter starts from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from causticmpi.errors import InputError
from causticmpi.kernels.material_kinds import DIELECTRIC, DIFFUSE, MIRROR, PHONG
from causticmpi.scene.data import SceneData

KINDS = {DIFFUSE: "diffuse", MIRROR: "mirror", DIELECTRIC: "dielectric"}
"""Materials that all renderers know alike."""


@dataclass(frozen=True)
class Surface:
    """A mesh, or a sphere, of one material.

    kind: of KINDS; reflectance: (3,) of a diffuse surface or mirror; ior: of a dielectric, inside over outside;
    radiance: (3,) leaving the front, None where it emits nothing.
    vertices (V, 3) float32, triangles (T, 3) int32: flat shaded, front by the right-hand rule, empty for a sphere;
    sphere: centre and radius, None for a mesh.
    """

    name: str
    kind: str
    reflectance: tuple[float, ...]
    ior: float
    radiance: tuple[float, ...] | None
    vertices: np.ndarray
    triangles: np.ndarray
    sphere: tuple[float, ...] | None = None


def surfaces(scene: SceneData, level: int | None = None) -> list[Surface]:
    """All surfaces of a scene. level: spheres become icospheres of 20 * 4^level triangles; None leaves them.

    Raises InputError for a Phong-like material, which other renderers have not, or not with this lobe.
    """
    count = len(scene.triangles)
    found = []
    looks = np.stack([scene.primitive_material[:count], scene.primitive_emission[:count]], axis=1)
    for i, (material, emission) in enumerate(np.unique(looks, axis=0)):
        faces = scene.triangles[(looks == (material, emission)).all(axis=1)]
        used, renumbered = np.unique(faces, return_inverse=True)
        mesh = (scene.vertices[used], renumbered.reshape(-1, 3).astype(np.int32))
        found.append(Surface(f"mesh{i}", *_look(scene, material, emission), *mesh))
    for i, row in enumerate(scene.spheres):
        look = _look(scene, scene.primitive_material[count + i], scene.primitive_emission[count + i])
        if level is None:
            nothing = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
            found.append(Surface(f"sphere{i}", *look, *nothing, sphere=tuple(map(float, row))))
        else:
            found.append(Surface(f"sphere{i}", *look, *icosphere(row[:3], row[3], level)))
    return found


def _look(scene: SceneData, material: int, emission: int) -> tuple[str, tuple[float, ...], float, tuple | None]:
    kind = int(scene.material_kind[material])
    if kind == PHONG:
        raise InputError(f"{scene.name}: found a phong material; allowed here: {', '.join(KINDS.values())}")
    radiance = tuple(scene.emission[emission].tolist()) if emission >= 0 else None
    reflectance = tuple(scene.material_reflectance[material].tolist())
    return KINDS[kind], reflectance, float(scene.material_ior[material]), radiance


def icosphere(centre: np.ndarray, radius: float, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on the sphere, (V, 3) float32, and triangles (20 * 4^level, 3) int32, fronts outward."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=level, radius=float(radius))
    return (ball.vertices + centre).astype(np.float32), ball.faces.astype(np.int32)


def write_ply(surface: Surface, path: Path) -> None:
    """A mesh as binary PLY without normals: every reader then shades it flat."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    mesh.export(path, file_type="ply", vertex_normal=False)
