"""`causticmpi compare` as users run it, on pictures of 16 x 16 pixels."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from mpi_tools import ROOT, python_environment, run_mpi
from program_tools import PATIENCE, compile_kernels

from causticmpi.cli.main import main

CONFIG = """\
title: Test & comparison
scenes:
  - config: {render}
    set: {{film.width: 16, film.height: 16, forecast.photons: 500, forecast.clusters: 8}}
    closeups: [[2, 2, 10, 10]]
    paper: cornell
variants:
  - {{label: pt, set: {{method: pt}}}}
  - {{label: cf, set: {{method: iws+cf}}}}
  - {{label: iws, set: {{method: iws}}, timing_only: true}}
budgets: [0.8s]
seeds: 2
reference:
  directory: {folder}/references
  estimate: {{set: {{method: iws+cf}}, budget: {{spp: 16}}, batches: 4}}
  check: {{set: {{method: pt}}, budget: {{spp: 32}}, batches: 4}}
output: {folder}/out
"""


def write_config(folder: Path, *changes: tuple[str, str]) -> Path:
    """CONFIG in `folder`, with every (old, new) text replaced."""
    text = CONFIG.format(render=ROOT / "configs" / "cornell.yaml", folder=folder)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "compare.yaml"
    path.write_text(text)
    return path


def finished(folder: Path) -> dict[str, int]:
    """Every finished run below `folder`, with the time its marker was written."""
    return {str(p.parent.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("finished.json")}


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished comparison; tests that change it take a copy."""
    compile_kernels()
    folder = tmp_path_factory.mktemp("compare")
    assert main(["compare", str(write_config(folder))]) == 0
    yield folder


def test_everything_is_written(compared: Path) -> None:
    out = compared / "out"
    runs = ["cf/0.8s-1", "cf/0.8s-2", "iws/0.8s-1", "pt/0.8s-1", "pt/0.8s-2"]
    assert sorted(finished(out)) == [f"runs/cornell/{run}" for run in runs]
    assert {p.name for p in out.iterdir()} == {
        "figures", "measurements.csv", "report.html", "runs", "tables", "tables.md",
    }  # fmt: skip
    for name in ("samples", "table-1", "errors-cornell-0.8s", "slopes-cornell"):
        assert (out / "tables" / f"{name}.csv").stat().st_size > 0
    facts = json.loads(next((compared / "references").glob("*/reference.json")).read_text())
    assert facts["estimate"]["samples_per_pixel"] == 64 and facts["check"]["samples_per_pixel"] == 128
    assert facts["agrees"] and facts["agreement"]["tests"] == 3
    assert "1442" not in (out / "tables.md").read_text() and "405 (4 min, Figure 4)" in (out / "tables.md").read_text()


def test_the_report_needs_no_network_and_no_other_file(compared: Path) -> None:
    page = (compared / "out" / "report.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', page)
    assert len(sources) > 3 and all(s.startswith(("data:image/", "#")) for s in sources)
    assert not re.search(r"https?://|<script|<link|url\(|@import", page)
    assert "Test &amp; comparison" in page


def test_a_finished_comparison_repeats_nothing(compared: Path) -> None:
    before = finished(compared / "out")
    assert main(["compare", str(compared / "compare.yaml")]) == 0
    assert finished(compared / "out") == before


def test_a_single_scene_writes_no_report(compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a job of an array does: the runs of its scene that are missing, and nothing else."""
    shutil.copytree(compared, tmp_path, dirs_exist_ok=True)
    config, out = str(write_config(tmp_path)), tmp_path / "out"
    (out / "report.html").unlink()
    (out / "runs" / "cornell" / "pt" / "0.8s-1" / "finished.json").unlink()
    assert main(["compare", config, "--scene", "2"]) == 2
    assert "found scene 2; allowed: 1 to 1" in capsys.readouterr().err
    assert main(["compare", config, "--scene", "1"]) == 0
    assert len(finished(out)) == 5 and not (out / "report.html").exists()


def test_changed_runs_are_repeated_and_the_others_kept(compared: Path, tmp_path: Path) -> None:
    shutil.copytree(compared, tmp_path, dirs_exist_ok=True)
    config = write_config(
        tmp_path, ("set: {method: iws+cf}}\n  - {label: iws", "set: {method: iws+cf, iws.paths: 4}}\n  - {label: iws")
    )
    before = finished(tmp_path / "out")
    assert main(["compare", str(config)]) == 0
    after = finished(tmp_path / "out")
    assert {run for run in before if before[run] != after[run]} == {f"runs/cornell/cf/0.8s-{seed}" for seed in (1, 2)}


def test_a_biased_method_is_called_so_everywhere(compared: Path, tmp_path: Path) -> None:
    shutil.copytree(compared, tmp_path, dirs_exist_ok=True)
    for report in (tmp_path / "out").rglob("cf/*/report.json"):
        report.write_text(report.read_text().replace('"biased": false', '"biased": true'))
    assert main(["compare", str(write_config(tmp_path))]) == 0
    out = tmp_path / "out"
    for text in (out / "tables.md", out / "tables" / "errors-cornell-0.8s.csv", out / "tables" / "samples.csv"):
        lines = [line for line in text.read_text().splitlines() if re.search(r"\bcf\b(?! \(biased\))", line)]
        assert "cf (biased)" in text.read_text()
        assert all("iws+cf" in line for line in lines), lines
    captions = re.findall(r"<figcaption>([^<]*)", (out / "report.html").read_text())
    assert len(captions) == 4 and all("cf (biased)" in caption for caption in captions)


def test_a_reference_of_another_scene_is_refused(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(compared / "references", tmp_path / "references")
    directory = next((tmp_path / "references").iterdir())
    ring = ROOT / "configs" / "ring.yaml"
    given = ("    paper: cornell", f"    reference: {directory}")
    config = write_config(tmp_path, (str(ROOT / "configs" / "cornell.yaml"), str(ring)), given)
    assert main(["compare", str(config)]) == 2
    assert "reference of another scene or camera" in capsys.readouterr().err
    config = write_config(tmp_path, ("film.width: 16,", "film.width: 24,"), given)
    assert main(["compare", str(config)]) == 2
    assert "reference of another film" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_stopped_in_the_middle_and_started_again(compared: Path, tmp_path: Path) -> None:
    """A signal in the second run: the first is kept, the second is made anew, none is missing at the end."""
    shutil.copytree(compared / "references", tmp_path / "references")
    config = write_config(tmp_path, ("0.8s", "2s"))
    command = [sys.executable, "-u", "-m", "causticmpi", "compare", str(config)]
    process = subprocess.Popen(command, env=python_environment(), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("run 2 of 5"):
            break
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    rest, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0 and "stopped by signal 15" in rest
    out = tmp_path / "out"
    first = finished(out)
    assert list(first) == ["runs/cornell/pt/2s-1"] and (out / "unfinished").exists()
    assert main(["compare", str(config)]) == 0
    assert len(finished(out)) == 5 and first.items() <= finished(out).items()
    assert (out / "report.html").exists() and not (out / "unfinished").exists()


@pytest.mark.mpi
def test_two_ranks_make_the_same_reference_check(compared: Path, tmp_path: Path) -> None:
    """Under mpirun the references alone: same samples, so the same reference as one rank made."""
    config = write_config(tmp_path)
    done = run_mpi(2, ["-m", "causticmpi", "compare", str(config), "--references"], timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    ours, theirs = (next((f / "references").glob("*/reference.json")).read_text() for f in (tmp_path, compared))
    assert json.loads(ours) == json.loads(theirs)
    assert not (tmp_path / "out" / "runs").exists()


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("seeds: 2", "seed: 2", 12, 'unknown key; did you mean "seeds"?'),
        ("budgets: [0.8s]", "budgets: [4 minutes]", 11, "allowed: a time in h, min and s"),
        ("method: pt}}\n  - {label: cf", "metod: pt}}\n  - {label: cf", 8, "metod"),
        ("label: cf", "label: pt", 9, 'found "pt" twice'),
        ("[[2, 2, 10, 10]]", "[[2, 2, 10, 17]]", 5, "within [0, 0, 16, 16]"),
        ("label: cf, set: {method: iws+cf", "label: cf, set: {method: iws+cf, seed: 3", 9, "any key but scene, seed,"),
        ("batches: 4}\n  check", "batches: 1}\n  check", 15, "an integer >= 4 (a t-test needs a variance)"),
        ("{method: pt}, budget: {spp: 32}", "{method: pt}, budget: {}", 16, "neither time nor spp"),
        ("paper: cornell", "paper: teapot", 6, "allowed: one of cornell, figurines, ring"),
        ("    paper", "    variants: [cv]\n    paper", 6, 'did you mean "cf"?'),
        ("    paper", "    budgets: []\n    paper", 6, "budgets: found []; allowed: a list"),
        ("    paper", "    budgets: [0s]\n    paper", 6, "scenes[0].budgets[0]: found"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_written(
    old: str, new: str, line: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path, (old, new))
    assert main(["compare", str(config)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error and f"compare.yaml:{line}:" in error, error
    assert [p.name for p in tmp_path.iterdir()] == ["compare.yaml"]
