"""What the stability laboratory writes: a small report holds it all, and verdicts go into a document."""

import re
from pathlib import Path

import pytest
from stability_tools import PAGES

from causticmpi.scene.load import load_scene
from causticmpi.stability.run import main

SMALL = """
title: '{title}'
question: '?'
kind: {kind}
room: {{template: box, set: {{light: 0.5}}}}
set: {{forecast.photons: 300, forecast.clusters: 4}}
side: 8
batch_passes: 16
batches: 8
runs: 8
passes: 64
samples: 1000
contenders:
  - {{label: pt, set: {{method: pt}}}}
  - {{label: mixture, set: {{method: iws+cf}}}}
"""
SWEEP = """
sweep: {parameter: scene.light, name: light, values: [0.5, 0]}
baseline: pt
claim: {of: mixture, fixed: [pt]}
truth: {rivals: [{label: rival, set: {method: pt}}]}
"""


def test_a_small_report(tmp_path: Path) -> None:
    """One page of each kind: a chart, a table and a verdict with figures; needs nothing beside itself."""
    files = []
    for kind in ("sweep", "coverage", "until", "long"):
        files.append(tmp_path / f"{kind}.yaml")
        files[-1].write_text(SMALL.format(title=kind, kind=kind) + (SWEEP if kind == "sweep" else ""))
    out = tmp_path / "out"
    docs = tmp_path / "docs.md"
    docs.write_text("above\n<!-- seeds: by scripts/stability --docs -->\nstale\n<!-- end of seeds -->\nbelow\n")
    assert main([*map(str, files), "--out", str(out), "-j", "1", "--seeds", "2", "--docs", str(docs)]) == 0
    html = (out / "report.html").read_text()
    assert html.count("data:image/png") == 4 and not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert "a light needs an area" in html  # the point light is refused, and the cell named
    for kind in ("sweep", "coverage", "until", "long"):
        assert (out / "tables" / f"{kind}.csv").stat().st_size > 0 and (out / "figures" / f"{kind}.png").exists()
    assert (
        "within a factor 1.25 of the true error" in html
        and "Error where runs end over the wanted one" in html
        and "Sum of 1,000 samples" in html
    )
    load_scene(out / "sweep" / "scenes" / "0.yaml")
    assert "Over 2 seeds mixture is at least 0.95 as efficient as pt" in html
    assert (out / "tables" / "sweep-seeds.csv").read_text().splitlines()[1].startswith("0.5,")
    written = docs.read_text()
    assert written.startswith("above\n") and written.endswith("\nbelow\n") and "stale" not in written
    assert (out / "verdicts.md").read_text() in written and "scripts/stability" in written
    rows = [line.split(" | ") for line in written.splitlines() if line.startswith("| `")]
    assert [row[0] for row in rows] == [
        "| `sweep`",
        *(f"| `{kind}`" for kind in ("sweep", "coverage", "until", "long")),
    ]
    assert rows[0][1] == "light 0.5" and {len(row) for row in rows[1:]} == {5}
    assert set(re.findall(r"<td>(\d+)</td></tr>", html)) and "What each page costs" in html


def test_a_document_without_a_place_for_verdicts_is_refused_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    docs = tmp_path / "docs.md"
    docs.write_text("no marks")
    assert main([str(PAGES[0]), "--out", str(tmp_path / "out"), "--docs", str(docs)]) == 2
    told = capsys.readouterr().err
    assert "found no line <!-- verdicts: by scripts/stability --docs -->" in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()
