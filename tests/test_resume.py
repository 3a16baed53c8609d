"""A run stopped and gone on with is the run that was never stopped: same bits, or a line that says why not."""

import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mpi_tools import require_mpi
from program_tools import assert_same_layers, main, read_layers, read_report, render_here, render_mpi, tree, words

from causticmpi.distributed import run as run_module
from causticmpi.distributed.checkpoint import find_state
from causticmpi.distributed.keeper import Keeper
from causticmpi.output import checkpoint as files
from causticmpi.output.checkpoint import CHECKPOINT, PREVIOUS, Checkpoint, DamagedError, read_checkpoint
from causticmpi.render.rounds import Batches

TINY = ("--set", "film.width=20", "--set", "film.height=12")


@pytest.fixture(scope="module", params=["iws+cf", "pt"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Method, and eleven passes without a stop."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return request.param, render_here(out, *TINY, "--spp", "11", "--method", request.param)


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two checkpoints: of six passes, and before that of three."""
    out = render_here(tmp_path_factory.mktemp("half") / "out", *TINY, "--spp", "3", "--method", "pt")
    return render_here(out, *TINY, "--spp", "6", "--method", "pt", "--resume")


@pytest.fixture
def begun(half: Path, tmp_path: Path) -> Path:
    """A copy of `half` to do things to."""
    return Path(shutil.copytree(half, tmp_path / "begun"))


def resume(out: Path, *more: str) -> int:
    return main(words(out, *TINY, "--method", "pt", "--resume", *more))


def assert_same_run(found: Path, wanted: Path) -> None:
    """Pictures bit for bit, and what the report counts."""
    assert_same_layers(read_layers(found)[0], read_layers(wanted)[0])
    new, old = read_report(found), read_report(wanted)
    for name in ("passes", "spp", "nonfinite_samples", "estimated_relmse", "forecast"):
        assert new[name] == old[name], name
    assert not (found / "unfinished").exists()


def test_a_finished_run_is_extended(whole: tuple[str, Path], tmp_path: Path) -> None:
    method, wanted = whole
    out = tmp_path / "out"
    for spp in ("1", "4", "11"):
        render_here(out, *TINY, "--spp", spp, "--method", method, "--resume")
    assert_same_run(out, wanted)
    assert read_report(out)["rays"]["total"] == read_report(wanted)["rays"]["total"]


@pytest.mark.mpi
def test_on_another_number_of_ranks(whole: tuple[str, Path], tmp_path: Path) -> None:
    require_mpi()
    method, wanted = whole
    render_mpi(3, tmp_path / "out", *TINY, "--spp", "5", "--method", method)
    render_mpi(2, tmp_path / "out", *TINY, "--spp", "11", "--method", method, "--resume")
    assert_same_run(tmp_path / "out", wanted)


@pytest.fixture
def stop_after(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Put numbers in: this run is sent SIGTERM in the middle of its n-th round."""
    stops: list[int] = []
    trace, left = Batches.trace, []

    def traced(self, shares, pending, stop):
        left[:] = left or stops
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGTERM)
        return trace(self, shares, pending, stop)

    monkeypatch.setattr(Batches, "trace", traced)
    monkeypatch.setattr(run_module, "equal_round", lambda *_: 2)
    yield stops


def test_stopped_by_a_signal(whole: tuple[str, Path], tmp_path: Path, stop_after: list[int]) -> None:
    """The unfinished round is dropped, and traced anew by the next start."""
    method, wanted = whole
    out, arguments = tmp_path / "out", (*TINY, "--spp", "11", "--method", method)
    stop_after.append(3)
    assert main(words(out, *arguments)) == 0
    assert (out / "unfinished").read_text() == "stopped by signal 15 after 4 passes\n"
    assert read_report(out)["passes"] == 4
    stop_after[0] = 100
    render_here(out, *arguments, "--resume")
    assert_same_run(out, wanted)


def test_lost_between_checkpoints(
    whole: tuple[str, Path], tmp_path: Path, stop_after: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after SIGKILL: the picture may be newer than the checkpoint, and the last one half written."""
    method, wanted = whole
    out = tmp_path / "out"
    arguments = (*TINY, "--spp", "11", "--method", method, "--set", "output.interval=0.000001")
    monkeypatch.setattr(Keeper, "picture_due", lambda *_: True)
    monkeypatch.setattr(Keeper, "save_due", lambda self, elapsed, spent: (out / "report.json").exists())
    monkeypatch.setattr(files, "_write", failing_on(files._write, {3}))
    monkeypatch.setattr(Keeper, "keep", lambda self, what, write, last: write() is None)
    stop_after.append(100)
    with pytest.raises(KeyboardInterrupt):
        main(words(out, *arguments))
    assert read_report(out)["passes"] == 6
    monkeypatch.undo()
    (out / ".causticmpi-checkpoint-0123.tmp").write_bytes(b"causticmpi checkpoint\nhalf")
    state, _, _ = find_state(out)
    assert state is not None and state.passes == 6 and not state.complete
    render_here(out, *arguments, "--resume")
    assert_same_run(out, wanted)
    assert not list(out.glob(".*"))


def failing_on(write, calls: set[int]):
    count = [0]

    def failing(*arguments):
        count[0] += 1
        if count[0] in calls:
            raise KeyboardInterrupt
        return write(*arguments)

    return failing


def test_nothing_to_do(begun: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (begun / "unfinished").touch()
    before = tree(begun)
    for spp in ("6", "2"):
        assert resume(begun, "--spp", spp) == 0
        told = capfd.readouterr()
        assert told.out.startswith(f"{begun}: holds 6 passes in ") and "larger --time or --spp" in told.out
        assert told.err == ""
    assert tree(begun) == {name: content for name, content in before.items() if name != "unfinished"}


def test_a_time_budget_that_is_spent(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = render_here(tmp_path / "out", *TINY, "--time", "0.01s", "--method", "pt")
    assert ", over its budget of 0.01 s: preparing took " in capfd.readouterr().out
    passes, before = read_report(out)["passes"], tree(out)
    assert resume(out, "--time", "0.01s") == 0 and tree(out) == before
    assert f"holds {passes} pass" in capfd.readouterr().out
    (out / "image.png").unlink()  # a run that lost its picture after its last checkpoint
    assert resume(out, "--time", "0.01s") == 0
    assert read_report(out)["passes"] == passes and (out / "image.png").exists()
    assert read_report(out)["seconds"]["tracing"] > 0


def test_without_a_checkpoint_it_starts_afresh(
    whole: tuple[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    method, wanted = whole
    out = tmp_path / "out"
    render_here(out, *TINY, "--spp", "2", "--method", method, "--set", "output.checkpoint=0")
    assert not (out / CHECKPOINT).exists()
    capfd.readouterr()
    render_here(out, *TINY, "--spp", "11", "--method", method, "--resume")
    assert f"{out}: no checkpoint, starting afresh\n" in capfd.readouterr().err
    assert_same_run(out, wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--seed", "5"], "seed 1, here 5"),
        (["--method", "pt-brute"], 'method "pt", here "pt-brute"'),
        (["--set", "film.width=24"], "film.width 20, here 24"),
        (["--set", "film.crop=[0, 0, 8, 8]"], "film.crop null, here [0, 0, 8, 8]"),
        (["--set", "watertight=true"], "watertight false, here true"),
        (["--set", "camera={eye: [0, 0, 3.8], target: [0, 0, 0]}"], "another scene (content "),
    ],
)
def test_another_run_is_refused(
    begun: Path, change: list[str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    before = tree(begun)
    assert resume(begun, "--spp", "9", *change) == 2
    err = capfd.readouterr().err
    assert err.startswith(f"causticmpi: {begun}: its checkpoint has {message}") and err.count("\n") == 1, err
    assert "--force" in err and tree(begun) == before


def test_another_version_is_refused(
    begun: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tree(begun)
    monkeypatch.setattr("causticmpi.distributed.checkpoint.__version__", "9.0")
    assert resume(begun, "--spp", "9") == 2
    err = capfd.readouterr().err
    assert "its checkpoint is of version 0.1.0 (" in err and "this is 9.0 (" in err and err.count("\n") == 1
    assert tree(begun) == before


def test_what_no_sample_depends_on_may_change(begun: Path, half: Path, tmp_path: Path) -> None:
    moved = begun.rename(tmp_path / "elsewhere")
    assert resume(moved, "--spp", "7", "--set", "output.interval=3") == 0
    assert read_report(moved)["passes"] == 7


@pytest.mark.parametrize("damage", ["truncated", "empty", "flipped"])
def test_a_damaged_checkpoint_gives_way_to_the_previous_one(
    begun: Path, damage: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    content = bytearray((begun / CHECKPOINT).read_bytes())
    content[len(content) // 2] ^= 1
    (begun / CHECKPOINT).write_bytes({"truncated": content[:-100], "empty": b""}.get(damage, content))
    assert resume(begun, "--spp", "9") == 0
    err = capfd.readouterr().err
    assert err.count(f"causticmpi: warning: {begun / CHECKPOINT}: ") == 1
    assert f"{begun}: going on from the 3 passes of its checkpoint\n" in err
    wanted = render_here(tmp_path / "wanted", *TINY, "--spp", "9", "--method", "pt")
    assert_same_run(begun, wanted)


def test_two_damaged_checkpoints(begun: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name in (CHECKPOINT, PREVIOUS):
        (begun / name).write_bytes(b"nothing")
    assert resume(begun, "--spp", "4") == 0
    err = capfd.readouterr().err
    assert err.count("its checksum does not fit") == 2 and "no usable checkpoint, starting afresh" in err
    assert_same_run(begun, render_here(tmp_path / "wanted", *TINY, "--spp", "4", "--method", "pt"))


def test_force_leaves_no_old_checkpoint(begun: Path) -> None:
    render_here(begun, *TINY, "--spp", "1", "--method", "pt", "--force")
    assert not (begun / PREVIOUS).exists()
    state, _, _ = find_state(begun)
    assert state is not None and state.passes == 1


def test_resume_and_force_exclude_each_other(begun: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert resume(begun, "--force") == 2
    assert "not allowed with" in capfd.readouterr().err


# The file


def test_a_checkpoint_file_holds_what_was_put_in(tmp_path: Path) -> None:
    arrays = {"sums": np.arange(12.0).reshape(4, 3), "more": np.zeros((0, 2), np.int32)}
    files.save_checkpoint(tmp_path, Checkpoint({"passes": 3, "text": "ü"}, arrays), keep_previous=True)
    assert os.listdir(tmp_path) == [CHECKPOINT]
    found = read_checkpoint(tmp_path / CHECKPOINT)
    assert found.facts == {"passes": 3, "text": "ü"}
    for name, array in arrays.items():
        assert found.arrays[name].dtype == array.dtype and np.array_equal(found.arrays[name], array)


def test_every_flipped_bit_and_every_cut_shows(tmp_path: Path) -> None:
    files.save_checkpoint(tmp_path, Checkpoint({"passes": 3}, {"sums": np.ones(2)}), keep_previous=False)
    content = (tmp_path / CHECKPOINT).read_bytes()
    damaged = tmp_path / "damaged"
    for at in range(len(content)):
        flipped = bytearray(content)
        flipped[at] ^= 1 << at % 8
        for wrong in (bytes(flipped), content[:at], content[:at] + content[at + 1 :], content + content[:at]):
            if wrong != content:
                damaged.write_bytes(wrong)
                with pytest.raises(DamagedError, match="truncated or altered"):
                    read_checkpoint(damaged)


def test_the_previous_one_is_whole_while_the_next_is_put_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed at any of the steps that touch the directory, the newest whole checkpoint is there."""
    for passes in (1, 2):
        files.save_checkpoint(tmp_path, Checkpoint({"passes": passes}, {}), keep_previous=True)
    replace, steps, stop_at = os.replace, [], [0]

    def stopping(source, target):
        steps.append(Path(target).name)
        if len(steps) == stop_at[0]:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", stopping)
    for stop_at[0] in (1, 2):
        steps.clear()
        with pytest.raises(KeyboardInterrupt):
            files.save_checkpoint(tmp_path, Checkpoint({"passes": 3}, {}), keep_previous=True)
        found, notes = files.find_checkpoint(tmp_path)
        assert found is not None and found.facts["passes"] == 2 and notes == []
    assert steps == [PREVIOUS, CHECKPOINT]


def test_the_state_has_no_value_that_json_has_not(begun: Path) -> None:
    state, arrays, _ = find_state(begun)
    assert state is not None and arrays["sums"].dtype == np.float64
    plain = msgspec.to_builtins(state)
    assert json.loads(json.dumps(plain)) == json.loads(msgspec.json.encode(state))
