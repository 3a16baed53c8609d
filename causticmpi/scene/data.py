"""A scene as flat arrays: what every rank needs to trace it, and nothing else.

Primitives are numbered through: triangles first (0 … T-1), then spheres (T … T+S-1).
"""

from dataclasses import dataclass

import numpy as np

from causticmpi.config.records import Camera


@dataclass(frozen=True)
class SceneData:
    """Flat scene arrays.

    vertices            (V, 3) float32, scene units
    triangles           (T, 3) int32, counter-clockwise seen from the front
    spheres             (S, 4) float32: centre, radius
    primitive_material  (T+S,) int32: row of the material arrays
    primitive_emission  (T+S,) int32: row of `emission`, or -1
    primitive_shape     (T+S,) int32: number of its shape, triangles' first as primitives are
    material_kind       (M,) int32: see kernels.material_kinds
    material_reflectance(M, 3) float32: diffuse albedo, or reflectance of a mirror (1 for a dielectric)
    material_specular   (M, 3) float32: albedo of the Phong lobe (0 elsewhere)
    material_exponent   (M,) float32: Phong exponent (0 elsewhere)
    material_ior        (M,) float32: n inside / n outside of a dielectric (1 elsewhere)
    emission            (E, 3) float32: radiance leaving the front side
    dropped_triangles   triangles of zero area that the mesh files had and the arrays have not
    """

    vertices: np.ndarray
    triangles: np.ndarray
    spheres: np.ndarray
    primitive_material: np.ndarray
    primitive_emission: np.ndarray
    primitive_shape: np.ndarray
    material_kind: np.ndarray
    material_reflectance: np.ndarray
    material_specular: np.ndarray
    material_exponent: np.ndarray
    material_ior: np.ndarray
    emission: np.ndarray
    camera: Camera
    name: str
    content_hash: str
    dropped_triangles: int = 0

    ARRAYS = (
        "vertices",
        "triangles",
        "spheres",
        "primitive_material",
        "primitive_emission",
        "primitive_shape",
        "material_kind",
        "material_reflectance",
        "material_specular",
        "material_exponent",
        "material_ior",
        "emission",
    )
