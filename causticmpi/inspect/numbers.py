"""The findings as plain numbers: for JSON, and as text for the terminal."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from causticmpi.distributed.usage import peak_memory_mb
from causticmpi.inspect.findings import Findings
from causticmpi.preprocess.forecast import CULLED
from causticmpi.preprocess.packed_photons import unpacked_row
from causticmpi.preprocess.parallax import HEIGHT
from causticmpi.scene.data import SceneData

KINDS = ("diffuse", "phong", "mirror", "dielectric")
"""Names of the material kinds of `SceneData`, by number."""
MB = 2.0**20


def numbers(found: Findings) -> dict[str, Any]:
    """Everything, in the order people read it. Lengths in scene units, energy in fractions of the caustic points' flux,
    angles in degrees, memory in MB (2^20 bytes), seconds of wall clock."""
    direct = int((found.lights.material < 0).sum())
    paths = found.light_passes * found.config.iws.paths
    forecasting = found.forecasting
    told: dict[str, Any] = {
        "scene": _scene(found.scene.data, found.scene.extent),
        "virtual_lights": {
            "passes": found.light_passes,
            "paths": paths,
            "direct": direct,
            "indirect": len(found.lights.material) - direct,
            "per_pass": len(found.lights.material) / found.light_passes,
        },
        "caustic_points": {
            "wanted": found.config.forecast.photons,
            "found": len(found.points.power),
            "particles": forecasting.emitted,
            "particles_per_point": forecasting.emitted / len(found.points.power) if len(found.points.power) else None,
            "rays": forecasting.rays,
        },
        "silence": found.silence or None,
        "warnings": list(forecasting.warnings),
        "seconds": found.seconds,
        "memory_mb": _memory(found),
    }
    if found.statistics is not None:
        told["clusters"] = _clusters(found)
    return told


def _scene(scene: SceneData, extent: float) -> dict[str, Any]:
    kinds = np.bincount(scene.material_kind[scene.primitive_material], minlength=len(KINDS))
    return {
        "name": scene.name,
        "content_hash": scene.content_hash,
        "triangles": len(scene.triangles),
        "spheres": len(scene.spheres),
        "dropped_triangles": scene.dropped_triangles,
        "emitting_primitives": int((scene.primitive_emission >= 0).sum()),
        "primitives_by_material": {kind: int(n) for kind, n in zip(KINDS, kinds, strict=True)},
        "extent": extent,
    }


def _memory(found: Findings) -> dict[str, float]:
    scene, maps = found.scene, found.forecasting.maps
    derived = [value for value in scene.traced if isinstance(value, np.ndarray)]
    own = [getattr(scene.data, name) for name in scene.data.ARRAYS]
    return {
        "scene_arrays_per_node": sum({id(a): a.nbytes for a in (*own, *derived)}.values()) / MB,
        "embree_per_rank": scene.embree.bytes / MB,
        "forecast_maps_per_node": sum(a.nbytes for a in maps if isinstance(a, np.ndarray)) / MB,
        "caustic_points_while_made": sum(a.nbytes for a in found.points) / MB,
        "peak_of_this_process": peak_memory_mb(),
    }


def _clusters(found: Findings) -> dict[str, Any]:
    statistics, maps = found.statistics, found.forecasting.maps
    assert statistics is not None
    held = np.diff(maps.start)
    ranked = statistics.rank <= maps.max_rank
    radius = np.sqrt(statistics.area / np.pi)
    height = unpacked_row(maps.anchor_photon, HEIGHT).astype(np.float64)
    cone = np.degrees(np.arccos(1 - height[height > 0]))
    by_rank = []
    for rank in np.unique(statistics.rank).tolist():
        these = statistics.rank == rank
        by_rank.append(
            {
                "rank": rank if rank != CULLED else None,
                "clusters": int(these.sum()),
                "caustic_points": int(statistics.photons[these].sum()),
                "energy": float(statistics.energy[these].sum()),
                "energy_so_far": float(statistics.energy[statistics.rank <= rank].sum()),
            }
        )
    return {
        "count": len(statistics.rank),
        "used": int(ranked.sum()),
        "culled": int((~ranked).sum()),
        "max_rank": maps.max_rank,
        "search_radius": statistics.radius,
        "overlap": statistics.overlap,
        "forecast_points": int(held.sum()),
        "caustic_points": _spread(statistics.photons),
        "energy": _spread(statistics.energy),
        "radius": _spread(radius),
        "anchors": int((maps.anchor_count > 0).sum()),
        "cone_half_angle": _spread(cone) if len(cone) else None,
        "by_rank": by_rank,
        "each": {
            "rank": statistics.rank.tolist(),
            "caustic_points": statistics.photons.tolist(),
            "forecast_points": held.tolist(),
            "energy": statistics.energy.tolist(),
            "radius": radius.tolist(),
        },
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    return {name: float(f(values)) for name, f in (("least", np.min), ("median", np.median), ("greatest", np.max))}


def table(told: Mapping[str, Any]) -> str:
    """The numbers as aligned text."""
    scene, lights, points, memory = (told[k] for k in ("scene", "virtual_lights", "caustic_points", "memory_mb"))
    kinds = ", ".join(f"{n:,} {kind}" for kind, n in scene["primitives_by_material"].items() if n)
    rows = [
        ("scene", f"{scene['name']}: {scene['triangles']:,} triangles, {scene['spheres']} spheres"),
        ("", f"{kinds}; {scene['emitting_primitives']} emit; {scene['dropped_triangles']} dropped"),
        ("", f"{scene['extent']:.4g} scene units across"),
        (
            "virtual lights",
            f"{lights['direct']} direct, {lights['indirect']} indirect in {lights['passes']} passes of "
            f"{lights['paths'] // lights['passes']} paths: {lights['per_pass']:.1f} a pass",
        ),
    ]
    if points["found"]:
        each = f"{points['particles_per_point']:.3g} particles each"
        rows.append(("caustic points", f"{points['found']:,} of {points['wanted']:,} wanted, {each}"))
    if "clusters" in told:
        rows += _cluster_rows(told["clusters"])
    else:
        rows.append(("caustics", f"none to forecast: {told['silence']}"))
    rows.append(("seconds", ", ".join(f"{stage} {spent:.2f}" for stage, spent in told["seconds"].items())))
    rows.append(("memory [MB]", ", ".join(f"{name.replace('_', ' ')} {size:.3g}" for name, size in memory.items())))
    return "\n".join(f"{name:15} {text}" for name, text in rows)


def _cluster_rows(clusters: Mapping[str, Any]) -> list[tuple[str, str]]:
    def spread(values: Mapping[str, float]) -> str:
        return f"{values['least']:.3g} / {values['median']:.3g} / {values['greatest']:.3g}"

    rows = [
        ("clusters", f"{clusters['count']}, {clusters['culled']} culled (rank above {clusters['max_rank']})"),
        ("search radius", f"{clusters['search_radius']:.4g} scene units, overlap {clusters['overlap']:.4g}"),
        (
            "forecast maps",
            f"{clusters['forecast_points']:,} points, overlaps counted"
            if clusters["forecast_points"]
            else f"{clusters['anchors']:,} anchors",
        ),
        ("per cluster", "least / median / greatest"),
        ("  points", spread(clusters["caustic_points"])),
        ("  energy [%]", spread({k: 100 * v for k, v in clusters["energy"].items()})),
        ("  radius", spread(clusters["radius"])),
    ]
    if clusters["cone_half_angle"] is not None:
        rows.append(("  cones [deg]", spread(clusters["cone_half_angle"]) + " of all"))
    rows.append(("rank", f"{'clusters':>8} {'points':>9} {'energy':>9} {'so far':>9}"))
    for row in clusters["by_rank"]:
        name = "no energy" if row["rank"] is None else row["rank"]
        rows.append(
            (
                f"  {name}",
                f"{row['clusters']:8} {row['caustic_points']:9,} {100 * row['energy']:7.2f} % "
                f"{100 * row['energy_so_far']:7.2f} %",
            )
        )
    return rows
