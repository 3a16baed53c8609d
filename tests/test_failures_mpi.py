"""Ranks that fail, disks that are full, and signals: the run ends soon, says why, and leaves whole pictures."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mpi_tools import PROGRAMS, launcher_words, python_environment, require_mpi, run_mpi, start_mpi
from program_tools import PATIENCE, compile_kernels, main, read_layers, read_report, words

from causticmpi.distributed.launch import launcher_family

END = 60
"""Seconds within which a broken or stopped run has to be gone: it would go on for ever, and others may keep the cores
busy."""
ENDLESS = ("--spp", "10000000", "--set", "output.interval=0.2")


@pytest.fixture(autouse=True)
def warm() -> None:
    require_mpi()
    compile_kernels()


def troubled(what: str, rank: int, folder: Path, *more: str) -> list[str]:
    """Arguments of python for mpi_programs/troubled_render.py rendering into folder/out."""
    return [str(PROGRAMS / "troubled_render.py"), what, str(rank), str(folder), *words(folder / "out", *more)]


def assert_whole(out: Path) -> None:
    """The picture can be read, and is the one the report tells of; nothing half-written lies about."""
    layers, header = read_layers(out)
    depth = layers.pop("depth.Z")  # infinite where the eye sees nothing
    assert all(np.isfinite(channel).all() for channel in layers.values()) and layers["R"].max() > 0 and depth.min() > 0
    assert header["passes"] == read_report(out)["passes"] >= 1
    extra = {"unfinished", "checkpoint", "checkpoint.previous"}
    assert sorted(set(os.listdir(out)) - extra) == ["image.exr", "image.png", "report.json"]


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("what", "rank", "message"),
    [
        ("raise", 1, "rank 1 of 3 on {host} failed: ValueError: boom in the sampler; ending all ranks"),
        ("raise", -1, "rank "),  # the lowest of those that fail at the same moment, which a busy machine may draw out
        ("kill", 1, ""),
    ],
)
def test_a_failing_rank_ends_the_run(what: str, rank: int, message: str, tmp_path: Path) -> None:
    done = run_mpi(3, troubled(what, rank, tmp_path, *ENDLESS), timeout=PATIENCE)
    assert time.time() - (tmp_path / "trouble").stat().st_mtime < END
    assert done.returncode != 0
    assert_whole(tmp_path / "out")
    if message:
        host = read_report(tmp_path / "out")["provenance"]["hosts"][0]
        assert done.returncode == 1 and done.stderr.count("ending all ranks") == 1, done.stderr
        assert f"causticmpi: {message.format(host=host)}" in done.stderr
        assert done.stderr.count("Traceback") == 1, done.stderr
    else:
        launcher_says = (done.stdout + done.stderr).lower()
        assert "signal: 9" in launcher_says or "killed (signal 9)" in launcher_says or "signal 9" in launcher_says


def wait_for(path: Path, process: "subprocess.Popen[str]") -> None:
    """Wait until a file appears that the run is to write."""
    end = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < end and process.poll() is None, f"no {path}"
        time.sleep(0.02)


def finish(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """What a stopped run printed; fails unless it is gone in time, with code 0."""
    try:
        out, err = process.communicate(timeout=END)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, err
    return out, err


@pytest.mark.mpi
def test_a_full_disk_ends_nothing_but_the_last_picture_counts(tmp_path: Path) -> None:
    """Told once while the run goes on; when the last picture cannot be written either, one line and code 1."""
    require_patient_launcher()
    out = tmp_path / "out"
    process = start_mpi(2, troubled("disk-full", 0, tmp_path, *ENDLESS))
    wait_for(tmp_path / "trouble", process)
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    told, err = process.communicate(timeout=END)
    assert process.returncode == 1, err
    line = f"causticmpi: {out}: could not write the picture (no space left on device); what was whole before is kept"
    assert err.count("cannot be written") == 1 and err.count(line) == 1 and "Traceback" not in err, err
    assert_whole(out)
    assert (out / "checkpoint").exists() and (out / "unfinished").exists()


def require_patient_launcher() -> None:
    if launcher_family(Path(launcher_words()[0])) == "openmpi":
        pytest.skip("Open MPI's mpirun ends the ranks by itself after a signal")


@pytest.mark.mpi
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_saves_the_picture(number: signal.Signals, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    require_patient_launcher()
    out = tmp_path / "out"
    process = start_mpi(2, ["-m", "causticmpi", *words(out, *ENDLESS)])
    wait_for(out / "report.json", process)
    time.sleep(0.3)
    process.send_signal(number)
    told, err = finish(process)
    assert_whole(out)
    passes = read_report(out)["passes"]
    assert (out / "unfinished").read_text() == f"stopped by signal {int(number)} after {passes} passes\n"
    assert f"{out}: {passes} passes in " in told and f"stopped by signal {int(number)}" in told, told
    assert "Traceback" not in err
    # The next run into this directory is refused, and a finished one with --force takes the marker away.
    assert main(words(out, "--spp", "1")) == 2
    assert "it holds a run already" in capfd.readouterr().err
    assert main(words(out, "--spp", "1", "--force")) == 0
    assert not (out / "unfinished").exists() and read_report(out)["passes"] == 1


@pytest.mark.mpi
def test_a_signal_through_the_ranks_option(tmp_path: Path) -> None:
    require_patient_launcher()
    out = tmp_path / "out"
    command = [sys.executable, "-m", "causticmpi", *words(out, *ENDLESS, "-j", "2")]
    process = subprocess.Popen(
        command, env=python_environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_for(out / "report.json", process)
    process.terminate()
    finish(process)
    assert_whole(out)
    assert (out / "unfinished").exists()


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_signal_before_the_first_round_is_finished(ranks: int, tmp_path: Path) -> None:
    require_patient_launcher()
    process = start_mpi(ranks, troubled("crawl", -1, tmp_path, *ENDLESS))
    wait_for(tmp_path / "trouble", process)
    process.send_signal(signal.SIGTERM)
    told, err = finish(process)
    assert os.listdir(tmp_path / "out") == ["unfinished"]
    assert (tmp_path / "out" / "unfinished").read_text() == "stopped by signal 15 after 0 passes\n"
    assert f"{tmp_path / 'out'}: 0 passes in " in told and told.endswith("stopped by signal 15: no picture\n"), told
    assert "Traceback" not in err


@pytest.mark.mpi
def test_a_signal_to_one_rank_stops_all(tmp_path: Path) -> None:
    """A batch system may reach some ranks before others: they agree, and none is left waiting."""
    out = tmp_path / "out"
    process = start_mpi(3, troubled("signal", 1, tmp_path, *ENDLESS))
    wait_for(tmp_path / "trouble", process)
    finish(process)
    assert_whole(out)
    assert (out / "unfinished").read_text().startswith(f"stopped by signal {int(signal.SIGUSR1)} after ")
