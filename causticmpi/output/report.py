"""`report.json`: what was rendered, how, how long it took, and where it came from."""

import json
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from causticmpi.output.exr import AttributeValue
from causticmpi.output.picture import Picture, estimated_relmse

# Wall clock, seconds; a stage that a method does not have stays 0.
STAGES = (
    "total",
    "startup",
    "warmup",
    "load",
    "photons",
    "clustering",
    "trees",
    "guides",
    "pilot",
    "broadcast",
    "tracing",
    "tables",
    "reduce",
    "write",
)


def build_report(
    picture: Picture,
    *,
    method: str,
    biased: bool,
    ranks: int,
    passes: int,
    spp: float,
    seed: int,
    nonfinite_samples: int,
    seconds: Mapping[str, float],
    rays: int,
    rays_per_second: float | None = None,
    memory_mb: float,
    provenance: Mapping[str, Any],
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """The report as a plain dict, in the order people read it.

    seconds: wall clock by stage (`STAGES`), missing ones are 0; rays: summed over ranks; rays_per_second: rays /
    seconds["total"] unless given; memory_mb: summed over ranks. width and height are those of the rendered window.
    With fewer than two passes there is no variance: estimated_relmse is None, and `warnings` says why.
    Raises ValueError for a stage that does not exist.
    """
    unknown = sorted(set(seconds) - set(STAGES))
    if unknown:
        raise ValueError(f"no such stage: {', '.join(unknown)}")
    wall = {stage: float(seconds.get(stage, 0.0)) for stage in STAGES}
    notes = list(warnings)
    error: float | None = estimated_relmse(picture.rgb, picture.variance)
    if passes < 2:
        error = None
        notes.append("estimated_relmse is null and the variance layer 0: it takes two passes to estimate a variance")
    if rays_per_second is None:
        rays_per_second = rays / wall["total"] if wall["total"] > 0 else 0.0
    return {
        "method": method,
        "biased": bool(biased),
        "ranks": ranks,
        "passes": passes,
        "spp": spp,
        "width": picture.width,
        "height": picture.height,
        "seed": seed,
        "nonfinite_samples": nonfinite_samples,
        "estimated_relmse": error,
        "seconds": wall,
        "rays": {"total": rays, "per_second": rays_per_second},
        "memory_mb": memory_mb,
        "provenance": dict(provenance),
        "warnings": notes,
    }


def write_report(path: str | os.PathLike[str], report: Mapping[str, Any]) -> None:
    """Write `report` as strict JSON (RFC 8259): a nan or an inf becomes null and is named under "warnings".

    Raises TypeError for a value JSON has no form for, OSError where the file cannot be written.
    """
    nulls: list[str] = []
    plain = _strict(report, "", nulls)
    if nulls:
        plain["warnings"] = [*plain.get("warnings", []), *nulls]
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
    with open(path, "w", encoding="utf-8") as file:
        file.write(text + "\n")


def attributes_from_report(report: Mapping[str, Any], config_text: str) -> dict[str, AttributeValue]:
    """Attributes for the EXR: the resolved config (YAML or JSON text) and what `report` says, so that the picture
    explains itself without the files beside it. `provenance` is JSON text; `seconds` is the total; the version is in
    `software` and `causticmpiVersion`, because the format keeps `version` for itself."""
    source = report["provenance"]
    version = str(source.get("versions", {}).get("causticmpi"))
    attributes: dict[str, AttributeValue] = {
        "software": f"causticmpi {version}",
        "causticmpiVersion": version,
        "config": config_text,
        "biased": "yes" if report["biased"] else "no",
        "seconds": float(report["seconds"]["total"]),
        "command": str(source.get("command")),
        "hosts": " ".join(source.get("hosts", ())),
        "mpi": str(source.get("mpi")),
        "sceneHash": str(source.get("scene_hash")),
        "provenance": json.dumps(_strict(source, "", []), ensure_ascii=False, allow_nan=False),
    }
    attributes.update({name: report[name] for name in ("method", "passes", "spp", "ranks", "seed")})
    attributes["nonfiniteSamples"] = report["nonfinite_samples"]
    if report["passes"] < 2:
        attributes["varianceNote"] = "variance is 0: it takes two passes to estimate one"
    else:
        attributes["varianceNote"] = f"variance of the mean, from {report['passes']} independent passes"
        attributes["estimatedRelmse"] = report["estimated_relmse"]
    return attributes


def provenance(command: str | Sequence[str], world_description: Mapping[str, Any], scene_hash: str) -> dict[str, Any]:
    """Where a picture came from; call it at the start of a run, `started` is the time of this call (UTC, ISO 8601).

    world_description: what the ranks know of themselves, kept whole under "world"; its `hosts` (names, one or many;
    else this machine's name) and `mpi` (library; else "none") are also put at the top.
    Versions come from the installed packages' metadata; None: not installed.
    """
    import datetime
    import platform

    hosts = world_description.get("hosts") or [platform.node()]
    return {
        "command": command if isinstance(command, str) else shlex.join(command),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "scene_hash": scene_hash,
        "hosts": [hosts] if isinstance(hosts, str) else list(dict.fromkeys(hosts)),
        "mpi": world_description.get("mpi") or "none",
        "platform": platform.platform(),
        "versions": _versions(),
        "world": dict(world_description),
    }


def _versions() -> dict[str, str | None]:
    import importlib.metadata
    import platform

    from causticmpi import __version__

    versions: dict[str, str | None] = {"causticmpi": __version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "llvmlite", "embreex", "mpi4py", "mpich", "OpenEXR"):
        try:
            versions[name.lower()] = importlib.metadata.version(name)  # reads metadata, imports nothing
        except importlib.metadata.PackageNotFoundError:
            versions[name.lower()] = None
    return versions


def _strict(value: Any, where: str, nulls: list[str]) -> Any:
    """Python and numpy values to what JSON has; `nulls` collects a line for each non-finite number."""
    if isinstance(value, Mapping):
        return {str(key): _strict(item, f"{where}.{key}" if where else str(key), nulls) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_strict(item, f"{where}[{i}]", nulls) for i, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        nulls.append(f"{where} is null: it was {value}, which JSON has no number for")
        return None
    return os.fspath(value) if isinstance(value, os.PathLike) else value
