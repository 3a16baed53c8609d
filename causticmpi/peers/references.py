"""The pictures that errors are measured against, in the form that `causticmpi compare` measures with."""

from pathlib import Path

import numpy as np

from causticmpi.compare.files import read_layers
from causticmpi.compare.metrics import ReferencePicture
from causticmpi.errors import InputError


def find_reference(folder: Path, scene: str, shape: tuple[int, int]) -> ReferencePicture | None:
    """`SCENE.npz` with halves, or the folder SCENE with a `reference.exr` of `causticmpi compare`; None without.

    Raises InputError for a picture of another size.
    """
    npz, exr = folder / f"{scene}.npz", folder / scene / "reference.exr"
    if npz.exists():
        with np.load(npz) as file:
            found = from_halves(file["half1"], file["half2"])
        place = npz
    elif exr.exists():
        layers = read_layers(exr)
        found, place = ReferencePicture(layers.rgb, layers.caustic, layers.variance, {}), exr
    else:
        return None
    height, width, _ = found.rgb.shape
    if (height, width) != shape:
        raise InputError(f"found {width} x {height} pixels, need {shape[1]} x {shape[0]}: give another one", place)
    return found


def from_halves(first: np.ndarray, second: np.ndarray) -> ReferencePicture:
    """The mean M of two independent pictures A and B. Its variance is taken as ((A - B) / 2)^2, so that an error less
    that variance is (e - M)^2 - ((A - B) / 2)^2 = (e - A)(e - B): the noise of the halves cancels in the mean."""
    a, b = first.astype(np.float64), second.astype(np.float64)
    a, b = np.broadcast_to(a, (*a.shape[:2], 3)), np.broadcast_to(b, (*b.shape[:2], 3))
    return ReferencePicture((a + b) / 2, np.zeros_like(a), ((a - b) / 2) ** 2, {})
