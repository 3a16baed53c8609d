"""`causticmpi merge`: runs of one scene and config with different seeds become one picture with the passes of all.

Sums, squares and counts add up exactly, so that the variance is the one between all passes, and the order of the runs
cannot show. Passes weigh alike: exact for runs of a fixed number of samples. The passes of a run with a time budget
are the fewer the dearer they were, so that weighing runs by them tilts the mean by about its variance, 1/passes of a
pass's, times the correlation of cost and value; that is said in the report.
"""

import itertools
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.checkpoint import State, find_state, sample_keys, unlike
from causticmpi.distributed.result import make_picture
from causticmpi.errors import InputError, RunError
from causticmpi.output.checkpoint import Checkpoint, save_checkpoint
from causticmpi.output.directory import EXR, REPORT, claim_directory, write_run
from causticmpi.output.picture import estimated_relmse
from causticmpi.output.report import attributes_from_report, build_report, provenance
from causticmpi.render.methods import BIASED


@dataclass(frozen=True)
class Part:
    """One of the runs: its state and sums from the checkpoint, config and first hits from the picture's file."""

    directory: Path
    state: State
    sums: np.ndarray
    config: RenderConfig
    features: np.ndarray
    report: dict[str, Any]


def merge(directories: Sequence[str], out: str, force: bool, command: Sequence[str]) -> int:
    """Merge the runs into `out`; prints one line, returns 0. Raises InputError for runs that do not belong together."""
    if len(directories) < 2:
        raise InputError(f"merge: found one directory, {directories[0]}; allowed: two or more; name another run")
    parts = [read_part(Path(directory)) for directory in directories]
    require_alike(parts)
    first = parts[0]
    claim = claim_directory(out, force=force)
    sums = np.sum([part.sums for part in parts], axis=0)
    passes = sum(part.state.passes for part in parts)
    picture = make_picture(first.config.film, [(sums, passes)], first.features)
    report = _report(parts, picture, passes, command)
    state = msgspec.structs.replace(
        first.state,
        seeds=tuple(sorted(seed for part in parts for seed in part.state.seeds)),
        passes=passes,
        **{name: sum(getattr(part.state, name) for part in parts) for name in ("rays", "nonfinite", "rounds")},
        **{name: sum(getattr(part.state, name) for part in parts) for name in ("preparing", "tracing", "writing")},
        complete=True,
    )
    attributes = attributes_from_report(report, msgspec.json.encode(first.config).decode())
    attributes["mergedSeeds"] = " ".join(map(str, state.seeds))
    try:
        save_checkpoint(claim.directory, Checkpoint(msgspec.to_builtins(state), {"sums": sums}), keep_previous=False)
        write_run(claim.directory, picture, report, attributes)
    except (OSError, RuntimeError) as error:
        raise RunError(f"{out}: could not write the merged picture ({' '.join(str(error).split())})") from error
    claim.discard_stale()
    label = " (biased)" if report["biased"] else ""
    what = f"{len(parts)} runs, {passes} passes of {len(state.seeds)} seeds, {report['method']}{label}"
    print(f"{claim.directory}: {what}, estimated relMSE {estimated_relmse(picture.rgb, picture.variance):.2g}")
    return 0


def read_part(directory: Path) -> Part:
    """One run. Raises InputError for a directory without a usable checkpoint, picture and report."""
    import OpenEXR  # late: heavy

    if not directory.is_dir():
        raise InputError("no such directory; allowed: one that a render wrote to", directory)
    state, arrays, damaged = find_state(directory)
    if state is None:
        why = "; ".join(damaged) or "it has no checkpoint"
        raise InputError(f"nothing to merge ({why}): render it with output.checkpoint > 0", directory)
    if state.budget.until is not None:
        raise InputError(
            f"was to stop at the error {state.budget.until}: its passes hang on its picture and cannot weigh it; "
            "allowed: runs without until; render it anew without",
            directory,
        )
    try:
        report = msgspec.json.decode((directory / REPORT).read_bytes())
        with OpenEXR.File(str(directory / EXR), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
            config = msgspec.json.decode(str(file.header()["config"]), type=RenderConfig)
    except Exception as error:  # OpenEXR raises whatever it meets
        why = " ".join(str(error).split())
        raise InputError(
            f"its picture or report cannot be read ({why}): go on with it by --resume", directory
        ) from None
    names = [*(f"albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ"), "depth.Z"]
    features = np.stack([channels[name].reshape(-1) for name in names], axis=1)
    return Part(directory, state, arrays["sums"], config, features, report)


def require_alike(parts: Sequence[Part]) -> None:
    """Raises InputError unless all runs are of one scene, config and version, and no seed is there twice."""
    first = parts[0]
    keys = sample_keys(first.config)
    for part in parts:
        difference = unlike(part.state, keys, first.state.scene, but=("seed",))
        if difference or part.sums.shape != first.sums.shape:
            raise InputError(
                f"cannot be merged with {first.directory}: it has {difference or 'another shape'} there; only seed and "
                "budget may differ",
                part.directory,
            )
    for one, other in itertools.combinations(parts, 2):
        twice = set(one.state.seeds) & set(other.state.seeds)
        if twice:
            raise InputError(
                f"has the seed {min(twice)}, and so has {other.directory}: the same samples twice; render one of them "
                "with another --seed",
                one.directory,
            )


def _report(parts: Sequence[Part], picture: Any, passes: int, command: Sequence[str]) -> dict[str, Any]:
    first = parts[0]
    reports = [part.report for part in parts]
    warnings = list(
        dict.fromkeys(line for report in reports for line in report["warnings"] if "two passes" not in line)
    )
    if any(part.state.budget.time is not None for part in parts):
        warnings.append(
            "runs with a time budget are weighed by their passes, which hang on what these cost: the mean is unbiased "
            "up to a part of its own variance; with --spp it is exactly so"
        )
    hosts = [host for report in reports for host in report["provenance"]["hosts"]]
    made = build_report(
        picture,
        method=first.config.method,
        biased=first.config.method in BIASED,
        ranks=sum(report["ranks"] for report in reports),
        passes=passes,
        spp=passes,
        seed=min(seed for part in parts for seed in part.state.seeds),
        nonfinite_samples=sum(part.state.nonfinite for part in parts),
        seconds={stage: sum(report["seconds"][stage] for report in reports) for stage in first.report["seconds"]},
        rays=sum(report["rays"]["total"] for report in reports),
        memory_mb=max(report["memory_mb"] for report in reports),
        provenance=provenance(shlex.join(command), {"hosts": hosts}, first.state.scene),
        warnings=warnings,
    )
    made["merged"] = [
        {"directory": str(part.directory), "seeds": list(part.state.seeds), "passes": part.state.passes}
        for part in parts
    ]
    return made
