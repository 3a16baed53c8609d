"""Charts of errors of any sign: what is left of an error less the reference's own noise need not be positive."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_compare_tables import NO_ERRORS, result

from causticmpi.compare.analysis import Group, Measured, PartResult, Point
from causticmpi.compare.charts import as_png, error_chart


def curve(errors: list[float]) -> PartResult:
    """One method with one seed and these errors by time."""
    points = [
        Point(passes, 0.1 * passes, dataclasses.replace(NO_ERRORS, relmse=error))
        for passes, error in enumerate(errors, 1)
    ]
    seed: Any = SimpleNamespace(seed=1)
    picture = np.zeros((1, 1, 3)), np.zeros((1, 1))
    return result(Group("pt", "pt", "pt", False, 4.0, [Measured(seed, {}, points)], *picture))


@pytest.mark.parametrize("errors", [[0.4, 0.2, 0.1], [1e-5, -2e-6, -1e-6], [-1e-5, -2e-6, -1e-6], [0.0, 0.0]])
@pytest.mark.parametrize("against", ["seconds", "passes"])
def test_errors_below_the_reference_are_drawn(errors: list[float], against: str) -> None:
    figure = error_chart(curve(errors), {"pt": "#123456"}, against)
    assert as_png(figure).startswith(b"\x89PNG")
    said = [text.get_text() for panel in figure.axes for text in panel.texts]
    unknown = len(figure.axes) - 1  # the other metrics are not known at all
    assert len(said) == unknown + (max(errors) <= 0)
