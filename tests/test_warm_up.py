"""Warming up makes ready just what renders run."""

import time

import pytest
from numba import typeof
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
