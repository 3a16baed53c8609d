"""What a comparison will do, as plain data: parts, and the runs of each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msgspec import structs

from causticmpi.compare.records import CompareConfig, Scene, Variant
from causticmpi.config.records import Budget, RenderConfig
from causticmpi.errors import InputError

NO_PROGRESSIVE_PICTURES = 1e9
"""Seconds between pictures: a run of a comparison writes at its end alone, so that its report means it is whole."""
LONGEST_TIMING = 20.0
"""Seconds: a run that is only timed needs no more."""


@dataclass(frozen=True)
class Run:
    """One render of the comparison, ready to start; `seconds` is its budget, None where samples are counted."""

    part: str
    label: str
    seconds: float | None
    seed: int
    config: RenderConfig
    scene_file: Path

    @property
    def directory(self) -> Path:
        """Where its picture goes."""
        return Path(self.config.output.directory)


@dataclass(frozen=True)
class Part:
    """One scene of the comparison: runs to compare, and what its reference is made of.

    reference: directory of the user's own reference, else None; estimate, check: configs of the batches of any other,
    budgets included; budgets in seconds, ascending.
    """

    name: str
    title: str
    scene: Scene
    base: RenderConfig
    scene_file: Path
    labels: tuple[str, ...]
    budgets: tuple[float, ...]
    runs: tuple[Run, ...]
    reference: Path | None
    estimate: RenderConfig
    check: RenderConfig


@dataclass(frozen=True)
class Plan:
    """All that a comparison will do. `directory`: its output; `references`: where references are kept; `scene`: number
    of the only scene it is about, if there is one."""

    config: CompareConfig
    file: Path
    directory: Path
    references: Path
    parts: tuple[Part, ...]
    scene: int | None = None

    @property
    def runs(self) -> list[Run]:
        """All runs, in the order in which they are made: seed by seed, so that an early stop leaves whole sets."""
        every = [run for part in self.parts for run in part.runs]
        return sorted(every, key=lambda run: run.seed)


def only_scene(plan: Plan, scene: int) -> Plan:
    """The plan of one scene, by its number from 1. Raises InputError if there is none."""
    if not 1 <= scene <= len(plan.parts):
        raise InputError(f"found scene {scene}; allowed: 1 to {len(plan.parts)}, in the order of the config", plan.file)
    return replace(plan, parts=(plan.parts[scene - 1],), scene=scene)


def compared_runs(
    name: str,
    scene_file: Path,
    variants: Sequence[tuple[Variant, RenderConfig]],
    budgets: Sequence[float],
    seeds: Sequence[int],
    directory: Path,
) -> tuple[Run, ...]:
    """All seeds of all variants of a part at every budget [s, ascending]; one run of those that are only timed."""
    runs = []
    for seconds in budgets:
        for variant, config in variants:
            if variant.timing_only and seconds > budgets[0]:
                continue
            budget = Budget(time=min(seconds, LONGEST_TIMING) if variant.timing_only else seconds)
            for seed in seeds[:1] if variant.timing_only else seeds:
                folder = directory / variant.label.replace(" ", "_") / f"{seconds:g}s-{seed}"
                placed = _placed(config, folder, seed, budget)
                runs.append(Run(name, variant.label, seconds, seed, placed, scene_file))
    return tuple(runs)


def reference_runs(plan: Plan, part: Part, directory: Path) -> list[Run]:
    """All renders that the reference of `part` is made of; no two of them have the same seed."""
    runs: list[Run] = []
    reference = plan.config.reference
    for role, config, batches in (
        ("estimate", part.estimate, reference.estimate),
        ("check", part.check, reference.check),
    ):
        seconds = None if config.budget.time is None else float(config.budget.time)
        budget = Budget(time=seconds, spp=config.budget.spp)
        for i in range(batches.batches):
            seed = reference.seed + len(runs)
            placed = _placed(config, directory / role / str(i), seed, budget)
            runs.append(Run(part.name, f"reference, {role}", seconds, seed, placed, part.scene_file))
    return runs


def _placed(config: RenderConfig, directory: Path, seed: int, budget: Budget) -> RenderConfig:
    output = structs.replace(config.output, directory=str(directory), interval=NO_PROGRESSIVE_PICTURES, checkpoint=0.0)
    return structs.replace(config, seed=seed, budget=budget, output=output)
