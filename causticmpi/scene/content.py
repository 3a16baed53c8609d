"""What a scene's arrays amount to: their hash, another camera, whether caustics can occur."""

import dataclasses
import hashlib

import msgspec
import numpy as np

from causticmpi.config.check import check_camera
from causticmpi.config.records import Camera
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.scene.data import SceneData


def content_hash(scene: SceneData) -> str:
    """sha256 (hex) of all arrays and the camera: equal for equal scenes, whatever their files are called."""
    digest = hashlib.sha256()
    for name in SceneData.ARRAYS:
        array = np.ascontiguousarray(getattr(scene, name))
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    digest.update(msgspec.json.encode(scene.camera))
    return digest.hexdigest()


def with_camera(scene: SceneData, camera: Camera) -> SceneData:
    """The same scene seen by another camera, with its own hash. Raises InputError for a degenerate camera."""
    check_camera(camera)
    return with_hash(dataclasses.replace(scene, camera=camera))


def with_hash(scene: SceneData) -> SceneData:
    """The same scene with `content_hash` filled in."""
    return dataclasses.replace(scene, content_hash=content_hash(scene))


def extent(scene: SceneData) -> float:
    """Diagonal of the bounding box [scene units]."""
    centres, radii = scene.spheres[:, :3].astype(np.float64), scene.spheres[:, 3:].astype(np.float64)
    points = np.concatenate([scene.vertices.astype(np.float64), centres - radii, centres + radii])
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def has_specular(scene: SceneData) -> bool:
    """Whether any primitive is a mirror or a dielectric; without one there are no caustics to forecast."""
    return bool((scene.material_kind[scene.primitive_material] >= MIRROR).any())
