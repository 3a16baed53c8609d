"""Times as people write them."""

import pytest

from causticmpi.config.units import parse_time
from causticmpi.errors import InputError


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("30s", 30.0),
        ("4min", 240.0),
        ("1h", 3600.0),
        ("1h30min", 5400.0),
        ("1h 30min 5s", 5405.0),
        ("1.5 H", 5400.0),
        ("1e2s", 100.0),
        (".5min", 30.0),
        ("90", 90.0),
        (90, 90.0),
        (90.5, 90.5),
    ],
)
def test_parse_time(text: str | float, seconds: float) -> None:
    assert parse_time(text) == seconds


@pytest.mark.parametrize(
    "text",
    [
        "4 parsecs",
        "",
        " ",
        "s",
        "1:30",
        "30m",
        "5min1h",
        "1h1h",
        "0",
        "0s",
        "-3s",
        "-3",
        "nan",
        "inf",
        "1e999h",
        0,
        -1.0,
    ]
    + [float("nan"), float("inf"), 10**400, True],
)
def test_parse_time_refuses(text: str | float) -> None:
    with pytest.raises(InputError, match="found .*; allowed: .*(h, min and s|a finite time > 0)"):
        parse_time(text)


def test_time_error_names_the_units() -> None:
    with pytest.raises(InputError) as caught:
        parse_time("4 parsecs")
    assert str(caught.value).startswith('found "4 parsecs"; allowed: a time in h, min and s, such as 30s, 4min')
