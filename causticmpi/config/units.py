"""Times and shares as people write them."""

import math
import re

from causticmpi.errors import InputError

_NUMBER = r"((?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)"
_TIME = re.compile(rf"(?:{_NUMBER}\s*h)?\s*(?:{_NUMBER}\s*min)?\s*(?:{_NUMBER}\s*s)?")
_PLAIN = re.compile(rf"[-+]?{_NUMBER}")
_SECONDS = (3600.0, 60.0, 1.0)


def parse_time(value: str | float) -> float:
    """Seconds meant by "30s", "4min", "1h", "1h30min", or a plain number of seconds. Units: h, min, s, in this order.

    Returns a finite number > 0. Raises InputError, without a place, for anything else.
    """
    seconds = _seconds(value)
    if seconds is None:
        found = f'"{value}"' if isinstance(value, str) else str(value)
        raise InputError(
            f"found {found}; allowed: a time in h, min and s, such as 30s, 4min, 1h30min, or a number of seconds"
        )
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InputError(f"found {value}; allowed: a finite time > 0; write for example 30s")
    return seconds


def _seconds(value: str | float) -> float | None:
    """Seconds without a check of their range, or None where the text is no time."""
    if isinstance(value, bool):
        return None
    if not isinstance(value, str):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    text = value.strip().lower()
    if _PLAIN.fullmatch(text):
        return float(text)
    parts = _TIME.fullmatch(text)
    if parts is None or not text:
        return None
    return sum(float(part) * unit for part, unit in zip(parts.groups(), _SECONDS, strict=True) if part)


def parse_share(value: str | float) -> float:
    """The number > 0 meant by "1%" or 0.01. Raises InputError, without a place, for anything else."""
    text = str(value).strip()
    number = text.removesuffix("%").strip()
    found = math.nan if isinstance(value, bool) or not _PLAIN.fullmatch(number) else float(number)
    found = found / 100 if text.endswith("%") else found
    if not (math.isfinite(found) and found > 0):
        raise InputError(f"found {value}; allowed: a number > 0 or a percentage; write for example 1%")
    return found
