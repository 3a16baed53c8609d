"""`--until` as users run it: stops by itself, gives up at its cap, same bits on two ranks and after a stop."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from program_tools import (
    assert_same_layers,
    read_layers,
    read_report,
    render_here,
    render_mpi,
    rgb,
    tree,
    words,
)

from causticmpi.cli.main import main
from causticmpi.config.load import load_config
from causticmpi.distributed import run as run_module
from causticmpi.distributed.checkpoint import find_state
from causticmpi.distributed.until import ended
from causticmpi.output.picture import estimated_relmse
from causticmpi.render.rounds import Batches

EASY = ("--method", "pt", "--set=film.width=16", "--set=film.height=16")
WANTED = ("--spp", "4096", "--until", "0.4%")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that reached its error without a stop."""
    return render_here(tmp_path_factory.mktemp("whole") / "out", *EASY, *WANTED)


def assert_same_run(found: Path, wanted: Path) -> None:
    """Pictures bit for bit, and all that the stopping decides."""
    assert_same_layers(read_layers(found)[0], read_layers(wanted)[0])
    new, old = read_report(found), read_report(wanted)
    assert new["rays"]["total"] == old["rays"]["total"]
    for name in ("passes", "until", "estimated_relmse"):
        assert new[name] == old[name], name
    (_, arrays, _), (_, others, _) = find_state(found), find_state(wanted)
    assert arrays.keys() == others.keys() and ended(arrays)
    assert all(np.array_equal(arrays[name], others[name]) for name in others)
    assert not (found / "unfinished").exists()


def test_stops_at_the_wanted_error(whole: Path) -> None:
    report = read_report(whole)
    assert report["until"] == {"relmse": 0.004, "reached": True}
    assert 16 <= report["passes"] < 4096
    assert report["relmse"]["estimate"] < 1.5 * 0.004
    assert 0 < report["relmse"]["low"] < report["relmse"]["estimate"] < report["relmse"]["high"] < np.inf
    layers, _ = read_layers(whole)
    again = estimated_relmse(rgb(layers), rgb(layers, "variance."))
    assert again == pytest.approx(report["estimated_relmse"], rel=1e-3)


def test_gives_up_at_its_cap_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = render_here(tmp_path / "out", *EASY, "--spp", "40", "--until", "0.0001")
    report = read_report(out)
    assert report["passes"] == 40 and report["until"]["reached"] is False
    assert "(wanted: 0.0001)" in capsys.readouterr().out
    plain = render_here(tmp_path / "plain", *EASY, "--spp", "40")
    assert np.array_equal(rgb(read_layers(out)[0]), rgb(read_layers(plain)[0]))


def test_going_on_after_any_pass(whole: Path, tmp_path: Path) -> None:
    """At a question, just before and after one, amid a half; then there is nothing to do."""
    out = tmp_path / "out"
    for spp in ("3", "15", "16", "17", "25", "40", "4096"):
        render_here(out, *EASY, *WANTED, "--spp", spp, "--resume")
        assert read_report(out)["until"]["reached"] == (spp == "4096")
    assert_same_run(out, whole)


def test_stopped_by_signals(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Amid a round, which is dropped, or at the end of one, which is merged: the question at its end is asked."""
    out, trace, rounds = tmp_path / "out", Batches.trace, [0]

    def traced(self, shares, pending, stop):
        rounds[0] += 1
        if rounds[0] % 7 == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        done = trace(self, shares, pending, stop)
        if rounds[0] % 4 == 0:
            os.kill(os.getpid(), signal.SIGTERM)
        return done

    monkeypatch.setattr(Batches, "trace", traced)
    monkeypatch.setattr(run_module, "equal_round", lambda *_: 2)
    stops = 0
    render_here(out, *EASY, *WANTED)
    while (out / "unfinished").exists():
        stops += 1
        render_here(out, *EASY, *WANTED, "--resume")
    assert stops > 5
    assert_same_run(out, whole)
    before = tree(out)
    capsys.readouterr()
    assert main(words(out, *EASY, *WANTED, "--resume")) == 0 and tree(out) == before
    assert "its halves reached the wanted error 0.004 " in capsys.readouterr().out
    (out / "image.png").unlink()  # lost after the last checkpoint
    render_here(out, *EASY, *WANTED, "--resume")
    assert_same_run(out, whole)


@pytest.mark.mpi
def test_going_on_with_other_ranks(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    render_mpi(2, out, *EASY, *WANTED, "--spp", "21")
    render_here(out, *EASY, *WANTED, "--spp", "30", "--resume")
    render_mpi(2, out, *EASY, *WANTED, "--resume")
    assert_same_run(out, whole)


@pytest.mark.parametrize(
    ("first", "then", "message"),
    [
        ((), ("--until", "1%"), "budget.until null, here 0.01"),
        (("--until", "1%"), (), "budget.until 0.01, here null"),
        (("--until", "1%"), ("--until", "0.5%"), "budget.until 0.01, here 0.005"),
    ],
)
def test_another_wanted_error_is_refused(
    first: tuple[str, ...], then: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Halves are not told apart in a plain run, and in another one ended by another error."""
    out = render_here(tmp_path / "out", *EASY, "--spp", "4", *first)
    before = tree(out)
    capsys.readouterr()
    assert main(words(out, *EASY, "--spp", "8", *then, "--resume")) == 2 and tree(out) == before
    err = capsys.readouterr().err
    assert f"its checkpoint has {message}: " in err and "--force" in err and err.count("\n") == 1


def test_not_merged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [str(render_here(tmp_path / seed, *EASY, "--spp", "4", "--until", "1%", "--seed", seed)) for seed in "12"]
    assert main(["merge", *runs, "-o", str(tmp_path / "out")]) == 2
    assert f"{runs[0]}: was to stop at the error 0.01: " in capsys.readouterr().err


@pytest.mark.mpi
def test_two_ranks_stop_where_one_does(whole: Path, tmp_path: Path) -> None:
    """Halves and questions hang on the number of passes alone."""
    render_mpi(2, tmp_path / "two", *EASY, *WANTED)
    assert_same_run(tmp_path / "two", whole)


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
