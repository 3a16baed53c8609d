"""A config file and the command line's overrides -> one validated RenderConfig."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from causticmpi.config.check import check_box, check_budget, check_camera, check_film
from causticmpi.config.convert import convert
from causticmpi.config.records import RenderConfig
from causticmpi.config.yaml_source import Keys, YamlSource, parse_yaml, read_yaml
from causticmpi.errors import InputError

OPTIONS: dict[str, Keys] = {
    "--method": ("method",),
    "--time": ("budget", "time"),
    "--spp": ("budget", "spp"),
    "--until": ("budget", "until"),
    "--seed": ("seed",),
    "--out": ("output", "directory"),
}
"""Options of the command line that are short for a key."""
_TEXT_OPTIONS = ("--method", "--time", "--until", "--out")
_BUDGETS = {"time": "spp", "spp": "time"}


def load_config(path: str | Path, overrides: Mapping[str, str] | Sequence[str] = ()) -> RenderConfig:
    """Read, override and validate a config file; `budget.time` of the result is in seconds.

    overrides: {"film.width": "320"} or ["film.width=320"], values in YAML; a key may also be one of OPTIONS
    ({"--spp": "16"} or ["--spp=16"]). The file is validated whole before they apply. `budget.time` replaces the
    file's `budget.spp`, and the reverse. Raises InputError that names file:line, or the override to blame.
    """
    return config_of(read_config(path), overrides)


def read_config(path: str | Path) -> YamlSource:
    """The source of a config file whose values are valid as they stand, for `config_of`. Raises InputError."""
    source = read_yaml(path)
    if isinstance(source.data, dict) and {"scene", "shapes"} & source.data.keys() == {"shapes"}:
        raise InputError("it is a scene; allowed: a config, which names one by `scene: FILE`", source.file)
    _validated(source)
    return source


def config_of(source: YamlSource, overrides: Mapping[str, str] | Sequence[str] = ()) -> RenderConfig:
    """The config of a source that `read_config` gave, with overrides as for `load_config`. Raises InputError."""
    source = overridden(source, overrides)
    config = _validated(source)
    scene = scene_path(source.file, config)
    if not scene.is_file():
        reason = "is a directory" if scene.is_dir() else "no such file"
        raise source.error(("scene",), f"cannot read {scene}: {reason}; the path is relative to the config file")
    return config


def overridden(source: YamlSource, overrides: Mapping[str, str] | Sequence[str]) -> YamlSource:
    """A copy of the source with the overrides (see `load_config`) applied; not validated. Raises InputError."""
    changed = YamlSource(source.file, copy.deepcopy(source.data), dict(source.places))
    for origin, keys, value in _parsed(overrides):
        _apply(changed, origin, keys, value)
    return changed


def scene_path(config_path: str | Path, config: RenderConfig) -> Path:
    """Path of the scene file: relative to the config file that names it."""
    return Path(config_path).parent / config.scene


def _validated(source: YamlSource) -> RenderConfig:
    config = convert(source, (), source.data, RenderConfig)
    with source.placing(("film",), "crop", "width", "height"):
        check_film(config.film)
    with source.placing(("budget",), "time", "spp", "until"):
        budget = check_budget(config.budget)
    with source.placing(("camera",), "eye", "target", "up"):
        if config.camera is not None:
            check_camera(config.camera)
    with source.placing(("forecast", "aim")):
        if not isinstance(config.forecast.aim, str):
            check_box(config.forecast.aim)
    for keys, text in ((("scene",), config.scene), (("output", "directory"), config.output.directory)):
        if not text.strip():
            raise source.error(keys, 'found ""; allowed: a path; write one')
    return msgspec.structs.replace(config, budget=budget)


def _parsed(overrides: Mapping[str, str] | Sequence[str]) -> Iterator[tuple[str, Keys, Any]]:
    """(name for errors, keys, value) of every override."""
    pairs = overrides.items() if isinstance(overrides, Mapping) else map(_split, overrides)
    for key, raw in pairs:
        text = str(raw)
        if key.startswith("--"):
            if key not in OPTIONS:
                raise InputError(f"unknown option; allowed: {', '.join(OPTIONS)}", f"{key} {text}")
            origin, keys = f"{key} {text}", OPTIONS[key]
        else:
            origin, keys = f"--set {key}={text}", tuple(key.split("."))
        if not all(keys):
            raise InputError("found an empty key; allowed: key.sub=value; write for example film.width=320", origin)
        yield origin, keys, text if key in _TEXT_OPTIONS else _value(text, origin)


def _split(override: str) -> tuple[str, str]:
    key, equals, text = override.partition("=")
    if not equals:
        raise InputError("found no `=`; allowed: key.sub=value; write for example film.width=320", f"--set {override}")
    return key.strip(), text


def _value(text: str, origin: str) -> Any:
    return parse_yaml(text, lambda message, line: InputError(message.lstrip(": "), origin), {})


def _apply(source: YamlSource, origin: str, keys: Keys, value: Any) -> None:
    """Set one key in the data, and remember the override as its place."""
    node = source.data
    for end, key in enumerate(keys[:-1], 1):
        if not isinstance(node.get(key), dict):
            # A section the file does not have, or a value that has no keys: conversion will say which.
            node[key] = {}
            _forget(source, keys[:end])
            source.places[keys[:end]] = origin
        node = node[key]
    _forget(source, keys)
    node[keys[-1]] = value
    source.places[keys] = origin
    if keys[0] == "budget" and len(keys) == 2 and keys[1] in _BUDGETS and value is not None:
        rival = ("budget", _BUDGETS[str(keys[1])])
        # Two limits from the command line contradict each other; one from the file gives way.
        if not isinstance(source.places.get(rival, 1), str):
            node.pop(rival[1], None)
            source.places.pop(rival, None)


def _forget(source: YamlSource, keys: Keys) -> None:
    for inner in [place for place in source.places if place[: len(keys)] == keys]:
        del source.places[inner]
