"""Warming up makes ready just what renders run."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from numba import typeof
from program_tools import CORNELL
from rendering import REPOSITORY, prepare

from causticmpi.distributed import warmup
from causticmpi.distributed.warmup import compiling_is_told, tiny_scene
from causticmpi.scene.load import load_scene


def test_warm_up_compiles_what_renders_need() -> None:
    """The types of the tiny scene's arrays are those of a real one: else every kernel would be compiled twice, the
    second time out of the budget."""
    tiny = prepare(tiny_scene()).traced
    real = prepare(load_scene(REPOSITORY / "scenes" / "cornell.yaml")).traced
    assert [typeof(array) for array in tiny] == [typeof(array) for array in real]


RENDER_AFTER_PARTS = """
import sys
from causticmpi.cli.main import main
from causticmpi.config.load import load_config
from causticmpi.distributed.warmup import KERNELS, warm_up_parts
path, out, *settings = sys.argv[1:]
for part in warm_up_parts(load_config(path, settings), True):
    part()
known = {kernel: set(kernel.overloads) for kernel in KERNELS}
changed = [word for setting in settings for word in ("--set", setting)]
assert main(["render", path, "--out", out, *changed]) == 0
late = [kernel.py_func.__name__ for kernel in KERNELS if set(kernel.overloads) - known[kernel]]
used = sum(len(found) > 0 for found in known.values())
print(used, *late)
"""


@pytest.mark.parametrize("kind", ["method=iws+cf", "forecast.sampling=two", "method=iws+pm", "method=pt"])
def test_the_parts_make_ready_all_that_a_render_runs(kind: str, tmp_path: Path) -> None:
    """None of it is left to compile, or to load, when the clock runs. In a process of its own: others know kernels."""
    little = ["film.width=16", "film.height=16", "forecast.photons=200", "budget.time=null", "budget.spp=2", kind]
    command = [sys.executable, "-c", RENDER_AFTER_PARTS, str(CORNELL), str(tmp_path / "out"), *little]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    used, *late = done.stdout.splitlines()[-1].split()
    assert late == [] and int(used) >= (5 if kind == "method=pt" else 10)


@pytest.mark.parametrize(("anew", "patience", "lines"), [(1, 0.0, 1), (0, 0.0, 0), (1, 100.0, 0)])
def test_compiling_is_told_to_whoever_waits_for_it(
    anew: int, patience: float, lines: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warmup, "compiled_anew", lambda kernels: anew)
    monkeypatch.setattr(warmup, "PATIENT", patience)
    with compiling_is_told():
        time.sleep(0.5)
    err = capfd.readouterr().err
    assert err.count("\n") == err.count("compiling kernels") == lines
