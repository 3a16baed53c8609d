#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Write docs/reference.md anew: `scripts/reference.py`. Every key of the YAML files, from the records that
validate them; what a key does stands in its record's docstring as "key: ...; key, key: ...".
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import NODEFAULT, inspect

from causticmpi.compare.records import CompareConfig
from causticmpi.config.convert import describe, options, why
from causticmpi.config.records import RenderConfig
from causticmpi.scene.records import MATERIALS, SHAPES, SceneFile
from causticmpi.stability.records import Page

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference.md"
HEAD = """\
# Every key of every file

Made from the records that validate the files (`scripts/reference.py`). All files are YAML; a key that is not
here is an error. `none`: the key may be left out, or be `null`. Where *a number or a list of 3* is allowed, one number
stands for all three. Spectra are linear Rec.709. On the command line `--set key.sub=value` overrides a key of a config,
such as `--set forecast.photons=50_000`."""


def page() -> str:
    """The text of docs/reference.md. Raises LookupError for a key that its record says nothing of."""
    made: dict[type, str] = {}
    parts = [HEAD]
    parts += section("## Config", RenderConfig, "### ", made)
    parts += section("## Scene", SceneFile, "### ", made)
    for name, kinds in (("Material", MATERIALS), ("Shape", SHAPES)):
        for kind, record in kinds.items():
            parts += section(f"### {name}, type: {kind}", record, "", made)
    parts += section("## Config of compare", CompareConfig, "### Compare: ", made)
    parts += section("## Page of stability", Page, "### Stability: ", made)
    return "\n\n".join(parts) + "\n"


def section(heading: str, record: type, prefix: str, made: dict[type, str]) -> Iterator[str]:
    """Heading, summary and table of a record, then of those in it.

    prefix: of the headings of those; made: heading by record, for links; added to.
    """
    info = inspect.type_info(record)
    assert isinstance(info, inspect.StructType)
    summary, told = descriptions(record)
    inner = []
    lines = ["| key | default | allowed | what it does |", "|---|---|---|---|"]
    for field in info.fields:
        if field.name not in told:
            raise LookupError(f"{record.__name__}: its docstring says nothing of {field.name}")
        for found in structs(field.type):
            if found not in made:
                made[found] = f"{prefix}{field.name}"
                inner.append(found)
        lines.append(f"| `{field.name}` | {default(field)} | {allowed(field.type, made)} | {told[field.name]} |")
    yield heading
    yield summary
    yield "\n".join(lines)
    for found in inner:
        yield from section(made[found], found, f"{made[found]}.", made)


def descriptions(record: type) -> tuple[str, dict[str, str]]:
    """What the docstring of a record, or of one it inherits from, says of the record and of each key."""
    names = "|".join(record.__struct_fields__)
    key = re.compile(rf"(?:^|(?<=[;.?])\s)((?:{names})(?:, (?:{names}))*): ")
    told: dict[str, str] = {}
    summary = ""
    for kind in reversed(record.__mro__):
        if issubclass(kind, msgspec.Struct):
            summary, *pairs = key.split(" ".join((kind.__doc__ or "").split()))
            for keys, text in zip(pairs[::2], pairs[1::2], strict=True):
                told |= dict.fromkeys(keys.split(", "), text.rstrip("; ."))
    return summary, told


def structs(info: inspect.Type) -> Iterator[type]:
    """Records that a value may be, or be a list of."""
    for option in options(info):
        if isinstance(option, inspect.StructType):
            yield option.cls
        if isinstance(option, inspect.ListType):
            yield from structs(option.item_type)


def allowed(info: inspect.Type, made: dict[type, str]) -> str:
    """What a value may be, with links to the sections of records."""
    words = []
    for option in options(info):
        if isinstance(option, inspect.StructType):
            anchor = re.sub(r"[^a-z_ -]", "", made[option.cls].lstrip("# ").lower()).replace(" ", "-")
            words.append(f"[a section](#{anchor})")
        elif isinstance(option, inspect.ListType) and not isinstance(option.item_type, inspect.AnyType):
            words.append(f"a list, each {allowed(option.item_type, made)}")
        elif not isinstance(option, inspect.NoneType):
            words.append(describe(option))
    return " or ".join(words) + why(info)


def default(field: inspect.Field) -> str:
    """The default as YAML; nothing for a section that has its own."""
    value = field.default if field.default_factory is NODEFAULT else field.default_factory()
    if value is NODEFAULT:
        return "*needed*"
    if isinstance(value, msgspec.Struct):
        changed = {
            k: getattr(value, k) for k in value.__struct_fields__ if getattr(value, k) != getattr(type(value)(), k)
        }
        return f"`{shown(changed)}`" if changed else ""
    return f"`{shown(value)}`"


def shown(value: Any) -> str:
    """A plain value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {shown(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(shown, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "true", False: "false"}[value]
    return {float: "{:g}", int: "{:_}"}.get(type(value), "{}").format(value)


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE)
