"""From the files of finished runs to numbers: errors of every picture, averages over seeds, slopes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from causticmpi.compare.files import read_layers, read_report, read_snapshots
from causticmpi.compare.metrics import Errors, caustic_mask, flip_missing, measure, signed_error
from causticmpi.compare.plan import Part, Plan, Run
from causticmpi.compare.reference import ReferencePicture
from causticmpi.compare.statistics import Interval, floor, interval, jackknife, slope
from causticmpi.output.directory import EXR

CURVES = {
    "relmse": "relMSE",
    "trimmed_relmse": "relMSE, worst 0.1 % left out",
    "mask_relmse": "relMSE, caustic mask",
    "mask_trimmed_relmse": "relMSE, caustic mask, worst 0.1 % left out",
    "mse": "MSE",
    "flip": "FLIP",
}
"""Metrics that get a curve and a slope, with their names in charts and tables."""
SMOOTHING = 7
"""Pixels: side of the square over which signed errors are averaged."""


@dataclass(frozen=True)
class Point:
    """One picture of a run: passes, wall clock [s] and errors."""

    passes: int
    seconds: float
    errors: Errors


@dataclass(frozen=True)
class Measured:
    """A finished run with its report; `points`, ascending in passes, end with the final picture."""

    run: Run
    report: dict[str, Any]
    points: list[Point]

    @property
    def final(self) -> Point:
        """The picture that the run left."""
        return self.points[-1]


@dataclass(frozen=True)
class Group:
    """All seeds of one variant at one budget. name: the label, with `(biased)` where it belongs.

    rgb: the first seed's picture; signed: smoothed signed relative error, mean over seeds.
    """

    label: str
    name: str
    method: str
    biased: bool
    seconds: float
    runs: list[Measured]
    rgb: np.ndarray
    signed: np.ndarray

    @property
    def final_errors(self) -> Errors:
        """Errors of the first seed's final picture."""
        return self.runs[0].final.errors

    def errors(self, metric: str) -> np.ndarray:
        """The final error of every seed."""
        return np.array([getattr(m.final.errors, metric) for m in self.runs])

    def error(self, metric: str) -> Interval:
        """Mean and confidence interval of the final error over seeds."""
        return interval(self.errors(metric))

    @property
    def seeds(self) -> str:
        """How many there are, for people."""
        return "1 seed" if len(self.runs) == 1 else f"{len(self.runs)} seeds"

    def passes(self) -> Interval:
        """Samples per pixel over seeds."""
        return interval([m.final.passes for m in self.runs])

    def curves(self, metric: str, against: str = "passes") -> list[np.ndarray]:
        """(n, 2) of every seed: passes or seconds, and error; seeds without two known errors are left out."""
        found = []
        for measured in self.runs:
            points = np.array([(getattr(p, against), getattr(p.errors, metric)) for p in measured.points], np.float64)
            points = points[np.isfinite(points[:, 1])]
            found += [points] if len(points) > 1 else []
        return found

    def slope(self, metric: str) -> Interval:
        """Slope of log error against log passes."""
        curves = self.curves(metric)
        return jackknife(curves, slope) if curves else interval([])

    def floor(self, metric: str) -> Interval:
        """Error that would remain after many passes; 0 but for noise unless the method is biased."""
        curves = self.curves(metric)
        return jackknife(curves, floor) if curves else interval([])


@dataclass
class PartResult:
    """One scene's groups, by budget and label in the plan's order; `timing` holds the runs that are timed only."""

    part: Part
    reference: ReferencePicture
    mask: np.ndarray
    groups: dict[float, list[Group]] = field(default_factory=dict)
    timing: list[Measured] = field(default_factory=list)

    @property
    def longest(self) -> list[Group]:
        """The groups of the longest budget."""
        return self.groups[max(self.groups)]


def analyse(plan: Plan, references: Mapping[str, ReferencePicture]) -> list[PartResult]:
    """Measure every run of a finished comparison."""
    with_flip = flip_missing() is None
    timed_only = {variant.label for variant in plan.config.variants if variant.timing_only}
    results = []
    for part in plan.parts:
        reference = references[part.name]
        result = PartResult(part, reference, caustic_mask(reference, plan.config.mask_level))
        for seconds in part.budgets:
            groups = []
            for label in part.labels:
                runs = [run for run in part.runs if (run.label, run.seconds) == (label, seconds)]
                if label in timed_only:
                    result.timing += [Measured(run, read_report(run.directory), []) for run in runs]
                else:
                    groups.append(_group(runs, result, with_flip))
            result.groups[seconds] = groups
        results.append(result)
    return results


def _group(runs: Sequence[Run], result: PartResult, with_flip: bool) -> Group:
    measured, signed = [], []
    first: np.ndarray | None = None
    for run in runs:
        rgb = read_layers(run.directory / EXR).rgb
        first = rgb if first is None else first
        signed.append(signed_error(rgb, result.reference, SMOOTHING))
        measured.append(_measured(run, rgb, result, with_flip))
    assert first is not None
    biased = bool(measured[0].report["biased"])
    return Group(
        label=runs[0].label,
        name=runs[0].label + (" (biased)" if biased else ""),
        method=runs[0].config.method,
        biased=biased,
        seconds=float(runs[0].seconds or 0.0),
        runs=measured,
        rgb=first,
        signed=np.mean(signed, axis=0),
    )


def _measured(run: Run, rgb: np.ndarray, result: PartResult, with_flip: bool) -> Measured:
    report = read_report(run.directory)
    pictures, passes, seconds = read_snapshots(run.directory)
    final = int(report["passes"])
    flip_curve = with_flip and run.seed == 1  # FLIP takes longer than all else together
    points = [
        Point(int(n), float(s), measure(picture, result.reference, result.mask, flip_curve))
        for picture, n, s in zip(pictures, passes, seconds, strict=True)
        if n < final
    ]
    # Snapshots are timed before the last picture is written; so is this.
    ended = float(report["seconds"]["total"]) - float(report["seconds"]["write"])
    points.append(Point(final, ended, measure(rgb, result.reference, result.mask, with_flip)))
    return Measured(run, report, points)
