"""YAML files with the line of every key, so that each error can name its place.

The scalars follow YAML 1.2's core schema: `1e-3` is a number, `no` and `1:30` are texts. Underscores in integers
(200_000) are read as YAML 1.1 does. Aliases, deep nesting, duplicate keys and numbers that are not finite are refused.
"""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yaml import MarkedYAMLError, YAMLError
from yaml.composer import Composer
from yaml.events import AliasEvent
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.resolver import BaseResolver
from yaml.scanner import Scanner

from causticmpi.errors import InputError, reason

MAX_DEPTH = 16
MAX_INTEGER = 2**64

Keys = tuple[str | int, ...]
"""Way to a value: ("film", "crop", 0)."""
Fail = Callable[[str, int], InputError]
"""Makes the error of a message and a line (from 1)."""


@dataclass(frozen=True)
class YamlSource:
    """Plain data of a file and where each key came from: a line, or the command-line option that set it."""

    file: Path
    data: Any
    places: dict[Keys, int | str]

    def place(self, keys: Keys) -> int | str:
        """Line or option of the key, or of the nearest section around it that has one."""
        for end in range(len(keys), -1, -1):
            if keys[:end] in self.places:
                return self.places[keys[:end]]
        return 1

    def error(self, keys: Keys, message: str, place: int | str | None = None) -> InputError:
        """The error of the value at `keys`: place (that of `keys` unless given), name of the key, message."""
        place = place or self.place(keys)
        name = dotted(keys)
        text = f"{name}: {message}" if name else message
        return InputError(text, place) if isinstance(place, str) else InputError(text, self.file, place)

    @contextmanager
    def placing(self, keys: Keys, *rivals: str) -> Iterator[None]:
        """Around a check that does not know where its value stands: its InputError gets the place of `keys`, or of the
        key in there that leads the message ("crop: found ..."). Of `rivals`, keys in there that one rule ties together,
        the one that the command line set is to blame.
        """
        try:
            yield
        except InputError as error:
            key, _, rest = str(error).partition(": ")
            named, message = ((*keys, key), rest) if key.isidentifier() else (keys, str(error))
            places = (self.places.get((*keys, rival)) for rival in rivals)
            place = next((place for place in places if isinstance(place, str)), None)
            raise self.error(named, message, place) from None


def dotted(keys: Keys) -> str:
    """("film", "crop", 0) -> film.crop[0]."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".")


def read_yaml(file: str | Path) -> YamlSource:
    """Read one YAML file. Raises InputError with file and line for whatever is not plain, finite, unambiguous data."""
    path = Path(file)
    try:
        raw = path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read: {reason(error)}; give the path of a readable YAML file", path) from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"found byte 0x{raw[error.start]:02x}, which is not UTF-8; save the file as UTF-8", path, line
        ) from None
    places: dict[Keys, int | str] = {}
    data = parse_yaml(text, lambda message, line: InputError(message, path, line), places)
    if data is None:
        raise InputError("the file is empty; needs at least one `key: value`", path)
    return YamlSource(path, data, places)


def parse_yaml(text: str, fail: Fail, places: dict[Keys, int | str]) -> Any:
    """Plain data of one YAML text; `places` receives the line of every key. Raises what `fail` makes."""
    control = Reader.NON_PRINTABLE.search(text)
    if control:
        line = text.count("\n", 0, control.start()) + 1
        raise fail(f"found control character {control.group()!r}; delete it", line)
    loader = _Composing(text)
    try:
        node = loader.get_single_node()
    except _RefusedError as refused:
        raise fail(str(refused), refused.line) from None
    except MarkedYAMLError as error:
        # An unclosed bracket is found at the end of the file; the place to mend is where it opens.
        unclosed = error.context_mark if "end>" in (error.problem or "") else None
        mark = unclosed or error.problem_mark or error.context_mark
        what = ", ".join(part for part in (error.context, error.problem) if part)
        line = mark.line + 1 if mark else loader.line + 1
        mend = "indent with spaces" if "'\\t'" in what else "check indentation, colons, quotes and brackets"
        raise fail(f"YAML syntax: {what}; {mend}", line) from None
    except (YAMLError, ValueError, OverflowError) as error:
        raise fail(f"YAML syntax: {error}; check escapes and special characters", loader.line + 1) from None
    return None if node is None else _Plain(fail, places).value(node, ())


class _RefusedError(Exception):
    def __init__(self, message: str, line: int) -> None:
        super().__init__(message)
        self.line = line


class _Composing(Reader, Scanner, Parser, Composer, BaseResolver):
    """PyYAML's own stages with the core schema, without aliases, and with a limit on nesting."""

    def __init__(self, text: str) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)
        Composer.__init__(self)
        BaseResolver.__init__(self)
        self.depth = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        line = self.peek_event().start_mark.line + 1
        if self.check_event(AliasEvent):
            alias = self.peek_event().anchor
            raise _RefusedError(f"found alias *{alias}; aliases are not allowed; write the value out", line)
        if self.depth >= MAX_DEPTH:
            raise _RefusedError(f"found nesting deeper than {MAX_DEPTH} levels; flatten it", line)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


_TAG = "tag:yaml.org,2002:"
_DIGITS = "0123456789"
for _name, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?\d+(?:_\d+)*|0o[0-7]+|0x[0-9a-fA-F]+", list("-+" + _DIGITS)),
    ("float", r"[-+]?(?:\.\d+|\d+(?:\.\d*)?)(?:[eE][-+]?\d+)?", list("-+." + _DIGITS)),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", list("-+.")),
):
    _Composing.add_implicit_resolver(_TAG + _name, re.compile(rf"(?:{_pattern})\Z", re.ASCII), _first)


class _Plain:
    """Nodes -> dict, list, str, int, float, bool, None."""

    def __init__(self, fail: Fail, places: dict[Keys, int | str]) -> None:
        self.fail = fail
        self.places = places

    def value(self, node: Node, keys: Keys) -> Any:
        line = node.start_mark.line + 1
        self.places.setdefault(keys, line)
        if isinstance(node, MappingNode) and node.tag == _TAG + "map":
            return self.mapping(node, keys)
        if isinstance(node, SequenceNode) and node.tag == _TAG + "seq":
            return [self.value(child, (*keys, i)) for i, child in enumerate(node.value)]
        if isinstance(node, ScalarNode):
            return self.scalar(node, dotted(keys), line)
        raise self.fail(f"{dotted(keys)}: found tag {node.tag!r}; tags are not allowed; delete it", line)

    def mapping(self, node: MappingNode, keys: Keys) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, ScalarNode):
                raise self.fail("found a list or a section as a key; allowed: a plain name; write `name: value`", line)
            key = self.text(key_node.value, "key", line)
            here = (*keys, key)
            if key in found:
                first = self.places[here]
                raise self.fail(f'duplicate key "{dotted(here)}", first on line {first}; keep one of them', line)
            self.places[here] = line
            found[key] = self.value(value_node, here)
        return found

    def scalar(self, node: ScalarNode, name: str, line: int) -> Any:
        kind = node.tag.removeprefix(_TAG)
        text = node.value
        try:
            if kind == "null":
                return None
            if kind == "bool":
                return {"true": True, "false": False}[text.lower()]
            if kind == "int":
                return self.integer(text, name, line)
            if kind == "float":
                return self.number(text, name, line)
        except (KeyError, ValueError):
            raise self.fail(f'{name}: found "{text[:40]}", which is no {kind}; delete the tag', line) from None
        if kind != "str":
            raise self.fail(f"{name}: found tag {node.tag!r}; tags are not allowed; delete it", line)
        return self.text(text, name, line)

    def text(self, text: str, name: str, line: int) -> str:
        if not text.isprintable():
            raise self.fail(f"{name}: found {text[:40]!r}; control characters are not allowed; delete them", line)
        return text

    def integer(self, text: str, name: str, line: int) -> int:
        digits = text.lstrip("-+")
        base = {"0x": 16, "0o": 8}.get(digits[:2], 10)
        # Longer texts are beyond the range in every base, and int() is quadratic in them.
        number = MAX_INTEGER if len(digits) > 80 else int(text, base)
        if abs(number) >= MAX_INTEGER:
            raise self.fail(f"{name}: found an integer of {len(digits)} digits; allowed: below 2^64", line)
        return number

    def number(self, text: str, name: str, line: int) -> float:
        number = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        if not math.isfinite(number):
            raise self.fail(f"{name}: found {text[:40]}; allowed: finite numbers; write a finite one", line)
        return number
