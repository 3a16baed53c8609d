"""Materials of a scene file -> rows of the material arrays."""

from typing import NamedTuple

import numpy as np

from causticmpi.errors import InputError
from causticmpi.kernels.material_kinds import DIELECTRIC, DIFFUSE, MIRROR, PHONG
from causticmpi.scene.records import Dielectric, Diffuse, Material, Mirror, Spectrum

MAX_RADIANCE = 1e18
"""Sums and products of radiances must stay within float32."""
MAX_EXPONENT = 1e6
"""Phong exponents beyond it are narrower than float32 directions resolve."""
_SLACK = 1e-6
"""For sums such as 0.7 + 0.3 that binary numbers round above 1."""
_BLACK = (0.0, 0.0, 0.0)


class MaterialRow(NamedTuple):
    """One row of the material arrays of SceneData."""

    kind: int
    reflectance: tuple[float, ...] = _BLACK
    specular: tuple[float, ...] = _BLACK
    exponent: float = 0.0
    ior: float = 1.0


class MaterialTable:
    """Rows in the file's order, with their names."""

    def __init__(self) -> None:
        self.rows: dict[str, int] = {}
        self._table: list[MaterialRow] = []

    @property
    def kinds(self) -> list[int]:
        """Kind of each row."""
        return [row.kind for row in self._table]

    def add(self, name: str, row: MaterialRow) -> None:
        """Append one row under its name."""
        self.rows[name] = len(self._table)
        self._table.append(row)

    def arrays(self) -> dict[str, np.ndarray]:
        """The material arrays of SceneData by name."""
        return {
            "material_kind": np.array(self.kinds, dtype=np.int32),
            "material_reflectance": np.array([row.reflectance for row in self._table], dtype=np.float32),
            "material_specular": np.array([row.specular for row in self._table], dtype=np.float32),
            "material_exponent": np.array([row.exponent for row in self._table], dtype=np.float32),
            "material_ior": np.array([row.ior for row in self._table], dtype=np.float32),
        }


def material_row(material: Material) -> MaterialRow:
    """The row of one material. Raises InputError, without a place, where it would create energy."""
    if isinstance(material, Diffuse):
        return MaterialRow(DIFFUSE, _albedo(material.reflectance, "reflectance"))
    if isinstance(material, Mirror):
        return MaterialRow(MIRROR, _albedo(material.reflectance, "reflectance"))
    if isinstance(material, Dielectric):
        return MaterialRow(DIELECTRIC, (1.0, 1.0, 1.0), ior=material.ior)
    diffuse = _albedo(material.diffuse, "diffuse")
    specular = _albedo(material.specular, "specular")
    total = max(d + s for d, s in zip(diffuse, specular, strict=True))
    if total > 1.0 + _SLACK:
        raise InputError(
            f"found diffuse + specular = {total:g} in a channel; allowed: up to 1 (a surface conserves energy);"
            " lower one of them"
        )
    if material.exponent > MAX_EXPONENT:
        raise InputError(
            f"exponent: found {material.exponent:g}; allowed: up to {MAX_EXPONENT:g}; use a mirror for a sharper lobe"
        )
    return MaterialRow(PHONG, diffuse, specular, material.exponent)


def emission_spectrum(emission: Spectrum) -> tuple[float, ...]:
    """Radiance per channel, float32 values. Raises InputError, without a place, for a negative or absurd one."""
    channels = _channels(emission)
    if not all(0.0 <= channel <= MAX_RADIANCE for channel in channels):
        raise InputError(
            f"found {_show(emission)}; allowed: one number or three, each from 0 to {MAX_RADIANCE:g};"
            " write for example 15"
        )
    # As float32 stores them: a radiance that underflows emits nothing.
    return tuple(float(np.float32(channel)) for channel in channels)


def _albedo(spectrum: Spectrum, name: str) -> tuple[float, ...]:
    channels = _channels(spectrum)
    if not all(0.0 <= channel <= 1.0 for channel in channels):
        raise InputError(
            f"{name}: found {_show(spectrum)}; allowed: one number or three, each from 0 to 1; write for example 0.7"
        )
    return channels


def _channels(spectrum: Spectrum) -> tuple[float, ...]:
    return spectrum if isinstance(spectrum, tuple) else (spectrum,) * 3


def _show(spectrum: Spectrum) -> str:
    return str(list(spectrum)) if isinstance(spectrum, tuple) else f"{spectrum:g}"
