"""The ring of ranks that hear each other, in one process and without waiting."""

import os
import signal
import time
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from mpi_tools import require_mpi, start_mpi
from program_tools import PATIENCE, compile_kernels, words

from causticmpi.distributed import watchdog
from causticmpi.distributed.watchdog import TRACING, WRITING, Watchdog


class Sent:
    def Test(self) -> bool:  # noqa: N802
        return True


class Ring:
    """Stands in for the communicator of one rank."""

    size = 3

    def __init__(self, rank: int, boxes: list[deque[int]]) -> None:
        self.rank, self.boxes = rank, boxes

    def Isend(self, word: np.ndarray, to: int, tag: int) -> Sent:  # noqa: N802
        assert to == (self.rank + 1) % 3
        self.boxes[to].append(int(word[0]))
        return Sent()

    def Iprobe(self, of: int, tag: int) -> bool:  # noqa: N802
        return bool(self.boxes[self.rank])

    def Recv(self, into: np.ndarray, of: int, tag: int) -> None:  # noqa: N802
        into[0] = self.boxes[self.rank].popleft()


@pytest.fixture
def ring(monkeypatch: pytest.MonkeyPatch) -> tuple[list[Watchdog], list[float]]:
    """Three ranks with a patience of 100 s, and the clock in a list."""
    now = [1000.0]
    monkeypatch.setenv("CAUSTICMPI_PATIENCE", "100")
    monkeypatch.setattr(watchdog.time, "monotonic", lambda: now[0])
    boxes: list[deque[int]] = [deque() for _ in range(3)]
    return [Watchdog(Ring(rank, boxes), ["a", "b", "c"]) for rank in range(3)], now


def live(ranks: list[Watchdog], now: list[float], seconds: int) -> list[bool]:
    """Let these ranks live for a while; each one's last word."""
    words = [True]
    for _ in range(seconds):
        now[0] += 1.01
        words = [rank.pulse() for rank in ranks]
        if not all(words):
            break
    return words


def test_silence_is_told_by_the_next_rank_and_in_the_end_given_up(
    ring: tuple[list[Watchdog], list[float]], capfd: pytest.CaptureFixture[str]
) -> None:
    ranks, now = ring
    assert all(live(ranks, now, 300)) and capfd.readouterr().err == ""
    assert all(live(ranks[:1] + ranks[2:], now, 60))
    assert capfd.readouterr().err == "causticmpi: rank 1 of 3 on b has been silent for 20 s\n"
    assert live(ranks[:1] + ranks[2:], now, 60) == [True, False]
    err = capfd.readouterr().err
    assert err.startswith("causticmpi: rank 1 of 3 on b has been silent for 101 s: ending all ranks; go on from the")


def test_a_rank_that_comes_back_blames_nobody(
    ring: tuple[list[Watchdog], list[float]], capfd: pytest.CaptureFixture[str]
) -> None:
    ranks, now = ring
    live(ranks[:1] + ranks[2:], now, 60)
    ranks[0].comm.boxes[1].clear()  # what came meanwhile shows only later
    assert all(live(ranks, now, 300))
    silent, again = capfd.readouterr().err.splitlines()
    assert silent == "causticmpi: rank 1 of 3 on b has been silent for 20 s"
    assert again.startswith("causticmpi: rank 1 of 3 on b is heard again after 6")


def test_who_writes_may_take_longer(
    ring: tuple[list[Watchdog], list[float]], capfd: pytest.CaptureFixture[str]
) -> None:
    ranks, now = ring
    assert ranks[0].pulse(WRITING)
    assert all(live(ranks[1:], now, 500))
    assert capfd.readouterr().err == "causticmpi: rank 0 of 3 on a has been writing for 20 s\n"
    ranks[0].pulse(TRACING)
    assert live(ranks[1:], now, 500)[0] is False
    ranks[0].pulse(WRITING)
    ranks[1].heard_at = now[0]
    assert live(ranks[1:], now, 700)[0] is False


@pytest.mark.mpi
def test_a_stopped_rank_ends_the_run(tmp_path: Path) -> None:
    require_mpi()
    compile_kernels()
    out = tmp_path / "out"
    endless = ("--spp", "10000000", "--set", "output.interval=0.2", "--method", "pt")
    process = start_mpi(2, ["-m", "causticmpi", *words(out, *endless)], {"CAUSTICMPI_PATIENCE": "10"})
    end = time.monotonic() + PATIENCE
    while not (out / "report.json").exists():
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    [stopped] = [int(entry.name) for entry in Path("/proc").glob("[0-9]*") if is_rank_1_below(entry, process.pid)]
    os.kill(stopped, signal.SIGSTOP)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode != 0 and err.count("ending all ranks; go on from the last checkpoint by --resume") == 1
    assert "causticmpi: rank 1 of 2 on " in err and "Traceback" not in err
    end = time.monotonic() + PATIENCE
    while Path(f"/proc/{stopped}").exists():  # a launcher's helper ends it
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.mpi
def test_a_rank_stopped_after_its_last_batch_ends_the_run() -> None:
    require_mpi()
    program = Path(__file__).parent / "mpi_programs" / "stopped_at_the_end.py"
    process = start_mpi(2, [str(program)], {"CAUSTICMPI_PATIENCE": "2"})
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode != 0 and "rank 1 of 2 on " in err and "ending all ranks" in err


def is_rank_1_below(entry: Path, launcher: int) -> bool:
    """Whether a process is the rank 1 that this launcher started."""
    try:
        if b"PMI_RANK=1" not in (entry / "environ").read_bytes().split(b"\0"):
            return False
        parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
        return int(Path(f"/proc/{parent}/stat").read_text().rpartition(")")[2].split()[1]) == launcher
    except OSError:
        return False
