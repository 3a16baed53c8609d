"""Plain data -> frozen records, with errors that say what was found, what is allowed and how to mend it.

msgspec decides; this module only turns its verdict into a line a user can act on.
"""

import json
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from causticmpi.config.yaml_source import Keys, YamlSource
from causticmpi.errors import InputError

T = TypeVar("T")


def convert(source: YamlSource, keys: Keys, value: Any, record: type[T]) -> T:
    """The record of `value`, which stands at `keys` of `source`. Raises InputError with its place."""
    try:
        return msgspec.convert(value, record)
    except msgspec.ValidationError as error:
        raise _explain(source, keys, value, inspect.type_info(record), str(error)) from None


def nearest(found: str, allowed: Iterable[str]) -> str:
    """'; did you mean "x"?', or nothing where no allowed name is close."""
    close = get_close_matches(found.lower(), list(allowed), n=1, cutoff=0.5)
    return f'; did you mean "{close[0]}"?' if close else ""


def show(value: Any) -> str:
    """A found value, cut to a readable length."""
    if value is None:
        return "nothing"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


def _explain(source: YamlSource, keys: Keys, value: Any, info: inspect.Type, verdict: str) -> InputError:
    where = re.search(r" - at `\$(.*)`$", verdict)
    for step in re.finditer(r"\.(\w+)|\[(\d+)\]", where.group(1) if where else ""):
        key: str | int = step.group(1) if step.group(1) else int(step.group(2))
        value, info = _step(value, info, key)
        keys = (*keys, key)
    struct = _struct(info)
    if struct and isinstance(value, dict):
        unknown = next((key for key in value if key not in _names(struct)), None)
        if unknown is not None:
            return source.error((*keys, unknown), _unknown_key(unknown, struct))
        missing = next((f for f in struct.fields if f.required and f.name not in value), None)
        if missing is not None:
            return source.error(
                keys,
                f'missing key "{missing.name}"; add `{missing.name}: {_example(missing.type)}`{why(missing.type)}',
            )
    mend = f"; write for example {_example(info)}"
    allowed = _describe_all(info)
    if isinstance(value, str):
        mend = nearest(value, _literals(info)) or mend
    return source.error(keys, f"found {show(value)}; allowed: {allowed}{why(info)}{mend}")


def _unknown_key(key: str, struct: inspect.StructType) -> str:
    names = _names(struct)
    hint = nearest(key, names)
    if not hint:
        # A key in the wrong section: `spp` at the top belongs to `budget`.
        for field in struct.fields:
            section = _struct(field.type)
            if section and key in _names(section):
                hint = f'; did you mean "{field.name}.{key}"?'
    return f"unknown key{hint} Allowed: {', '.join(names)}" if hint else f"unknown key; allowed: {', '.join(names)}"


def _names(struct: inspect.StructType) -> list[str]:
    tag = [struct.tag_field] if struct.tag_field else []
    return tag + [field.encode_name for field in struct.fields]


def _step(value: Any, info: inspect.Type, key: str | int) -> tuple[Any, inspect.Type]:
    """One step down both the data and its type."""
    for option in options(info):
        if isinstance(option, inspect.StructType) and isinstance(key, str):
            return value[key], next(field.type for field in option.fields if field.encode_name == key)
        if isinstance(option, inspect.TupleType) and isinstance(key, int):
            return value[key], option.item_types[key]
        if isinstance(option, inspect.ListType) and isinstance(key, int):
            return value[key], option.item_type
    return value, info


def _plain(info: inspect.Type) -> inspect.Type:
    return info.type if isinstance(info, inspect.Metadata) else info


def options(info: inspect.Type) -> list[inspect.Type]:
    """The types that a value may have: those of a union, else its own."""
    info = _plain(info)
    return [_plain(option) for option in info.types] if isinstance(info, inspect.UnionType) else [info]


def _struct(info: inspect.Type) -> inspect.StructType | None:
    return next((option for option in options(info) if isinstance(option, inspect.StructType)), None)


def _literals(info: inspect.Type) -> list[str]:
    return [
        str(value) for option in options(info) if isinstance(option, inspect.LiteralType) for value in option.values
    ]


def why(info: inspect.Type) -> str:
    """The reason a record gives for its range (Meta(description=...))."""
    schema = (info.extra_json_schema or {}) if isinstance(info, inspect.Metadata) else {}
    return f" ({schema['description']})" if "description" in schema else ""


def _describe_all(info: inspect.Type) -> str:
    return " or ".join(describe(option) for option in options(info) if not isinstance(option, inspect.NoneType))


def describe(info: inspect.Type) -> str:
    """What a value of one of `options` may be, in words."""
    match info:
        case inspect.IntType() | inspect.FloatType():
            noun = "an integer" if isinstance(info, inspect.IntType) else "a number"
            limits = ((">", info.gt), (">=", info.ge), ("<", info.lt), ("<=", info.le))
            form = "d" if isinstance(info, inspect.IntType) else "g"
            bounds = " and ".join(f"{sign} {limit:{form}}" for sign, limit in limits if limit is not None)
            return f"{noun} {bounds}".rstrip()
        case inspect.TupleType(item_types=items):
            return f"a list of {len(items)}, each {_describe_all(items[0])}"
        case inspect.LiteralType(values=values):
            return ("one of " if len(values) > 1 else "") + ", ".join(str(value) for value in values)
        case inspect.StructType():
            return f"a section with the keys {', '.join(_names(info))}"
        case inspect.StrType():
            return "a text"
        case inspect.BoolType():
            return "true or false"
        case inspect.ListType():
            return "a list"
    return "a section `name: value`"


def _example(info: inspect.Type) -> str:
    option = options(info)[0]
    match option:
        case inspect.IntType() | inspect.FloatType():
            return next((str(n) for n in (1, 0.5, 1.5) if _within(n, option)), "1")
        case inspect.TupleType(item_types=items):
            return f"[{', '.join(_example(item) for item in items)}]"
        case inspect.LiteralType(values=values):
            return str(values[0])
        case inspect.StructType(fields=fields):
            chosen = [field for field in fields if field.required] or list(fields[:1])
            return "{" + ", ".join(f"{field.encode_name}: {_example(field.type)}" for field in chosen) + "}"
        case inspect.BoolType():
            return "false"
        case inspect.ListType():
            return "[...]"
        case inspect.StrType():
            return '"..."'
    return "{...}"


def _within(number: float, info: inspect.IntType | inspect.FloatType) -> bool:
    if isinstance(info, inspect.IntType) and not isinstance(number, int):
        return False
    return (
        (info.gt is None or number > info.gt)
        and (info.ge is None or number >= info.ge)
        and (info.lt is None or number < info.lt)
        and (info.le is None or number <= info.le)
    )
