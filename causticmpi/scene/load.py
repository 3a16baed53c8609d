"""A scene file -> SceneData."""

from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from causticmpi.config.check import check_camera
from causticmpi.config.convert import convert, nearest, show
from causticmpi.config.yaml_source import Keys, YamlSource, read_yaml
from causticmpi.errors import InputError
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.scene.content import with_hash
from causticmpi.scene.data import SceneData
from causticmpi.scene.geometry import Triangles, ZeroAreaError, box_triangles, quad_triangles, sphere_row
from causticmpi.scene.materials import MaterialTable, emission_spectrum, material_row
from causticmpi.scene.mesh import mesh_triangles
from causticmpi.scene.records import MATERIALS, SHAPES, Box, Mesh, Quad, SceneFile, Sphere

T = TypeVar("T")
AnyShape = Quad | Sphere | Box | Mesh
_POINT_LIGHT = " (a light needs an area: caustics of point lights are out of this method's reach)"


def load_scene(path: str | Path) -> SceneData:
    """Read, validate and flatten a scene file; mesh paths are relative to it.

    Raises InputError with file:line for whatever cannot be rendered.
    """
    source = read_yaml(path)
    scene = convert(source, (), source.data, SceneFile)
    with source.placing(("camera",)):
        check_camera(scene.camera)
    materials = MaterialTable()
    for name, value in scene.materials.items():
        keys: Keys = ("materials", name)
        material = convert(source, keys, value, _kind(source, keys, value, MATERIALS))
        with source.placing(keys):
            materials.add(name, material_row(material))
    builder = _Builder(source, materials)
    for i, value in enumerate(scene.shapes):
        keys = ("shapes", i)
        shape = convert(source, keys, value, _kind(source, keys, value, SHAPES))
        builder.add(keys, shape)
    if not builder.emission:
        raise source.error(
            ("shapes",), "no shape emits light; needs at least one; add for example `emission: [15, 15, 15]` to a quad"
        )
    return builder.scene(scene, Path(path).stem)


class _Builder:
    """Collects shapes; triangles come before spheres in the numbering of primitives."""

    def __init__(self, source: YamlSource, materials: MaterialTable) -> None:
        self.source = source
        self.materials = materials
        self.emission: dict[tuple[float, ...], int] = {}
        self.meshes: list[tuple[Triangles, int, int]] = []
        self.spheres: list[tuple[np.ndarray, int, int]] = []

    def add(self, keys: Keys, shape: AnyShape) -> None:
        """Flatten one shape. Raises InputError with its place."""
        rows = self.materials.rows
        if shape.material not in rows:
            raise self.source.error(
                (*keys, "material"),
                f'found "{shape.material}"; allowed: {", ".join(rows) or "none, for the scene has no materials"}'
                f"{nearest(shape.material, rows)}",
            )
        material = rows[shape.material]
        with self.source.placing((*keys, "emission")):
            emission = self.emission_row(shape, material)
        with self.source.placing(keys):
            try:
                if isinstance(shape, Sphere):
                    self.spheres.append((sphere_row(shape), material, emission))
                else:
                    self.meshes.append((self.triangles(shape), material, emission))
            except ZeroAreaError as error:
                reason = _POINT_LIGHT if emission >= 0 else ""
                raise InputError(f"{error}{reason}") from None

    def triangles(self, shape: Quad | Box | Mesh) -> Triangles:
        if isinstance(shape, Quad):
            return quad_triangles(shape)
        if isinstance(shape, Box):
            return box_triangles(shape)
        return mesh_triangles(shape, self.source.file.parent)

    def emission_row(self, shape: AnyShape, material: int) -> int:
        """Row of the shape's radiance, equal ones shared; -1 where it emits nothing."""
        radiance = emission_spectrum(shape.emission)
        if not any(radiance):
            return -1
        if self.materials.kinds[material] >= MIRROR:
            raise InputError(
                f'found emission on the specular material "{shape.material}"; allowed: on diffuse or phong;'
                " give the light a black diffuse material"
            )
        return self.emission.setdefault(radiance, len(self.emission))

    def scene(self, file: SceneFile, name: str) -> SceneData:
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _, _ in self.meshes)])
        rows = [(len(mesh.triangles), m, e) for mesh, m, e in self.meshes] + [(1, m, e) for _, m, e in self.spheres]
        counts = [count for count, _, _ in rows]
        return with_hash(
            SceneData(
                vertices=_stacked([mesh.vertices for mesh, _, _ in self.meshes], 3, np.float32),
                triangles=_stacked(
                    [mesh.triangles + start for (mesh, _, _), start in zip(self.meshes, starts, strict=False)],
                    3,
                    np.int32,
                ),
                spheres=_stacked([row[None] for row, _, _ in self.spheres], 4, np.float32),
                primitive_material=np.repeat(np.array([m for _, m, _ in rows], dtype=np.int32), counts),
                primitive_emission=np.repeat(np.array([e for _, _, e in rows], dtype=np.int32), counts),
                primitive_shape=np.repeat(np.arange(len(rows), dtype=np.int32), counts),
                emission=np.array(list(self.emission), dtype=np.float32),
                **self.materials.arrays(),
                camera=file.camera,
                name=name,
                content_hash="",
                dropped_triangles=sum(mesh.dropped for mesh, _, _ in self.meshes),
            )
        )


def _stacked(parts: list[np.ndarray], width: int, dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros((0, width), dtype), *parts]).astype(dtype)


def _kind(source: YamlSource, keys: Keys, value: Any, kinds: dict[str, type[T]]) -> type[T]:
    """The record that `type` names."""
    allowed = ", ".join(kinds)
    if not isinstance(value, dict):
        raise source.error(keys, f"found {show(value)}; allowed: a section with a type ({allowed}) and its keys")
    if "type" not in value:
        raise source.error(keys, f'missing key "type"; add `type: {next(iter(kinds))}` (allowed: {allowed})')
    kind = value["type"]
    if not isinstance(kind, str) or kind not in kinds:
        raise source.error((*keys, "type"), f"found {show(kind)}; allowed: {allowed}{nearest(str(kind), kinds)}")
    return kinds[kind]
