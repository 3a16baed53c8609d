"""A compare config and the render configs it names -> a validated plan of all runs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from causticmpi.compare.plan import Part, Plan, Run
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
OURS = ("scene", "seed", "budget", "output")
"""Keys of a render config that only the comparison sets."""
PICTURE = ("film", "camera")
"""Keys that belong to a scene of the comparison: all variants make the same picture."""


def load_plan(file: str | Path, overrides: Mapping[str, str] | Sequence[str] = (), out: str | None = None) -> Plan:
    """Read and validate the compare config and every render config it leads to. Raises InputError with its place."""
    source = read_yaml(file)
    config = convert(source, (), source.data, CompareConfig)
    if overrides:
        source = overridden(source, overrides)
        config = convert(source, (), source.data, CompareConfig)
    reader = _Reader(source, config, Path(out if out is not None else config.output))
    reader.check_labels()
    parts = tuple(reader.part(i, scene) for i, scene in enumerate(config.scenes))
    names = [part.name for part in parts]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise source.error(("scenes", i), f'found the name "{name}" twice; allowed: one each; write `name: ...`')
    for part in parts:
        reader.check_reference(part)
    return Plan(config, source.file, reader.directory, Path(config.reference.directory), parts)


def batch_runs(plan: Plan, part: Part, batches: Batches, role: str, directory: Path) -> list[Run]:
    """The renders a reference of this part consists of. role: estimate or check; their seeds do not overlap."""
    first = plan.config.reference.seed + (0 if role == "estimate" else plan.config.reference.estimate.batches)
    settings = [*plain_text(part.scene.set), *plain_text(batches.set)]
    config = load_config(plan.file.parent / part.scene.config, settings)
    budget = check_budget(batches.budget)
    seconds = None if budget.time is None else float(budget.time)
    return [
        Run(
            part.name,
            f"reference, {role}",
            seconds,
            first + i,
            _placed(config, directory / role / str(i), first + i, seconds, budget.spp),
            part.scene_file,
        )
        for i in range(batches.batches)
    ]


def _placed(config: RenderConfig, directory: Path, seed: int, seconds: float | None, spp: int | None) -> RenderConfig:
    replace = msgspec.structs.replace
    return replace(
        config,
        seed=seed,
        budget=replace(config.budget, time=seconds, spp=spp, until=None),
        output=replace(config.output, directory=str(directory), interval=NO_PROGRESSIVE_PICTURES, checkpoint=0.0),
    )


class _Reader:
    """From a config to its parts; every error names the line to mend."""

    def __init__(self, source: YamlSource, config: CompareConfig, directory: Path) -> None:
        self.source, self.config, self.directory = source, config, directory

    def check_labels(self) -> None:
        """Raises InputError for a label used twice, or named and not there."""
        labels = [variant.label for variant in self.config.variants]
        for i, label in enumerate(labels):
            if label in labels[:i]:
                raise self.source.error(
                    ("variants", i, "label"), f'found "{label}" twice; allowed: one variant per label'
                )
        for i, scene in enumerate(self.config.scenes):
            for wanted in scene.variants or ():
                if wanted not in labels:
                    raise self.source.error(
                        ("scenes", i, "variants"),
                        f'found "{wanted}"; allowed: {", ".join(labels)}{nearest(wanted, labels)}',
                    )

    def part(self, index: int, scene: Scene) -> Part:
        """One scene with all its runs."""
        keys: Keys = ("scenes", index)
        self._forbid((*keys, "set"), scene.set, OURS)
        try:
            load_config(self._beside(scene.config))
        except InputError as error:
            raise self.source.error((*keys, "config"), str(error)) from None
        base = self._merged((*keys, "set"), scene, {})
        self._check_closeups(keys, scene, base)
        budgets = self._budgets(keys, scene)
        variants = [v for v in self.config.variants if scene.variants is None or v.label in scene.variants]
        if all(variant.timing_only for variant in variants):
            raise self.source.error((*keys, "variants"), "found none to compare; allowed: at least one not timing_only")
        name = scene.name or Path(scene.config).stem
        scene_file = scene_path(self._beside(scene.config), base)
        runs = tuple(
            Run(name, variant.label, seconds, seed, config, scene_file)
            for seconds in budgets
            for variant in variants
            for seed, config in self._seeded(name, scene, variant, seconds, budgets[0])
        )
        labels = tuple(variant.label for variant in variants)
        reference = None if scene.reference is None else self._beside(scene.reference)
        return Part(name, scene.title or name, scene, base, scene_file, labels, budgets, runs, reference)

    def check_reference(self, part: Part) -> None:
        """Raises InputError where the reference of this part could not be made as the config says."""
        for role in ("estimate", "check"):
            batches: Batches = getattr(self.config.reference, role)
            keys: Keys = ("reference", role)
            self._forbid((*keys, "set"), batches.set, (*OURS, *PICTURE))
            method = self._merged((*keys, "set"), part.scene, batches.set).method
            if method in BIASED:
                raise self.source.error(
                    (*keys, "set"), f"found {method}, which is biased; allowed: an unbiased method; write method: pt"
                )
            try:
                check_budget(batches.budget)
            except InputError as error:
                raise self.source.error((*keys, "budget"), str(error)) from None

    def _seeded(
        self, name: str, scene: Scene, variant: Variant, seconds: float, shortest: float
    ) -> Iterator[tuple[int, RenderConfig]]:
        """The seeds of a variant at one budget, with the config of each."""
        keys: Keys = ("variants", self.config.variants.index(variant), "set")
        self._forbid(keys, variant.set, (*OURS, *PICTURE))
        config = self._merged(keys, scene, variant.set)
        folder = self.directory / "runs" / name / variant.label.replace(" ", "_")
        if not variant.timing_only:
            for seed in range(1, (scene.seeds or self.config.seeds) + 1):
                yield seed, _placed(config, folder / f"{seconds:g}s-{seed}", seed, seconds, None)
        elif seconds == shortest:
            yield 1, _placed(config, folder / f"{seconds:g}s-1", 1, min(seconds, LONGEST_TIMING), None)

    def _forbid(self, keys: Keys, overrides: Overrides, forbidden: Sequence[str]) -> None:
        for key in overrides:
            if key.split(".")[0] in forbidden:
                raise self.source.error(
                    (*keys, key), f"found it here; allowed: any key but {', '.join(forbidden)}; delete it"
                )

    def _merged(self, keys: Keys, scene: Scene, overrides: Overrides) -> RenderConfig:
        """The render config of a scene with overrides; an error names the compare config's line as well."""
        try:
            return load_config(self._beside(scene.config), [*plain_text(scene.set), *plain_text(overrides)])
        except InputError as error:
            raise self.source.error(keys, str(error)) from None

    def _check_closeups(self, keys: Keys, scene: Scene, base: RenderConfig) -> None:
        x0, y0, x1, y1 = base.film.window
        for i, (left, top, right, bottom) in enumerate(scene.closeups):
            if not (x0 <= left < right <= x1 and y0 <= top < bottom <= y1):
                raise self.source.error(
                    (*keys, "closeups", i),
                    f"found {[left, top, right, bottom]}; allowed: [x0, y0, x1, y1] within {[x0, y0, x1, y1]}",
                )

    def _budgets(self, keys: Keys, scene: Scene) -> tuple[float, ...]:
        """In seconds, ascending, scaled."""
        own = scene.budgets is not None
        found: list[str | float] = scene.budgets if scene.budgets is not None else self.config.budgets
        times = set()
        for i, text in enumerate(found):
            try:
                times.add(parse_time(text) * self.config.scale)
            except InputError as error:
                raise self.source.error((*keys, "budgets", i) if own else ("budgets", i), str(error)) from None
        return tuple(sorted(times))

    def _beside(self, path: str) -> Path:
        return self.source.file.parent / path
