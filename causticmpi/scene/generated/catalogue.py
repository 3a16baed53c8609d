"""Meshes the program makes itself, by name: made on first use, then kept beside the compiled kernels."""

import contextlib
import hashlib
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from causticmpi.config.convert import nearest
from causticmpi.errors import InputError
from causticmpi.scene.generated.dragon import dragon
from causticmpi.scene.generated.horse import horse
from causticmpi.scene.generated.tin import lid, tin

MESHES: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
    "horse": horse,
    "dragon": dragon,
    "tin": tin,
    "lid": lid,
}


def generated_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and triangles (T, 3) int32 of a closed mesh, normals outward.

    Where the cache cannot be read or written to, the mesh is made anew. Raises InputError, without a place, for an
    unknown name.
    """
    if name not in MESHES:
        raise InputError(f'generate: found "{name}"; allowed: {", ".join(MESHES)}{nearest(name, MESHES)}')
    path = _cache_path(name)
    mesh = _kept(path)
    if mesh is None:
        print(f"causticmpi: making the mesh {name}, which takes some seconds once", file=sys.stderr, flush=True)
        mesh = MESHES[name]()
        _keep(path, *mesh)
    return mesh


def _cache_path(name: str) -> Path:
    # Late: it brings numba along, and only scenes with generated meshes need it to be read.
    from causticmpi.kernels.jit import cache_directory

    return cache_directory().parent / f"mesh-{name}-{_source_hash()}.npz"


def _source_hash() -> str:
    """Of everything that shapes a mesh: an edited generator never finds its old meshes."""
    digest = hashlib.sha256()
    policy = Path(__file__).parents[2] / "kernels" / "jit.py"
    for source in [*sorted(Path(__file__).parent.glob("*.py")), policy]:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _kept(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The mesh in a cache file; None where there is none, or a damaged one (the format carries checksums)."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["vertices"], file["triangles"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _keep(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write the cache file whole or not at all; a cache that cannot be written to is no error."""
    with contextlib.suppress(OSError):
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, vertices=vertices, triangles=triangles)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
