"""docs/reference.md: every key of every file, as the records have them now."""

import math
import re
import runpy

import pytest
from mpi_tools import ROOT

from causticmpi.config.check import MAX_SIDE
from causticmpi.config.records import Film, Record
from causticmpi.scene.generated.catalogue import MESHES
from causticmpi.scene.materials import MAX_EXPONENT
from causticmpi.scene.records import Mesh, Phong

reference = runpy.run_path(str(ROOT / "scripts" / "reference.py"))


def test_the_page_is_current() -> None:
    assert reference["PAGE"].read_text() == reference["page"](), "make it anew: scripts/reference.py"


def test_every_link_leads_to_a_heading() -> None:
    page = reference["page"]()
    headings = [
        re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in page.split("\n")
        if line[:1] == "#"
    ]
    assert len(set(headings)) == len(headings)
    assert {link for link in re.findall(r"\]\(#([^)]*)\)", page)} <= set(headings)


def test_a_key_that_nothing_is_said_of_is_refused() -> None:
    class Told(Record):
        """Summary: a key. first, second: both of them; third: alone."""

        first: int = 1
        second: int = 2
        third: int = 3

    class Untold(Told):
        """More. fourth, which is in no list."""

        fourth: int = 4

    told = {"first": "both of them", "second": "both of them", "third": "alone"}
    assert reference["descriptions"](Told) == ("Summary: a key.", told)
    with pytest.raises(LookupError, match="Untold: its docstring says nothing of fourth"):
        list(reference["section"]("# Untold", Untold, "", {}))


def test_limits_that_no_record_knows_are_those_that_are_checked() -> None:
    _, film = reference["descriptions"](Film)
    _, phong = reference["descriptions"](Phong)
    _, mesh = reference["descriptions"](Mesh)
    assert f"up to {MAX_SIDE}" in film["width"] and f"up to 10^{math.log10(MAX_EXPONENT):g}" in phong["exponent"]
    assert re.findall(r"`(\w+)`", mesh["generate"]) == list(MESHES)
