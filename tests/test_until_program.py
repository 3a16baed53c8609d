"""`--until` as users run it: stops by itself, gives up at its cap, same bits on two ranks, never resumed."""

from pathlib import Path

import numpy as np
import pytest
from program_tools import compile_kernels, read_layers, read_report, render_here, render_mpi, rgb, tree, words

from causticmpi.cli.main import main
from causticmpi.config.load import load_config
from causticmpi.output.picture import estimated_relmse

EASY = ("--method", "pt", "--set=film.width=16", "--set=film.height=16")


def test_stops_at_the_wanted_error(tmp_path: Path) -> None:
    out = render_here(tmp_path / "out", *EASY, "--spp", "4096", "--until", "0.4%")
    report = read_report(out)
    assert report["until"] == {"relmse": 0.004, "reached": True}
    assert 16 <= report["passes"] < 4096
    assert report["relmse"]["estimate"] < 1.5 * 0.004
    assert 0 < report["relmse"]["low"] < report["relmse"]["estimate"] < report["relmse"]["high"] < np.inf
    layers, _ = read_layers(out)
    again = estimated_relmse(rgb(layers), rgb(layers, "variance."))
    assert again == pytest.approx(report["estimated_relmse"], rel=1e-3)


def test_gives_up_at_its_cap_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = render_here(tmp_path / "out", *EASY, "--spp", "40", "--until", "0.0001")
    report = read_report(out)
    assert report["passes"] == 40 and report["until"]["reached"] is False
    assert "(wanted: 0.0001)" in capsys.readouterr().out
    plain = render_here(tmp_path / "plain", *EASY, "--spp", "40")
    assert np.array_equal(rgb(read_layers(out)[0]), rgb(read_layers(plain)[0]))


def test_a_run_until_an_error_is_not_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = render_here(tmp_path / "out", *EASY, "--spp", "4")
    command = words(out, *EASY, "--spp", "8", "--until", "1%", "--resume")
    assert main(command) == 2
    assert "cannot be resumed" in capsys.readouterr().err
    for state in out.glob("checkpoint*"):  # as such a run leaves none; its picture stays
        state.unlink()
    before = tree(out)
    assert main(command) == 2 and tree(out) == before
    assert "cannot be resumed" in capsys.readouterr().err


@pytest.mark.mpi
def test_two_ranks_stop_where_one_does(tmp_path: Path) -> None:
    """Halves and questions hang on the number of passes alone."""
    compile_kernels()
    more = (*EASY, "--spp", "4096", "--until", "0.4%")
    render_mpi(2, tmp_path / "two", *more)
    render_here(tmp_path / "one", *more)
    one, two = (read_layers(tmp_path / name)[0] for name in ("one", "two"))
    assert np.array_equal(rgb(one), rgb(two))


@pytest.mark.parametrize("text", ["0", "-1%", "soon", "1 percent", "nan"])
def test_bad_errors_are_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(tmp_path / "out", "--spp", "8", f"--until={text}")) == 2
    assert "write for example 1%" in capsys.readouterr().err


def test_needs_a_cap(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").touch()
    path = tmp_path / "config.yaml"
    path.write_text("scene: a.yaml\nbudget: {until: 1%, time: 4min}\n")
    assert load_config(path).budget.until == 0.01
    path.write_text("scene: a.yaml\nbudget: {until: 1%}\n")
    with pytest.raises(Exception, match="neither time nor spp"):
        load_config(path)
