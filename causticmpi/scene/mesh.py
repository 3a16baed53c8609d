"""Mesh files (PLY, OBJ) and generated meshes -> triangles."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.errors import InputError, reason
from causticmpi.scene.generated.catalogue import generated_mesh
from causticmpi.scene.geometry import Triangles, ZeroAreaError, as_float32, has_area
from causticmpi.scene.records import Mesh

FORMATS = (".ply", ".obj")


def mesh_triangles(mesh: Mesh, folder: Path) -> Triangles:
    """The mesh's triangles in scene units, without those of zero area. `folder` is the scene file's.

    Raises InputError, without a place, for a file that cannot be read or holds no usable triangle, and for an unknown
    generated mesh.
    """
    if mesh.smooth:
        raise InputError(
            "smooth: found true; allowed: false (interpolated normals make light's and eye's transport unlike"
            " each other); tessellate the mesh finer"
        )
    if mesh.file is not None and mesh.generate is None:
        path = folder / mesh.file
        name = f"file: {path}"
        points, faces = _read(path)
    elif mesh.generate is not None and mesh.file is None:
        name = f"generate: {mesh.generate}"
        points, faces = generated_mesh(mesh.generate)
    elif mesh.file is None:
        raise InputError(
            'missing key "file"; add `file: my.ply`, or `generate: horse` for a mesh of the program\'s own'
        )
    else:
        raise InputError("generate: found beside a file; allowed: one of the two; remove the other")
    # A huge but finite scale or file may overflow here; as_float32 reports what does not fit.
    with np.errstate(over="ignore", invalid="ignore"):
        points = transformed(points, mesh)
    vertices = as_float32(points, f"{name}, after scale, rotate and translate")
    kept = has_area(vertices, faces)
    if not kept.any():
        raise ZeroAreaError(f"{name} has only triangles of zero area; repair or scale the mesh")
    used, renumbered = np.unique(faces[kept], return_inverse=True)
    return Triangles(vertices[used], renumbered.reshape(-1, 3).astype(np.int32), int((~kept).sum()))


def transformed(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(V, 3) float64: `points` scaled, turned about the fixed x, then y, then z axis, then moved."""
    scale = np.broadcast_to(np.array(mesh.scale, dtype=np.float64), 3)
    if not (scale > 0.0).all():
        raise InputError(
            f"scale: found {mesh.scale}; allowed: numbers > 0 (a mirrored mesh has its normals inside out);"
            " mirror it in the file instead"
        )
    about_x, about_y, about_z = (_rotation(axis, angle) for axis, angle in enumerate(mesh.rotate))
    return (points * scale) @ (about_z @ about_y @ about_x).T + np.array(mesh.translate, dtype=np.float64)


def _rotation(axis: int, degrees: float) -> np.ndarray:
    """(3, 3): right-handed rotation about a coordinate axis; exact for quarter turns."""
    quarter, rest = divmod(degrees, 90.0)
    c, s = math.cos(math.radians(rest)), math.sin(math.radians(rest))
    c, s = ((c, s), (-s, c), (-c, -s), (s, -c))[int(quarter % 4)]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) int64 as the file has them."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"file: found {path}; allowed: {' or '.join(FORMATS)}; convert the mesh")
    try:
        raw = path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"file: cannot read {path}: {reason(error)}; the path is relative to the scene file") from None
    # Late: only scenes with meshes pay for it.
    import trimesh

    try:
        # Numbers beyond float32 become infinite, which is reported below: no second line on stderr.
        with np.errstate(all="ignore"):
            loaded: Any = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        points = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever its parser happens to meet
        why = " ".join(str(error).split())[:120]
        raise InputError(f"file: {path} is no readable mesh ({why}); export it anew") from None
    _check_complete(path, raw, len(faces))
    _check_usable(path, points, faces)
    return points, faces


def _check_usable(path: Path, points: np.ndarray, faces: np.ndarray) -> None:
    """Raises InputError for vertices and faces that are none."""
    if not np.isfinite(points).all():
        raise InputError(f"file: {path} has vertices that are not finite numbers; repair the mesh")
    if not len(faces):
        raise InputError(f"file: {path} has no triangles; export it with faces")
    if faces.min() < 0 or faces.max() >= len(points):
        raise InputError(
            f"file: {path} has a face that names vertex {int(faces.max() if faces.min() >= 0 else faces.min())};"
            f" allowed: 0 to {len(points) - 1}; repair the mesh"
        )


def _check_complete(path: Path, raw: bytes, faces: int) -> None:
    """Raises InputError for damage that trimesh passes over: a text PLY cut short, an OBJ face with vertex 0."""
    if path.suffix.lower() == ".ply":
        declared = re.search(rb"element\s+face\s+(\d+)", raw[:65536])
        if declared and faces < int(declared.group(1)):
            raise InputError(
                f"file: {path} declares {int(declared.group(1))} faces and holds {faces} triangles; export it anew"
            )
    elif re.search(rb"^[ \t]*f[ \t](?:[^\r\n#]*[ \t])?[-+]?0+(?=[/\s]|\Z)", raw, re.MULTILINE):
        raise InputError(f"file: {path} has a face that names vertex 0; OBJ counts from 1; repair the mesh")
