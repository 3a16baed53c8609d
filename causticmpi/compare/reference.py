"""References: made from independent batches, checked against a second unbiased method, kept for later comparisons."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.compare.files import read_layers, read_report
from causticmpi.compare.plan import Part, Plan, Run
from causticmpi.compare.statistics import FEW_HITS, Agreement, agreement, block_means, fewest_hits
from causticmpi.errors import InputError, reason
from causticmpi.output.directory import EXR, write_whole
from causticmpi.output.exr import write_exr
from causticmpi.output.picture import Picture

PICTURE, FACTS, BLOCKS = "reference.exr", "reference.json", "blocks.npz"
FEWEST_BATCHES = 3
"""Whose skew can be told."""
ALPHA = 1e-3
"""Significance of the check: one in a thousand correct references would fail it."""


@dataclass(frozen=True)
class ReferencePicture:
    """Radiance, its caustic layer and the variance of the radiance's mean, (H, W, 3) float64; what is known of it."""

    rgb: np.ndarray
    caustic: np.ndarray
    variance: np.ndarray
    facts: dict[str, Any]


def reference_directory(plan: Plan, part: Part, scene_hash: str) -> Path:
    """The user's own directory, else one named by the scene's content and the film."""
    if part.reference is not None:
        return part.reference
    film = part.base.film
    crop = "" if film.crop is None else "-" + "_".join(map(str, film.crop))
    return plan.references / f"{part.scene_file.stem}-{scene_hash[:12]}-{film.width}x{film.height}{crop}"


def read_reference(directory: Path, part: Part, scene_hash: str) -> ReferencePicture | None:
    """The reference in `directory`, None where there is none yet.

    Raises InputError for that of another scene, camera or film, and where the user's own does not exist.
    """
    try:
        facts = json.loads((directory / FACTS).read_text())
    except FileNotFoundError:
        if part.reference is not None:
            raise InputError(f"no reference there ({FACTS}): give the directory of one", directory) from None
        return None
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot be read ({reason(error)}): remove it to have it made again", directory / FACTS
        ) from None
    mend = "remove the directory, or name another one"
    if facts.get("scene_hash") != scene_hash:
        found, needed = str(facts.get("scene_hash"))[:12], scene_hash[:12]
        raise InputError(
            f"it is the reference of another scene or camera (content {found}, needed {needed}): {mend}", directory
        )
    film = _film(part)
    if facts.get("film") != film:
        raise InputError(f"it is the reference of another film ({facts.get('film')}, needed {film}): {mend}", directory)
    layers = read_layers(directory / PICTURE)
    return ReferencePicture(layers.rgb, layers.caustic, layers.variance, facts)


def assemble(part: Part, batches: Sequence[Run], directory: Path, scene_hash: str, block: int) -> ReferencePicture:
    """Merge finished batches into reference.exr and reference.json, and remove them.

    blocks.npz keeps the block means of every batch, (batches, rows * columns * 3): where a failed check failed.
    """
    estimate = [run for run in batches if run.directory.parent.name == "estimate"]
    check = [run for run in batches if run.directory.parent.name == "check"]
    merged, passes, means = _merge(estimate, block)
    _, check_passes, check_means = _merge(check, block)
    verdict = agreement(means, check_means)
    facts: dict[str, Any] = {
        "scene_hash": scene_hash,
        "film": _film(part),
        "estimate": _described(estimate, passes),
        "check": _described(check, check_passes),
        "block": block,
        "agreement": asdict(verdict),
        "agrees": verdict.p > ALPHA,
        "few_hits": few_hits(means, check_means),
        "alpha": ALPHA,
    }
    attributes: dict[str, str | int | float] = {
        "method": facts["estimate"]["method"],
        "passes": passes,
        "biased": "no",
        "sceneHash": scene_hash,
    }
    write_whole(directory / PICTURE, lambda path: write_exr(path, merged, attributes))
    write_whole(directory / BLOCKS, partial(_save_blocks, means, check_means))
    text = json.dumps(facts, indent=2, allow_nan=False, default=float) + "\n"
    write_whole(directory / FACTS, lambda path: path.write_text(text))
    for role in ("estimate", "check"):
        shutil.rmtree(directory / role, ignore_errors=True)
    return ReferencePicture(merged.rgb, merged.caustic, merged.variance, facts)


def few_hits(estimate: np.ndarray, check: np.ndarray) -> float | None:
    """Rare hits in the batches of the picture that is too dark, if they may be too few for its mean to be judged.

    estimate, check: (batches, 3 k) block means by colour. Where batches show no skew there may be few hits all the
    same, unless the noise is shared by many blocks: some 50 of 4 batches, 25 of 8.
    """
    dark, p_above = (check, agreement(check, estimate).p_above)
    if p_above <= ALPHA:  # the check is too bright somewhere: it is the estimate that is too dark there
        dark, p_above = (estimate, agreement(estimate, check).p_above)
    if p_above <= ALPHA or len(dark) < FEWEST_BATCHES:
        return None
    hits = fewest_hits(dark.reshape(len(dark), -1, 3).sum(axis=2))
    return hits if hits < FEW_HITS else None


def _save_blocks(estimate: np.ndarray, check: np.ndarray, path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, estimate=estimate, check=check)


def _merge(runs: Sequence[Run], block: int) -> tuple[Picture, int, np.ndarray]:
    """Mean weighted by passes with its variance, all passes, and the block means of every batch (batches, columns)."""
    import OpenEXR

    total = 0
    sums: dict[str, np.ndarray] = {}
    means = []
    for run in runs:
        passes = int(read_report(run.directory)["passes"])
        layers = read_layers(run.directory / EXR)
        means.append(block_means(layers.rgb, block))
        total += passes
        for name, layer, weight in (
            ("rgb", layers.rgb, passes),
            ("caustic", layers.caustic, passes),
            ("variance", layers.variance, passes**2),
        ):
            sums[name] = sums.get(name, 0) + weight * layer
    rgb, caustic, variance = sums["rgb"] / total, sums["caustic"] / total, sums["variance"] / total**2
    with OpenEXR.File(str(runs[0].directory / EXR), separate_channels=True) as file:
        features = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    film = runs[0].config.film
    picture = Picture(
        rgb=rgb,
        diffusive=rgb - caustic,
        caustic=caustic,
        variance=variance,
        albedo=np.stack([features[f"albedo.{axis}"] for axis in "RGB"], axis=-1),
        normal=np.stack([features[f"normal.{axis}"] for axis in "XYZ"], axis=-1),
        depth=features["depth.Z"],
        film_size=(film.width, film.height),
        crop=film.crop,
    )
    return picture, total, np.array(means)


def _described(runs: Sequence[Run], passes: int) -> dict[str, Any]:
    config = runs[0].config
    sampling = f" ({config.forecast.sampling})" if config.method == "iws+cf" else ""
    return {
        "method": config.method + sampling,
        "samples_per_pixel": passes,
        "batches": len(runs),
        "seeds": [run.seed for run in runs],
    }


def _film(part: Part) -> dict[str, Any]:
    film = part.base.film
    return {"width": film.width, "height": film.height, "crop": None if film.crop is None else list(film.crop)}


def told(facts: dict[str, Any]) -> str:
    """One sentence on a reference, for people."""
    estimate, check = facts["estimate"], facts["check"]
    found = Agreement(**facts["agreement"])
    few = None if facts["agrees"] else facts.get("few_hits")
    verdict = "agrees with" if facts["agrees"] else "DISAGREES with" if few is None else "cannot be judged by"
    return (
        f"{estimate['method']}, {estimate['samples_per_pixel']} samples per pixel in {estimate['batches']} batches "
        f"(seeds {estimate['seeds'][0]} to {estimate['seeds'][-1]}); {verdict} {check['method']}, "
        f"{check['samples_per_pixel']} samples per pixel in {check['batches']} batches: p = {found.p:.2g} "
        f"(Sidak-corrected over {found.tests} means of {facts['block']} x {facts['block']} pixels, largest deviation "
        f"{found.z:.1f} standard errors), means differ by {100 * found.difference:+.2f} %"
        + ("" if few is None else f"; what is too dark may hold too few rare hits to judge ({few:.2g})")
    )
