"""Tables of `compare` from runs made up by hand."""

import csv
import dataclasses
import io
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from causticmpi.compare.analysis import Group, Measured, PartResult, Point
from causticmpi.compare.metrics import Errors
from causticmpi.compare.page import Image, Section, page
from causticmpi.compare.records import Scene
from causticmpi.compare.tables import (
    Table,
    error_table,
    number,
    samples_table,
    slope_table,
    to_csv,
    to_markdown,
    variant_table,
)

NO_ERRORS = Errors(**{field.name: math.nan for field in dataclasses.fields(Errors)})


def group(label: str, method: str, passes: list[int], rmse: list[float], biased: bool = False) -> Group:
    """A variant with one final picture per seed."""
    runs: Any = [
        Measured(SimpleNamespace(seed=seed), {}, [Point(n, 1.0, dataclasses.replace(NO_ERRORS, rmse=e, relmse=e * e))])  # type: ignore[arg-type]
        for seed, (n, e) in enumerate(zip(passes, rmse, strict=True), 1)
    ]
    name = label + (" (biased)" if biased else "")
    return Group(label, name, method, biased, 4.0, runs, np.zeros((1, 1, 3)), np.zeros((1, 1)))


def result(*groups: Group, paper: Any = None) -> PartResult:
    """One scene with one budget."""
    part: Any = SimpleNamespace(name="box", title="Box", scene=Scene(config="box.yaml", paper=paper))
    reference: Any = None
    return PartResult(part, reference, np.array([[True, False]]), {4.0: list(groups)})


def test_variants_are_compared_seed_by_seed() -> None:
    one = group("one", "iws+cf", [100, 200], [1.0, 2.0])
    two = group("two", "iws+cf", [84, 168], [0.99, 1.98])
    table = variant_table(result(one, two))
    assert table is not None and "one" in table.title
    assert table.rows == (("two", "-16.0 % ± 0.0", "-1.0 % ± 0.0", "-2.0 % ± 0.0", "–"),)


def test_methods_are_no_variants_of_each_other() -> None:
    assert variant_table(result(group("pt", "pt", [9, 9], [1, 1]), group("cf", "iws+cf", [1, 1], [1, 1]))) is None
    assert variant_table(result(group("a", "pt", [9], [1]), group("b", "pt", [1], [1]))) is None


def test_samples_stand_beside_the_papers() -> None:
    box = result(group("pt", "pt", [675], [1]), group("cf", "iws+cf", [100], [1]), paper="cornell")
    table = samples_table([box, result(group("pt", "pt", [1], [1]))])
    assert table is not None
    assert [row[1:] for row in table.rows] == [
        ("pt", "675 in 4 s", "6.75", "405 (4 min, Figure 4)", "6.75"),
        ("cf", "100 in 4 s", "1", "60 (4 min, Figure 4)", "1"),
    ]


def test_a_biased_method_is_called_so_in_every_row() -> None:
    box = result(group("pt", "pt", [4], [2]), group("pm", "iws+pm", [2], [1], biased=True), paper="cornell")
    samples = samples_table([box])
    assert samples is not None
    for table in (error_table(box, 4.0), slope_table(box), samples):
        assert [cell for row in table.rows for cell in row if cell.startswith("pm")] == ["pm (biased)"]
    assert error_table(box, 4.0).rows[1][-1] == "4"  # a quarter of the squared error at equal time


def test_csv_markdown_and_html_hold_the_same_cells() -> None:
    table = Table("t", "A <title>", ("a", "b"), (("1, 2", "<b>"), ("3", '"4"')), "A note.")
    assert list(csv.reader(io.StringIO(to_csv(table)))) == [["a", "b"], ["1, 2", "<b>"], ["3", '"4"']]
    assert "| 1, 2 | <b> |" in to_markdown(table)
    text = page("P", ["intro"], [Section("S", [], [table, Image("i", b"\x89PNG...", 'cap "x"')])])
    assert "A &lt;title&gt;" in text and "<td>&lt;b&gt;</td>" in text
    assert 'src="data:image/png;base64,iVBORy4uLg=="' in text and 'alt="cap &quot;x&quot;"' in text


@pytest.mark.parametrize(("value", "shown"), [(math.nan, "–"), (0.012345, "0.0123"), (8891.4, "8891"), (-0.5, "-0.5")])
def test_numbers_for_people(value: float, shown: str) -> None:
    assert number(value) == shown
