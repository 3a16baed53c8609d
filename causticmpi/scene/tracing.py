"""From scene data to what the kernels trace: derived arrays, made once and shared by the ranks of a node."""

import math

import numpy as np

from causticmpi.config.records import Camera
from causticmpi.kernels.embree import EmbreeScene
from causticmpi.kernels.material_kinds import LIGHT_BIT
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.scene.data import SceneData

MATERIAL, LIGHT, KIND, SHAPE = 4, 5, 6, 7
"""Columns of `surface` that hold integers: all that a hit asks for lies in one cache line."""


def primitive_arrays(scene: SceneData) -> dict[str, np.ndarray]:
    """The derived arrays of `TracedScene`, by name: made once, shared by the ranks of a node.

    Lights are picked in proportion to their power pi * area * mean radiance.
    """
    v = scene.vertices[scene.triangles].astype(np.float64)  # (T, 3, 3)
    edge1, edge2 = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
    normal = np.cross(edge1, edge2)
    double_area = np.linalg.norm(normal, axis=1)
    triangle_count, sphere_count = len(scene.triangles), len(scene.spheres)
    surface = np.zeros((triangle_count + sphere_count, 8), np.float32)  # half a cache line for each primitive
    surface[:triangle_count, :3] = normal / double_area[:, None]
    surface[:triangle_count, 3] = np.abs(v).max(axis=(1, 2)) if triangle_count else 0
    surface[triangle_count:, :4] = scene.spheres
    area = np.concatenate([double_area / 2, 4 * math.pi * scene.spheres[:, 3].astype(np.float64) ** 2])
    lights = np.flatnonzero(scene.primitive_emission >= 0)
    words = surface.view(np.int32)
    words[:, MATERIAL] = scene.primitive_material
    words[:, KIND] = scene.material_kind[scene.primitive_material]
    words[:, SHAPE] = scene.primitive_shape
    words[:, LIGHT] = -1
    words[lights, LIGHT] = np.arange(len(lights), dtype=np.int32)
    radiance = scene.emission[scene.primitive_emission[lights]].astype(np.float32).reshape(-1, 3)
    power = area[lights] * radiance.mean(axis=1)
    probability = power / power.sum() if len(lights) else power
    corners = np.zeros((3, len(lights), 3), np.float32)
    is_triangle = lights < triangle_count
    corners[:, is_triangle] = np.stack([v[:, 0], edge1, edge2])[:, lights[is_triangle]]
    corners[0, ~is_triangle] = scene.spheres[lights[~is_triangle] - triangle_count, :3]
    light_surface = np.ascontiguousarray(surface[lights, :4]).reshape(-1, 4)
    light_pdf = (probability / area[lights]).astype(np.float32)
    return {
        "surface": surface,
        "primitive_kind": (words[:, KIND] + LIGHT_BIT * (words[:, LIGHT] >= 0)).astype(np.int8),
        "light_corner": corners[0],
        "light_edge1": corners[1],
        "light_edge2": corners[2],
        "light_surface": light_surface,
        "light_radiance": radiance,
        "light_cdf": _closed_cdf(probability),
        "light_pdf": light_pdf,
        "light_row": np.concatenate([*corners, light_surface[:, :3], light_pdf[:, None], radiance], axis=1),
    }


def _closed_cdf(probability: np.ndarray) -> np.ndarray:
    cdf = np.cumsum(probability).astype(np.float32)
    if len(cdf):
        cdf[np.flatnonzero(probability > 0)[-1] :] = 1  # rounding must not leave a gap at the end
    return cdf


def traced_scene(scene: SceneData, embree: EmbreeScene, derived: dict[str, np.ndarray]) -> TracedScene:
    """Put the named tuple together; `derived` are the `primitive_arrays`."""
    words = derived["surface"].view(np.int32)
    return TracedScene(
        handle=embree.handle,
        triangle_count=len(scene.triangles),
        material=words[:, MATERIAL],
        light=words[:, LIGHT],
        kind=scene.material_kind,
        reflectance=scene.material_reflectance,
        specular=scene.material_specular,
        exponent=scene.material_exponent,
        ior=scene.material_ior,
        **derived,
    )


def camera_array(camera: Camera, width: int, height: int) -> np.ndarray:
    """(4, 3) float32: eye, direction to the picture's top left corner, step of one pixel right, step of one down.

    Square pixels; `fov` spans the height.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (camera.eye, camera.target, camera.up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    step = 2 * math.tan(math.radians(camera.fov) / 2) / height
    corner = forward - right * step * width / 2 - down * step * height / 2
    return np.stack([eye, corner, right * step, down * step]).astype(np.float32)
