"""Run the program as users do, on small pictures, and read what it leaves."""

import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from mpi_tools import ROOT, python_environment, run_mpi

from causticmpi.cli.main import main

CORNELL = ROOT / "configs" / "cornell.yaml"
SMALL = ("--set=film.width=64", "--set=film.height=48", "--set=forecast.photons=2000", "--set=forecast.clusters=32")
PATIENCE = 180
"""Seconds a run may take before the test fails: someone else may keep the cores busy."""


def words(out: Path, *more: str, config: Path = CORNELL) -> list[str]:
    """The command line of a small render into `out`."""
    return ["render", str(config), *SMALL, "--out", str(out), *more]


def render_here(out: Path, *more: str, config: Path = CORNELL) -> Path:
    """Render in this process, which must succeed. Budgets in seconds make no sense here: they count from its start."""
    assert main(words(out, *more, config=config)) == 0
    return out


def render_program(out: Path, *more: str, config: Path = CORNELL) -> "subprocess.CompletedProcess[str]":
    """Render by `python -m causticmpi`, without mpirun."""
    return run_program(*words(out, *more, config=config))


def render_mpi(ranks: int, out: Path, *more: str, config: Path = CORNELL) -> "subprocess.CompletedProcess[str]":
    """Render under mpirun, which must succeed."""
    done = run_mpi(ranks, ["-m", "causticmpi", *words(out, *more, config=config)], timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return done


def run_program(*args: str, start: Sequence[str] = ("-m", "causticmpi")) -> "subprocess.CompletedProcess[str]":
    """Run `python -m causticmpi args...` in a process of its own."""
    command = [sys.executable, *start, *args]
    return subprocess.run(
        command, env=python_environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE
    )


@functools.cache
def compile_kernels() -> None:
    """Have all kernels on disk, so that what follows takes the seconds it should."""
    with tempfile.TemporaryDirectory() as folder:
        for method in ("iws+cf", "pt"):
            render_here(Path(folder) / "here" / method, "--spp", "1", "--method", method)
            done = render_program(Path(folder) / "program" / method, "--spp", "1", "--method", method)
            assert done.returncode == 0, done.stderr


def read_layers(out: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All channels of image.exr by name, (H, W) float32, and its header."""
    with OpenEXR.File(str(out / "image.exr"), separate_channels=True) as file:
        return {name: channel.pixels.copy() for name, channel in file.channels().items()}, dict(file.header())


def read_report(out: Path) -> dict[str, Any]:
    """report.json."""
    return json.loads((out / "report.json").read_text())


def rgb(layers: dict[str, np.ndarray], prefix: str = "") -> np.ndarray:
    """(H, W, 3) float64 of one layer."""
    return np.stack([layers[prefix + axis] for axis in "RGB"], axis=-1).astype(np.float64)


def assert_same_layers(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    """Every channel bit for bit."""
    assert found.keys() == wanted.keys() and len(found) == 19
    different = [name for name in wanted if found[name].tobytes() != wanted[name].tobytes()]
    assert different == []


def tree(folder: Path) -> dict[str, bytes | None]:
    """All files under a folder with their content, directories with None."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
