"""A compare config and the render configs it names -> a validated plan of all runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from causticmpi.compare.records import Batches, CompareConfig, Overrides, Scene, Variant, plain_text
from causticmpi.config.check import check_budget
from causticmpi.config.convert import convert, nearest
from causticmpi.config.load import load_config, overridden, scene_path
from causticmpi.config.records import RenderConfig
from causticmpi.config.units import parse_time
from causticmpi.config.yaml_source import Keys, YamlSource, read_yaml
from causticmpi.errors import InputError
from causticmpi.render.methods import BIASED

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
    """All that a comparison will do. `directory`: its output; `references`: where references are kept."""

    config: CompareConfig
    file: Path
    directory: Path
    references: Path
    parts: tuple[Part, ...]

    @property
    def runs(self) -> list[Run]:
        """All runs, in the order in which they are made: seed by seed, so that an early stop leaves whole sets."""
        every = [run for part in self.parts for run in part.runs]
        return sorted(every, key=lambda run: run.seed)


def load_plan(file: str | Path, overrides: Mapping[str, str] | Sequence[str] = (), out: str | None = None) -> Plan:
    """Read and validate the compare config and every render config it leads to. Raises InputError with its place."""
    source = read_yaml(file)
    config = convert(source, (), source.data, CompareConfig)
    if overrides:
        source = overridden(source, overrides)
        config = convert(source, (), source.data, CompareConfig)
    _check_variants(source, config)
    path = Path(file)
    directory = Path(out if out is not None else config.output)
    names: set[str] = set()
    parts = []
    for i, scene in enumerate(config.scenes):
        name = scene.name or Path(scene.config).stem
        if name in names or "/" in name or name in ("", ".", ".."):
            raise source.error(
                ("scenes", i), f'found the name "{name}"; allowed: a name that is no other\'s; write `name: ...`'
            )
        names.add(name)
        parts.append(_part(source, config, ("scenes", i), scene, name, path, directory))
    for role, batches in (("estimate", config.reference.estimate), ("check", config.reference.check)):
        for part in parts:
            merged = _merged(source, ("reference", role, "set"), part.base, part.scene, path, batches.set)
            if merged.method in BIASED:
                raise source.error(
                    ("reference", role, "set"), f"found {merged.method}, which is biased; allowed: an unbiased method"
                )
        _budget(source, ("reference", role, "budget"), batches)
    return Plan(config, path, directory, Path(config.reference.directory), tuple(parts))


def _check_variants(source: YamlSource, config: CompareConfig) -> None:
    labels = [variant.label for variant in config.variants]
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise source.error(("variants", i, "label"), f'found "{label}" twice; allowed: one variant per label')
    for i, scene in enumerate(config.scenes):
        for wanted in scene.variants or ():
            if wanted not in labels:
                raise source.error(
                    ("scenes", i, "variants"),
                    f'found "{wanted}"; allowed: {", ".join(labels)}{nearest(wanted, labels)}',
                )


def _part(
    source: YamlSource, config: CompareConfig, keys: Keys, scene: Scene, name: str, file: Path, directory: Path
) -> Part:
    base = _merged(source, (*keys, "set"), None, scene, file, {})
    film = base.film
    x0, y0, x1, y1 = film.crop or (0, 0, film.width, film.height)
    for i, (left, top, right, bottom) in enumerate(scene.closeups):
        if not (x0 <= left < right <= x1 and y0 <= top < bottom <= y1):
            raise source.error(
                (*keys, "closeups", i),
                f"found {[left, top, right, bottom]}; allowed: [x0, y0, x1, y1] within {[x0, y0, x1, y1]}",
            )
    budgets = sorted(_times(source, keys, config, scene))
    variants = [v for v in config.variants if scene.variants is None or v.label in scene.variants]
    settings = {
        variant.label: _merged(
            source, ("variants", config.variants.index(variant), "set"), base, scene, file, variant.set
        )
        for variant in variants
    }
    runs = tuple(
        Run(
            name,
            variant.label,
            seconds,
            seed,
            _placed(
                settings[variant.label],
                directory / "runs" / name / _file_name(variant) / f"{seconds:g}s-{seed}",
                seed,
                time=min(seconds, LONGEST_TIMING) if variant.timing_only else seconds,
            ),
            scene_path(_beside(file, scene.config), base),
        )
        for seconds in budgets
        for variant in variants
        for seed in range(1, (scene.seeds or config.seeds) + 1)
        if not variant.timing_only or (seconds == budgets[0] and seed == 1)
    )
    return Part(
        name,
        scene.title or name,
        scene,
        base,
        scene_path(_beside(file, scene.config), base),
        tuple(v.label for v in variants),
        tuple(budgets),
        runs,
        None if scene.reference is None else _beside(file, scene.reference),
    )


def batch_runs(plan: Plan, part: Part, batches: Batches, role: str, directory: Path) -> list[Run]:
    """The renders a reference of this part consists of. role: estimate or check; their seeds do not overlap."""
    first = plan.config.reference.seed + (0 if role == "estimate" else batches.batches * 1000)
    config = load_config(_beside(plan.file, part.scene.config), [*plain_text(part.scene.set), *plain_text(batches.set)])
    budget = check_budget(batches.budget)
    seconds = None if budget.time is None else float(budget.time)
    return [
        Run(
            part.name,
            f"reference, {role}",
            seconds,
            first + i,
            _placed(config, directory / role / str(i), first + i, time=seconds, spp=budget.spp),
            part.scene_file,
        )
        for i in range(batches.batches)
    ]


def _placed(
    config: RenderConfig, directory: Path, seed: int, time: float | None = None, spp: int | None = None
) -> RenderConfig:
    replace = msgspec.structs.replace
    return replace(
        config,
        seed=seed,
        budget=replace(config.budget, time=time, spp=spp),
        output=replace(config.output, directory=str(directory), interval=NO_PROGRESSIVE_PICTURES),
    )


def _merged(
    source: YamlSource, keys: Keys, base: RenderConfig | None, scene: Scene, file: Path, overrides: Overrides
) -> RenderConfig:
    """The render config of a scene with overrides; an error names the compare config's line as well."""
    for key in overrides:
        if key in ("seed", "scene") or key.split(".")[0] in ("budget", "output", "film", "camera") and base is not None:
            raise source.error(
                (*keys, key),
                "found it here; allowed: keys of the method; budgets, seeds and pictures are the comparison's",
            )
    try:
        return load_config(_beside(file, scene.config), [*plain_text(scene.set), *plain_text(overrides)])
    except InputError as error:
        raise source.error(keys, str(error)) from None


def _times(source: YamlSource, keys: Keys, config: CompareConfig, scene: Scene) -> list[float]:
    own = scene.budgets is not None
    found: list[str | float] = scene.budgets if scene.budgets is not None else config.budgets
    times = []
    for i, text in enumerate(found):
        try:
            times.append(parse_time(text) * config.scale)
        except InputError as error:
            raise source.error((*keys, "budgets", i) if own else ("budgets", i), str(error)) from None
    return times


def _budget(source: YamlSource, keys: Keys, batches: Batches) -> None:
    try:
        check_budget(batches.budget)
    except InputError as error:
        raise source.error(keys, str(error)) from None


def _beside(file: Path, path: str) -> Path:
    return file.parent / path


def _file_name(variant: Variant) -> str:
    return variant.label.replace(" ", "_")


def as_plain(config: RenderConfig) -> dict[str, Any]:
    """What decides a run's samples: the config without where its pictures go."""
    plain: dict[str, Any] = msgspec.to_builtins(config)
    del plain["output"]
    return plain
