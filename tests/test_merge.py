"""Runs of different seeds put together: the sums of all, refused where they do not belong together."""

from pathlib import Path

import numpy as np
import pytest
from program_tools import assert_same_layers, main, read_layers, read_report, render_here, rgb, tree, words

from causticmpi.distributed.checkpoint import find_state
from causticmpi.render import methods

TINY = ("--set", "film.width=20", "--set", "film.height=12", "--method", "pt")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Seeds 1, 2, 3 with 3, 5, 2 passes."""
    folder = tmp_path_factory.mktemp("runs")
    return [
        render_here(folder / str(seed), *TINY, "--seed", str(seed), "--spp", str(spp))
        for seed, spp in ((1, 3), (2, 5), (3, 2))
    ]


def merged(out: Path, *runs: Path) -> Path:
    assert main(["merge", *map(str, runs), "-o", str(out)]) == 0
    return out


def test_sums_and_counts_add_up(runs: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = merged(tmp_path / "out", *runs)
    assert f"{out}: 3 runs, 10 passes of 3 seeds, pt, estimated relMSE " in capfd.readouterr().out
    layers, header = read_layers(out)
    parts = [read_layers(run)[0] for run in runs]
    mean = sum(n * rgb(part) for n, part in zip((3, 5, 2), parts, strict=True)) / 10
    assert np.allclose(rgb(layers), mean, rtol=1e-6, atol=1e-7)
    sums = [find_state(run)[1]["sums"] for run in runs]
    state, arrays, _ = find_state(out)
    assert state is not None and (state.passes, state.seeds) == (10, (1, 2, 3))
    assert np.array_equal(arrays["sums"], sums[0] + sums[1] + sums[2])
    report = read_report(out)
    assert report["passes"] == header["passes"] == 10 and report["warnings"] == [] and header["mergedSeeds"] == "1 2 3"
    assert report["rays"]["total"] == sum(read_report(run)["rays"]["total"] for run in runs)
    assert 0 < report["estimated_relmse"] < min(read_report(run)["estimated_relmse"] for run in runs)


def test_neither_order_nor_grouping_shows(runs: list[Path], tmp_path: Path) -> None:
    wanted, _ = read_layers(merged(tmp_path / "all", *runs))
    pair = merged(tmp_path / "pair", runs[2], runs[0])
    assert_same_layers(read_layers(merged(tmp_path / "again", pair, runs[1]))[0], wanted)


def test_a_biased_method_is_labelled(
    runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("causticmpi.distributed.merge.BIASED", (*methods.BIASED, "pt"))
    out = merged(tmp_path / "out", *runs[:2])
    assert "pt (biased)" in capfd.readouterr().out
    assert read_report(out)["biased"] is True and read_layers(out)[1]["biased"] == "yes"


def test_what_does_not_belong_together(runs: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    smaller = ("--set", "film.height=8")
    other = render_here(tmp_path / "other", *TINY, *smaller, "--seed", "9", "--spp", "2")
    moved = render_here(
        tmp_path / "moved", *TINY, "--seed", "9", "--spp", "2", "--set", "camera={eye: [0, 0, 3], target: [0, 0, 0]}"
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    before = tree(tmp_path)
    for names, message in (
        ([runs[0], other], f"{other}: cannot be merged with {runs[0]}: it has film.height 8, here 12 there"),
        ([runs[0], moved], f"{moved}: cannot be merged with {runs[0]}: it has another scene (content "),
        ([runs[0], runs[1], runs[0]], f"{runs[0]}: has the seed 1, and so has {runs[0]}: the same samples twice"),
        ([runs[0], empty], f"{empty}: nothing to merge (it has no checkpoint)"),
        ([runs[0]], "merge: found one directory"),
    ):
        capfd.readouterr()
        assert main(["merge", *map(str, names), "-o", str(tmp_path / "out")]) == 2
        err = capfd.readouterr().err
        assert err.startswith(f"causticmpi: {message}") and err.count("\n") == 1, err
    assert tree(tmp_path) == before


def test_a_merge_is_not_resumed(runs: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = merged(tmp_path / "out", *runs)
    capfd.readouterr()
    assert main(words(out, *TINY, "--spp", "20", "--resume")) == 2
    assert "it holds a merge of the seeds 1, 2, 3" in capfd.readouterr().err
