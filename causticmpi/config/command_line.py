"""A command line whose errors are one line each; the program and its scripts read theirs by it."""

import argparse
import math
import re
from collections.abc import Iterable
from typing import Any, NoReturn

from causticmpi.errors import InputError


class UsageError(InputError):
    """A wrong command line; the message begins with the program and the verb."""


def one_line(error: InputError, program: str) -> str:
    """What to print of bad input: it names the program once."""
    return str(error) if isinstance(error, UsageError) else f"{program}: {error}"


class Parser(argparse.ArgumentParser):
    """Each error is one line that names the verb, what is allowed, and the name that may have been meant.

    Options cannot be abbreviated. Raises UsageError where argparse would print and exit.
    """

    def __init__(self, **named: Any) -> None:
        super().__init__(allow_abbrev=False, **named)
        # Values that begin with a minus, such as `--time -5s`, are values: whoever converts them says what is allowed.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        names = message.removeprefix("the following arguments are required: ")
        if names != message:
            absent = [_shape(a) for a in self._actions if _name(a) in names.split(", ")]
            allowed = [self._meaning(a) for a in self._actions if _name(a) in names.split(", ")]
            message = f"found no {' and no '.join(absent)}; allowed: {'; '.join(allowed)}"
        end = " See" if message.endswith("?") else "; see"
        raise UsageError(f"{self.prog}: {message.removeprefix('argument ')}{end} {self.prog} --help")

    def parse_known_args(self, *given: Any) -> tuple[argparse.Namespace, list[str]]:  # type: ignore[override]
        """As argparse does it, but a verb refuses unknown words itself: the program would not know whose they are."""
        arguments, unknown = super().parse_known_args(*given)
        if unknown and unknown[0].startswith("-"):
            self.error(_found(unknown[0].partition("=")[0], self._option_string_actions))
        if unknown:
            self.error(f'found "{unknown[0]}", one word too many')
        return arguments, unknown

    def _match_argument(self, action: argparse.Action, pattern: str) -> int:
        try:
            return super()._match_argument(action, pattern)
        except argparse.ArgumentError:
            message = f"found nothing after it; allowed: {_shape(action)}, {self._meaning(action)}"
            raise argparse.ArgumentError(action, message) from None

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, _found(str(value), action.choices))

    def _meaning(self, action: argparse.Action) -> str:
        return self._get_formatter()._expand_help(action)


def _name(action: argparse.Action) -> str | None:
    """As argparse calls it in its messages."""
    return "/".join(action.option_strings) or str(action.metavar or action.dest)


def _shape(action: argparse.Action) -> str:
    """How it is written: `CONFIG`, `-o DIR`."""
    return " ".join([*action.option_strings[:1], str(action.metavar or action.dest.upper())])


def _found(word: str, allowed: Iterable[str]) -> str:
    from causticmpi.config.convert import nearest  # late: a right command line needs no msgspec

    names = list(allowed)
    return f'found "{word}"; allowed: {", ".join(names)}{nearest(word, names)}'


def count(text: str) -> int:
    """An integer from 1, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'found "{text}"; allowed: an integer >= 1')
    return int(text)


def positive(text: str) -> float:
    """A finite number > 0, for argparse."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f'found "{text}"; allowed: a number > 0')
    return number
