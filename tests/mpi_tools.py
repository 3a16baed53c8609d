"""Start real MPI runs from tests."""

import functools
import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from causticmpi.distributed.launch import launcher_candidates, launcher_command, launcher_environment

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = Path(__file__).resolve().parent / "mpi_programs"


def require_mpi() -> None:
    """Skip the test if there is no MPI at all; a broken or unfitting one is a failure, not a reason to skip."""
    if importlib.util.find_spec("mpi4py") is None:
        pytest.skip("no MPI: mpi4py is not installed (pip install '.[mpi]' in the clone)")
    if not launcher_candidates():
        pytest.skip("no MPI: neither mpirun nor mpiexec found (pip install '.[mpi]' in the clone)")


@functools.cache
def launcher_words() -> tuple[str, ...]:
    """mpirun and its options for this machine, up to and without the number of ranks."""
    return tuple(launcher_command(1)[:-1])


def start_mpi(ranks: int, args: Sequence[str | Path], env: Mapping[str, str] | None = None) -> "subprocess.Popen[str]":
    """Start `mpirun -n ranks python args...` with pipes, in a session of its own; the caller waits for it."""
    require_mpi()
    command = [*launcher_words(), str(ranks), sys.executable, *map(str, args)]
    return subprocess.Popen(
        command,
        env=python_environment() | dict(env or {}),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run_mpi(
    ranks: int, args: Sequence[str | Path], timeout: float = 60, env: Mapping[str, str] | None = None
) -> "subprocess.CompletedProcess[str]":
    """Run `mpirun -n ranks python args...` to its end, for example `run_mpi(2, ["-m", "causticmpi", "render", ...])`.

    env is added to the environment. Fails the test, and ends the run, after `timeout` seconds.
    """
    process = start_mpi(ranks, args, env)
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # mpirun's own group; its helpers end the ranks when it is gone
        out, err = process.communicate()
        remove_shared_memory(out)
        pytest.fail(f"{ranks} ranks of {args} still running after {timeout} s\n{out[-2000:]}\n{err[-4000:]}")
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def python_environment() -> dict[str, str]:
    """Environment in which the ranks import causticmpi from this tree."""
    env = launcher_environment(os.environ)
    env["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), env.get("PYTHONPATH")]))
    return env


def shared_files(out: str) -> list[Path]:
    """Files of shared memory that a run named in its output, in lines "shm PATH"."""
    return [Path(line.removeprefix("shm ")) for line in out.splitlines() if line.startswith("shm /dev/shm/")]


def remove_shared_memory(out: str) -> None:
    """Remove what a run that ended badly left in /dev/shm: only the files it named itself."""
    for file in shared_files(out):
        file.unlink(missing_ok=True)
