"""`causticmpi bench`: interleaved, repeated, medians; a table for people and JSON for machines."""

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.bench.preprocess import STAGES
from causticmpi.bench.record import QUERIES
from causticmpi.bench.subjects import Subject
from causticmpi.config.load import load_config, scene_path
from causticmpi.distributed.begin import sound_scene
from causticmpi.output.directory import check_directory

REPETITIONS = 5
RATES = {
    "raw_single": "Embree alone, the path tracer's rays to the nearest hit one by one (rtcIntersect1)",
    "raw_paths": "Embree alone, all of the path tracer's packets in its order",
    "pt": "path tracing, all of it",
    "raw_packets": "Embree alone, the shadow rays of virtual lights in packets of 16 (rtcOccluded16)",
    "gather": "virtual-light gather, all of it",
    "raw_photons_single": "Embree alone, the rays of forecast photons one by one (rtcIntersect1)",
    "raw_photons": "Embree alone, all packets of forecast photons",
    "photons": "shooting photons until 1 M caustic points are found, all of it",
    "raw_iws": "Embree alone, all rays of `iws`",
    "iws": "`iws`, all of it",
    "raw_iws+cf": "Embree alone, all rays of the eye paths of `iws+cf`",
    "iws+cf": "eye paths of `iws+cf`, all of it: gather, tables, chains",
    "raw_light": "Embree alone, all rays of light tracing",
    "light": "light tracing, all of it",
}
"""What is timed, in million rays per CPU second."""
RATIOS = {
    "pt / raw": ("pt", "raw_paths"),
    "gather / raw": ("gather", "raw_packets"),
    "photons / raw": ("photons", "raw_photons"),
    "photons / raw, one by one": ("photons", "raw_photons_single"),
    "iws / raw": ("iws", "raw_iws"),
    "iws+cf / raw": ("iws+cf", "raw_iws+cf"),
    "light / raw": ("light", "raw_light"),
}
PARTS = {
    "seeing": "what the eye sees first",
    "gather": "virtual lights there",
    "compensation": "compensation and deeper vertices of L_d",
    "caustics": "caustics by the forecast: gather, tables, chains, deeper vertices",
    "light": "light tracing",
}
"""Where the time of a pass of `iws+cf` goes."""
PER_SAMPLE = "caustics: CPU time over Embree's for the same rays"


def recorded_rays(config_file: str) -> dict[str, np.ndarray]:
    """Queries recorded in a process of its own, see `bench.record.main`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "rays.npz"
        subprocess.run([sys.executable, "-m", "causticmpi.bench.record", config_file, str(out)], check=True)
        with np.load(out) as rays:
            return dict(rays)


def measure(config_file: str, repetitions: int = REPETITIONS) -> dict[str, Any]:
    """Rates and ratios of one scene; every figure a median with its least and greatest, ratios taken within a round."""
    recorded = recorded_rays(config_file)
    subject = Subject(config_file)
    rounds: dict[str, list[float]] = {name: [] for name in RATES}
    preprocess: list[dict[str, float]] = []
    million: list[dict[str, float]] = []
    shares: list[dict[str, float]] = []
    per_sample: list[float] = []
    for _ in range(repetitions):
        for name, timed in (
            ("raw_single", lambda: subject.raw_single(recorded["path_packets"], recorded["path_kinds"])),
            ("raw_paths", lambda: subject.raw_paths(recorded["path_packets"], recorded["path_kinds"])),
            ("pt", subject.path_tracing),
            ("raw_packets", lambda: subject.raw_packets(recorded["packets"])),
            ("gather", subject.gather),
            ("raw_photons_single", lambda: subject.raw_rows(recorded["photons_packets"])),
            ("raw_photons", lambda: subject.raw_part({part: recorded[f"photons_{part}"] for part in QUERIES})),
            ("photons", subject.photons),
        ):
            rays, seconds = timed()
            rounds[name].append(rays / seconds / 1e6)
        spent: dict[str, float] = {}
        for name in ("iws", "iws+cf", "light"):
            queries = {part: recorded[f"{name}_{part}"] for part in QUERIES}
            for label, (rays, seconds) in (
                (f"raw_{name}", subject.raw_part(queries)),
                (name, subject.light_paths() if name == "light" else subject.eye_paths(name)),
            ):
                rounds[label].append(rays / max(seconds, 1e-9) / 1e6)
                spent[label] = seconds
        per_sample.append((spent["iws+cf"] - spent["iws"]) / (spent["raw_iws+cf"] - spent["raw_iws"]))
        parts = subject.parts()
        shares.append({part: seconds / sum(parts.values()) for part, seconds in parts.items()})
        preprocess.append(subject.preprocess())
        million.append(subject.million())
    return {
        "scene": subject.scene.data.name,
        "triangles": len(subject.scene.data.triangles),
        "million_rays_per_cpu_second": {name: _summary(values) for name, values in rounds.items()},
        "ratios": {
            name: _summary([a / max(b, 1e-9) for a, b in zip(rounds[top], rounds[bottom], strict=True)])
            for name, (top, bottom) in RATIOS.items()
        },
        "million_paths_per_cpu_second": _summary(subject.path_rates),
        "share_of_a_pass": {part: _summary([share[part] for share in shares]) for part in PARTS},
        "caustics_over_raw_time": _summary(per_sample),
        "preprocess_seconds": {
            stage: _summary([p[stage] for p in preprocess]) for stage in ("photons", "clustering", "trees")
        },
        "million_points_cpu_seconds": {stage: _summary([m[stage] for m in million]) for stage in STAGES},
        "scipy_over_ours": _summary([m["scipy"] / m["ours"] for m in million]),
    }


def _summary(values: Sequence[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "least": min(values), "greatest": max(values)}


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown table of the medians, least and greatest in brackets."""
    lines = ["| | " + " | ".join(r["scene"] for r in results) + " |", "|---|" + "---|" * len(results)]

    def row(label: str, cells: list[dict[str, float]], digits: int = 2) -> str:
        texts = [f"{c['median']:.{digits}f} ({c['least']:.{digits}f} - {c['greatest']:.{digits}f})" for c in cells]
        return f"| {label} | " + " | ".join(texts) + " |"

    for name, label in RATES.items():
        lines.append(row(f"{label} [Mrays/s]", [r["million_rays_per_cpu_second"][name] for r in results]))
    lines.append(row("path tracing [Mpaths/s]", [r["million_paths_per_cpu_second"] for r in results]))
    for name in RATIOS:
        lines.append(row(name, [r["ratios"][name] for r in results]))
    lines.append(row(PER_SAMPLE, [r["caustics_over_raw_time"] for r in results]))
    for part, label in PARTS.items():
        lines.append(row(f"share of a pass: {label}", [r["share_of_a_pass"][part] for r in results]))
    for stage in ("photons", "clustering", "trees"):
        lines.append(row(f"preprocess: {stage} [s]", [r["preprocess_seconds"][stage] for r in results], 3))
    for stage, label in STAGES.items():
        lines.append(row(f"{label} [CPU s]", [r["million_points_cpu_seconds"][stage] for r in results]))
    lines.append(row("scipy / ours", [r["scipy_over_ours"] for r in results]))
    return "\n".join(lines)


def bench(config_files: Sequence[str], directory: str | None) -> int:
    """Measure each config's scene on one core, print the table, and write bench.json and bench.md where asked to.

    Raises InputError before anything is measured.
    """
    for config_file in config_files:
        config = load_config(config_file)
        sound_scene(config, scene_path(config_file, config))
    if directory is not None:
        check_directory(directory, force=True)
    results = []
    for config_file in config_files:
        print(f"causticmpi: measuring {config_file}", file=sys.stderr, flush=True)
        results.append(measure(config_file))
    text = table(results)
    print(text)
    if directory is not None:
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "bench.md").write_text(text + "\n")
        (folder / "bench.json").write_text(json.dumps(results, indent=2) + "\n")
    return 0
