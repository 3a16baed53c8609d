"""A compare config and the render configs it names, each read once -> a validated plan; every error names its line."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from causticmpi.compare.plan import Part, Plan, compared_runs
from causticmpi.compare.records import Batches, CompareConfig, Overrides, Scene, plain_text
from causticmpi.config.check import check_budget
from causticmpi.config.convert import convert, nearest
from causticmpi.config.load import config_of, overridden, read_config, scene_path
from causticmpi.config.records import RenderConfig
from causticmpi.config.units import parse_time
from causticmpi.config.yaml_source import Keys, YamlSource, read_yaml
from causticmpi.render.methods import BIASED

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
    reader = _Reader(source, config)
    reader.check_names()
    reader.check_overrides()
    directory = Path(out if out is not None else config.output)
    parts = tuple(reader.part(i, scene, directory) for i, scene in enumerate(config.scenes))
    return Plan(config, source.file, directory, Path(config.reference.directory), parts)


class _Reader:
    """What the compare config says, checked; and the render configs that it leads to."""

    def __init__(self, source: YamlSource, config: CompareConfig) -> None:
        self.source, self.config = source, config
        self.renders: dict[Path, YamlSource] = {}

    def check_names(self) -> None:
        """Raises InputError for a name or label used twice, or a label named and not there."""
        labels = [variant.label for variant in self.config.variants]
        for i, label in enumerate(labels):
            if label in labels[:i]:
                raise self.source.error(
                    ("variants", i, "label"), f'found "{label}" twice; allowed: one variant per label'
                )
        names = [scene.name or Path(scene.config).stem for scene in self.config.scenes]
        for i, scene in enumerate(self.config.scenes):
            if names[i] in names[:i]:
                raise self.source.error(
                    ("scenes", i), f'found the name "{names[i]}" twice; allowed: one each; write `name: ...`'
                )
            for wanted in scene.variants or ():
                if wanted not in labels:
                    raise self.source.error(
                        ("scenes", i, "variants"),
                        f'found "{wanted}"; allowed: {", ".join(labels)}{nearest(wanted, labels)}',
                    )

    def check_overrides(self) -> None:
        """Raises InputError for one of a key that is not its own to set."""
        for i, scene in enumerate(self.config.scenes):
            self._forbid(("scenes", i, "set"), scene.set, OURS)
        for i, variant in enumerate(self.config.variants):
            self._forbid(("variants", i, "set"), variant.set, (*OURS, *PICTURE))
        self._forbid(("reference", "estimate", "set"), self.config.reference.estimate.set, (*OURS, *PICTURE))
        self._forbid(("reference", "check", "set"), self.config.reference.check.set, (*OURS, *PICTURE))

    def part(self, index: int, scene: Scene, directory: Path) -> Part:
        """One scene with all its runs."""
        keys: Keys = ("scenes", index)
        file = self.source.file.parent / scene.config
        with self.source.placing((*keys, "config")):
            if file not in self.renders:
                self.renders[file] = read_config(file)
                config_of(self.renders[file])
        base = self._merged((*keys, "set"), scene, {})
        self._check_closeups(keys, scene, base)
        budgets = self._budgets(keys, scene)
        variants = [
            (variant, self._merged(("variants", i, "set"), scene, variant.set))
            for i, variant in enumerate(self.config.variants)
            if scene.variants is None or variant.label in scene.variants
        ]
        if all(variant.timing_only for variant, _ in variants):
            raise self.source.error((*keys, "variants"), "found none to compare; allowed: at least one not timing_only")
        name = scene.name or file.stem
        scene_file = scene_path(file, base)
        seeds = range(1, (scene.seeds or self.config.seeds) + 1)
        return Part(
            name=name,
            title=scene.title or name,
            scene=scene,
            base=base,
            scene_file=scene_file,
            labels=tuple(variant.label for variant, _ in variants),
            budgets=budgets,
            runs=compared_runs(name, scene_file, variants, budgets, seeds, directory / "runs" / name),
            reference=None if scene.reference is None else self.source.file.parent / scene.reference,
            estimate=self._batch(("reference", "estimate"), scene, self.config.reference.estimate),
            check=self._batch(("reference", "check"), scene, self.config.reference.check),
        )

    def _batch(self, keys: Keys, scene: Scene, batches: Batches) -> RenderConfig:
        """The config of a batch of this scene's reference, budget included."""
        config = self._merged((*keys, "set"), scene, batches.set)
        if config.method in BIASED:
            raise self.source.error(
                (*keys, "set"), f"found {config.method}, which is biased; allowed: an unbiased method; write method: pt"
            )
        with self.source.placing((*keys, "budget")):
            return replace(config, budget=check_budget(batches.budget))

    def _forbid(self, keys: Keys, overrides: Overrides, forbidden: Sequence[str]) -> None:
        for key in overrides:
            if key.split(".")[0] in forbidden:
                raise self.source.error(
                    (*keys, key), f"found it here; allowed: any key but {', '.join(forbidden)}; delete it"
                )

    def _merged(self, keys: Keys, scene: Scene, overrides: Overrides) -> RenderConfig:
        """The render config of a scene with overrides; an error names the compare config's line as well."""
        render = self.renders[self.source.file.parent / scene.config]
        with self.source.placing(keys):
            return config_of(render, [*plain_text(scene.set), *plain_text(overrides)])

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
        here = keys if scene.budgets is not None else ()
        times = set()
        for i, text in enumerate(self.config.budgets if scene.budgets is None else scene.budgets):
            with self.source.placing((*here, "budgets", i)):
                times.add(parse_time(text) * self.config.scale)
        return tuple(sorted(times))
