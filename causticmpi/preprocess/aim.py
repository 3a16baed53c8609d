"""Where forecast photons are aimed: an invisible box around chosen objects, or around all specular ones [CF sec. 3.2].

Only forecasts are aimed. Virtual lights never are.
"""

import numpy as np

from causticmpi.config.records import Box
from causticmpi.errors import InputError
from causticmpi.kernels.aim import NATURAL
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.preprocess.photons import shoot_photons
from causticmpi.scene.data import SceneData

SHARE = 0.75
"""Share of aimed particles; the others leave as light does, and find what lies outside the box."""
TRIAL = 500
"""Caustic points to find either way, before `auto` takes aim."""
PAYS = 2.0
"""Times as many caustic points for each ray as natural emission finds: aiming pays from there on. 1.6 in a Cornell box,
2.3 at a pool, 5 at a ring, 47 at figurines in a large room; the noise of a pass was the same in all of them."""


def emission_aim(setting: str | Box, scene: SceneData) -> np.ndarray:
    """Aim (7,) float32 of `forecast.aim` (see kernels.aim).

    Raises InputError for a box that holds no specular surface or lies behind every light. `auto` is natural emission
    where it would raise.
    """
    if setting == "off":
        return NATURAL
    low, high = specular_boxes(scene)
    if isinstance(setting, str):
        if len(low) == 0:
            return NATURAL
        box = np.concatenate([low.min(axis=0), high.max(axis=0)])
        return _aim(box) if _seen(box, scene) else NATURAL
    box = np.array([*setting.min, *setting.max])
    found = f"forecast.aim: found a box from {list(setting.min)} to {list(setting.max)}, which"
    if not ((low <= box[3:]) & (high >= box[:3])).all(axis=1).any():
        where = "the scene has none" if len(low) == 0 else f"they lie between {low.min(axis=0)} and {high.max(axis=0)}"
        raise InputError(f"{found} holds no specular surface; allowed: a box around some ({where}); write aim: auto")
    if not _seen(box, scene):
        raise InputError(f"{found} lies behind every light; allowed: a box that a light shines at; write aim: off")
    return _aim(box)


def aim_that_pays(aim: np.ndarray, scene: TracedScene, seed: int) -> np.ndarray:
    """`aim` if it finds caustic points that much faster than natural emission, else the latter; counted in rays, never
    by the clock."""
    if not aim.any():
        return NATURAL
    natural, aimed = (_points_per_ray(scene, seed, way) for way in (NATURAL, aim))
    return aim if aimed > PAYS * natural else NATURAL


def _points_per_ray(scene: TracedScene, seed: int, aim: np.ndarray) -> float:
    points, _, rays = shoot_photons(scene, seed, TRIAL, aim)
    return len(points.power) / max(rays, 1)


def _aim(box: np.ndarray) -> np.ndarray:
    return np.append(box, SHARE).astype(np.float32)


def specular_boxes(scene: SceneData) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corner of every specular triangle and sphere, (n, 3) float64 each."""
    specular = scene.material_kind[scene.primitive_material] >= MIRROR
    triangles = len(scene.triangles)
    corners = scene.vertices[scene.triangles[specular[:triangles]]].astype(np.float64)
    spheres = scene.spheres[specular[triangles:]].astype(np.float64)
    centre, radius = spheres[:, :3], spheres[:, 3:]
    low = np.concatenate([corners.min(axis=1), centre - radius])
    return low, np.concatenate([corners.max(axis=1), centre + radius])


def _seen(box: np.ndarray, scene: SceneData) -> bool:
    """Whether any corner of the box lies before the plane of a light; light spheres shine all around."""
    lights = np.flatnonzero(scene.primitive_emission >= 0)
    triangles = lights[lights < len(scene.triangles)]
    if len(triangles) < len(lights):
        return True
    v = scene.vertices[scene.triangles[triangles]].astype(np.float64)
    normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    reach = np.maximum(normal * (box[:3] - v[:, 0]), normal * (box[3:] - v[:, 0])).sum(axis=1)
    return bool((reach > 0).any())
