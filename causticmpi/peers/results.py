"""From finished runs to figures: errors against the reference, checks that it is the same picture, tables."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from causticmpi.compare.metrics import ReferencePicture, measure
from causticmpi.compare.tables import Table, number
from causticmpi.config.records import Method
from causticmpi.peers.recording import Recording
from causticmpi.render.methods import BIASED

EVEN_MEAN, SIGNIFICANT = 0.01, 4.0
"""A mean radiance that differs by more, and by more than so many standard errors, is remarked upon."""


@dataclass(frozen=True)
class Contender:
    """One method of one renderer. module: of this package; caveat: why it does not converge to the reference;
    shared_noise: pixels share light paths, so that the error of their mean cannot be told from one picture."""

    module: str
    renderer: str
    method: str
    label: str
    caveat: str = ""
    shared_noise: bool = False

    @property
    def name(self) -> str:
        """How the command line selects it: renderer:method."""
        return f"{self.module}:{self.method}"


def own(method: str) -> Contender:
    """One of our methods."""
    return Contender(
        "ours", "causticmpi", method, method, "biased" if method in BIASED else "", method.startswith("iws")
    )


OTHERS = (
    Contender("mitsuba", "Mitsuba", "path", "path"),
    Contender("mitsuba", "Mitsuba", "ptracer", "ptracer", "incomplete: nothing seen in or through specular surfaces"),
    Contender("luxcore", "LuxCore", "path", "path"),
    Contender("luxcore", "LuxCore", "hybrid", "path + light tracing"),
    Contender("luxcore", "LuxCore", "bidir", "bidirectional"),
    Contender("luxcore", "LuxCore", "bidirvm", "vertex merging", "biased"),
    Contender("luxcore", "LuxCore", "photongi", "photon cache", "biased"),
)
ALL = (*(own(method) for method in ("pt", "iws+pm", "iws+cf") if method in get_args(Method)), *OTHERS)
"""In the order of tables and runs."""


@dataclass(frozen=True)
class Point:
    """One picture. seconds: CPU time; samples: per pixel; mean_difference: of radiance, relative to the reference's;
    mean_error: its standard error, nan where pixels share noise; uncounted: CPU seconds before the clock started."""

    contender: Contender
    seed: int
    budget: float
    seconds: float
    samples: float
    relmse: float
    trimmed: float
    mean_difference: float
    mean_error: float
    uncounted: float
    version: str


MEASURED = ("seconds", "samples", "relmse", "trimmed", "mean_difference", "mean_error", "uncounted")


def points_of(contender: Contender, seed: int, file: Path, reference: ReferencePicture) -> list[Point]:
    """The points of one finished run; a picture that serves two budgets, for want of a nearer one, counts once."""
    recording, facts = Recording.read(file)
    version = " ".join(filter(None, (facts["renderer"], facts["note"])))
    empty, mean = np.zeros(reference.rgb.shape[:2], bool), float(reference.rgb.mean())
    found = []
    for i, (budget, seconds) in enumerate(zip(recording.budgets, recording.seconds, strict=True)):
        if seconds in recording.seconds[i + 1 :]:
            continue
        rgb = recording.pictures[i].astype(np.float64)
        errors = measure(rgb, reference, empty, with_flip=False)
        found.append(
            Point(
                contender=contender,
                seed=seed,
                budget=budget,
                seconds=seconds,
                samples=recording.samples[i],
                relmse=errors.relmse,
                trimmed=errors.trimmed_relmse,
                mean_difference=float(rgb.mean()) / mean - 1,
                mean_error=math.nan if contender.shared_noise else math.sqrt(max(0.0, errors.mse) / empty.size) / mean,
                uncounted=facts["uncounted_cpu_seconds"],
                version=version,
            )
        )
    return found


def misplaced(file: Path, reference: ReferencePicture) -> str:
    """Where the longest picture fits the reference better when moved by a pixel; empty where it fits as it is."""
    rgb = Recording.read(file)[0].pictures[-1].astype(np.float64)
    inner = (slice(2, -2), slice(2, -2))
    errors = {}
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            moved = np.roll(rgb, (dy, dx), (0, 1))[inner]
            square = ((moved - reference.rgb[inner]) ** 2 / (reference.rgb[inner] ** 2 + 0.01)).mean(axis=-1)
            errors[dy, dx] = float(np.sort(square, axis=None)[: int(0.99 * square.size)].mean())
    best = min(errors, key=lambda shift: errors[shift])
    return f"fits better moved by {best} pixels (down, right)" if errors[best] < 0.98 * errors[0, 0] else ""


def averaged(points: Sequence[Point]) -> list[Point]:
    """Medians over the seeds, one point for each contender, in the order given, and budget, rising."""
    groups: dict[str, dict[float, list[Point]]] = {}
    for point in points:
        groups.setdefault(point.contender.name, {}).setdefault(point.budget, []).append(point)
    found = []
    for group in (budgets[budget] for budgets in groups.values() for budget in sorted(budgets)):
        medians = {name: statistics.median(getattr(point, name) for point in group) for name in MEASURED}
        found.append(replace(group[0], **medians))
    return found


def remark(point: Point) -> str:
    """What a reader must know of a row before comparing it."""
    if point.samples < 1:
        return "not a sample per pixel yet"
    off = not point.contender.shared_noise
    off = off and abs(point.mean_difference) > max(EVEN_MEAN, SIGNIFICANT * point.mean_error)
    return point.contender.caveat or ("another mean" if off else "")


def table(scene: str, points: Sequence[Point], notes: Sequence[str]) -> Table:
    """One scene for people: medians over the seeds."""
    rows = []
    for p in averaged(points):
        rows.append(
            (
                f"{p.contender.renderer} {p.contender.label}",
                remark(p),
                f"{p.seconds:.1f}",
                number(p.samples),
                number(p.relmse),
                number(p.trimmed),
                number(p.relmse * p.seconds),
                f"{100 * p.mean_difference:+.2f} ± {number(100 * p.mean_error, 2)} %",
            )
        )
    columns = (
        "renderer, method", "", "CPU s", "samples per pixel", "relMSE", "trimmed", "relMSE x s", "mean radiance",
    )  # fmt: skip
    return Table(f"peers-{scene}", scene, columns, tuple(rows), " ".join(notes))


def raw_table(scene: str, points: Sequence[Point]) -> Table:
    """Every picture of every run, for machines."""
    columns = (
        "scene", "renderer", "method", "caveat", "seed", "budget_seconds", "cpu_seconds", "samples_per_pixel",
        "relmse", "relmse_trimmed", "mean_difference", "mean_error", "uncounted_cpu_seconds", "version",
    )  # fmt: skip
    rows = tuple(
        (
            scene, p.contender.renderer, p.contender.method, p.contender.caveat, str(p.seed), f"{p.budget:g}",
            f"{p.seconds:.3f}", f"{p.samples:g}", f"{p.relmse:.6g}", f"{p.trimmed:.6g}", f"{p.mean_difference:.6f}",
            f"{p.mean_error:.6f}",
            f"{p.uncounted:.2f}", p.version,
        )
        for p in points
    )  # fmt: skip
    return Table(f"peers-{scene}", scene, columns, rows)
