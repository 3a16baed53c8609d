"""What a comparison will do, as plain data: parts, and the runs of each."""

from dataclasses import dataclass, replace
from pathlib import Path

from causticmpi.compare.records import CompareConfig, Scene
from causticmpi.config.records import RenderConfig
from causticmpi.errors import InputError


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
    """One scene of the comparison: runs to compare, and the batches its reference is made of.

    reference: directory of the user's own reference, else None; budgets in seconds, ascending.
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
