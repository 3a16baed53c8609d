"""Progress on a terminal, in a log, and where no one listens any more."""

import io
import subprocess
import sys
from pathlib import Path

import pytest

from causticmpi.output.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def environment(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return monkeypatch


def test_progress_on_a_terminal(environment):
    stream = Terminal()
    with Progress(None, 64, stream) as progress:
        progress.stage("tracing")
        progress.update(elapsed=10.0, passes=8, spp=16, rays_per_second=3.25e6, estimated_relmse=0.0125)
    text = stream.getvalue()
    assert "25%" in text and "0:30 left, 16/64 spp, 3.25 Mrays/s, relMSE 0.0125" in text
    assert text.index("\x1b[?25l") < text.rindex("\x1b[?25h")  # the cursor is given back
    progress.close()
    assert stream.getvalue() == text


def test_progress_lines_come_at_widening_intervals(environment):
    stream = io.StringIO()
    progress = Progress(300.0, None, stream)
    progress.stage("photons")
    for second in range(1, 241):
        progress.stage("photons" if second % 2 else "tracing")
        progress.update(float(second), second, 2 * second, 1.5e3, None if second < 2 else 0.5)
    progress.close()
    lines = stream.getvalue().splitlines()
    assert lines[:2] == ["causticmpi: photons", "causticmpi: tracing"]
    times = [line.split(": ", 2)[2].split(" of ")[0] for line in lines[2:]]
    assert times == ["0:10", "0:20", "0:30", "0:40", "0:50", "1:00", "2:00", "3:00", "4:00"]
    assert lines[2] == (
        "causticmpi: tracing: 0:10 of 5:00, 4:50 left, 20 spp, 10 passes, 1.5 krays/s, estimated relMSE 0.5"
    )
    assert "\x1b" not in stream.getvalue()


def test_progress_tells_the_end_of_a_short_run(environment):
    stream = io.StringIO()
    progress = Progress(None, 8, stream)
    progress.update(0.5, 1, 1, 0.0, None)
    assert stream.getvalue() == ""
    progress.update(3.0, 4, 4, 2e9, None)
    progress.close()
    progress.close()
    wanted = "starting: 0:03, 0:03 left, 4 of 8 spp, 4 passes, 2 Grays/s, estimated relMSE unknown"
    assert stream.getvalue() == f"causticmpi: {wanted}\n"


@pytest.mark.parametrize(("seconds", "spp", "left"), [(None, None, "time left unknown"), (10.0, 64, "0:06 left")])
def test_progress_time_left_is_the_first_budget_to_end(environment, seconds, spp, left):
    stream = io.StringIO()
    progress = Progress(seconds, spp, stream)
    progress.update(4.0, 1, 1, 0.0, None)
    progress.close()
    assert f", {left}, " in stream.getvalue()


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_survives_a_broken_stream(environment, terminal):
    calls = []

    def broken(text):
        calls.append(text)
        raise BrokenPipeError

    stream = io.StringIO() if not terminal else Terminal()
    progress = Progress(None, 2, stream)
    environment.setattr(stream, "write", broken)
    for second in (20.0, 40.0):
        progress.update(second, 1, 1, 0.0, None)
    progress.stage("tracing")
    progress.close()
    assert calls


def test_progress_without_standard_error(environment):
    environment.setattr(sys, "stderr", None)
    progress = Progress(None, 2)
    progress.update(20.0, 1, 1, 0.0, None)
    progress.close()


def test_rich_is_imported_only_for_a_terminal():
    code = (
        "import io, os, sys; from causticmpi.output.progress import Progress; os.environ['TERM'] = 'xterm';"
        "p = Progress(1.0, 1, io.StringIO()); p.update(20, 1, 1, 0, None); p.close(); plain = 'rich' in sys.modules;"
        "t = io.StringIO(); t.isatty = lambda: True; Progress(1.0, 1, t).close(); print(plain, 'rich' in sys.modules)"
    )
    root = Path(__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
