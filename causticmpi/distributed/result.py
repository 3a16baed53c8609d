"""What rank 0 makes of the sums of all ranks: the picture, the report, and the files in the output directory."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.config.records import Film, RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import Forecasting
from causticmpi.distributed.until import Part
from causticmpi.distributed.usage import Usage, cpu_summary
from causticmpi.output.directory import UNFINISHED, Claim, write_run, write_whole
from causticmpi.output.picture import Picture, estimated_relmse
from causticmpi.output.report import attributes_from_report, build_report
from causticmpi.render.film import resolve
from causticmpi.render.methods import BIASED


@dataclass(frozen=True)
class Merged:
    """Sums over passes and ranks (see render.film), in parts of which the picture is the plain mean: one, unless halves
    of a run ended apart (distributed.until). passes: of the run; rays: of these; usage: of each rank; reached: whether
    the wanted error is."""

    parts: Sequence[Part]
    passes: int
    rays: int
    nonfinite: int
    usage: Sequence[Usage]
    reached: bool = False


class Result:
    """The files of one run. error: `estimated_relmse` of the last picture, None as long as it is unknown; known: a
    better estimate, and the factor it may be off by (render.precision), None as long as there is none."""

    def __init__(self, config: RenderConfig, claim: Claim, provenance: Mapping[str, Any], features: np.ndarray) -> None:
        """features: first hits, (slots, 7) float32: albedo, normal, depth."""
        self.config, self.claim, self.provenance, self.features = config, claim, provenance, features
        self.error: float | None = None
        self.known: tuple[float, float] | None = None

    @property
    def directory(self) -> Path:
        """Where the files are."""
        return self.claim.directory

    def write(self, merged: Merged, forecasting: Forecasting, watch: Stopwatch) -> float:
        """Write picture and report over those of this run, or of the run that --force gives up; returns the seconds."""
        picture = make_picture(self.config.film, merged.parts, self.features)
        if merged.passes > 1:
            self.error = estimated_relmse(picture.rgb, picture.variance)
        report = self._report(picture, merged, forecasting, watch)
        text = msgspec.json.encode(self.config).decode()
        seconds = write_run(self.directory, picture, report, attributes_from_report(report, text))
        self.claim.discard_stale()
        return seconds

    def mark_unfinished(self, signal: int, passes: int) -> None:
        """Leave the file that tells a batch script to start the run again."""
        text = f"stopped by signal {signal} after {passes} passes\n"
        write_whole(self.directory / UNFINISHED, lambda path: path.write_text(text))

    def _report(self, picture: Picture, merged: Merged, forecasting: Forecasting, watch: Stopwatch) -> dict[str, Any]:
        tracing = watch.stages.get("tracing", 0.0)
        report = build_report(
            picture,
            method=self.config.method,
            biased=self.config.method in BIASED,
            ranks=len(merged.usage),
            passes=merged.passes,
            spp=merged.passes,
            seed=self.config.seed,
            nonfinite_samples=merged.nonfinite,
            seconds=dict(watch.stages, total=watch.elapsed()),
            rays=merged.rays + forecasting.rays,
            rays_per_second=merged.rays / max(tracing, 1e-9),
            memory_mb=sum(one.memory_mb for one in merged.usage),
            provenance=self.provenance,
            warnings=forecasting.warnings,
        )
        if self.known is not None:
            error, factor = self.known
            report["relmse"] = {"estimate": error, "low": error / factor, "high": error * factor}
        if self.config.budget.until is not None:
            target = float(self.config.budget.until)
            report["until"] = {"relmse": target, "reached": merged.reached}
        report["forecast"] = {
            "photons": forecasting.photons,
            "particles": forecasting.emitted,
            "search_radius": forecasting.maps.radius if forecasting.photons else None,
            "plan": None if forecasting.plan is None else asdict(forecasting.plan),
        }
        report["memory_mb_per_rank"] = [round(one.memory_mb, 1) for one in merged.usage]
        report["cpu_seconds"] = cpu_summary(merged.usage)
        return report


def make_picture(film: Film, parts: Sequence[Part], features: np.ndarray) -> Picture:
    """The picture of these sums (see render.film): the mean of the parts' means. features: (slots, 7) float32, as
    `Result` takes them."""
    x0, y0, x1, y1 = film.window
    shape = (y1 - y0, x1 - x0)
    resolved = [resolve(sums, passes) for sums, passes in parts]
    diffusive, caustic, variance = (np.mean(layer, axis=0).reshape(*shape, 3) for layer in zip(*resolved, strict=True))
    variance /= len(resolved)
    features = features.reshape(*shape, 7)
    return Picture(
        rgb=diffusive + caustic,
        diffusive=diffusive,
        caustic=caustic,
        variance=variance,
        albedo=features[..., :3],
        normal=features[..., 3:6],
        depth=features[..., 6],
        film_size=(film.width, film.height),
        crop=film.crop,
    )
