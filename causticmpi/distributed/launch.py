"""`-j N`: start the ranks with the mpirun that belongs to the installed MPI."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

from causticmpi.distributed.environment import started_by_launcher
from causticmpi.errors import InputError

FORWARDED = {
    signal.SIGINT: signal.SIGINT,
    signal.SIGTERM: signal.SIGTERM,
    signal.SIGUSR1: signal.SIGUSR1,
    signal.SIGHUP: signal.SIGTERM,  # the ranks are in a session of their own and would outlive the terminal
}

MEND = "pip install '.[mpi]' in the clone"


def launch_ranks(count: int, argv: Sequence[str], program: Sequence[str] = ("-m", "causticmpi")) -> int | None:
    """Run `program` with `argv` (its -j option removed) as `count` ranks; return mpirun's exit code.

    None, with nothing started, for a count of 1: the caller goes on by itself. SIGINT, SIGTERM, SIGUSR1 are passed on.
    Raises InputError for a count below 1, inside a launcher's process, and without a usable MPI.
    """
    if count < 1:
        raise InputError(f"-j: found {count}, need at least 1")
    if count == 1:
        return None
    if started_by_launcher():
        raise InputError(
            f"-j {count}: a launcher (mpirun, srun) started this process already: drop -j, or the launcher"
        )
    command = [*launcher_command(count), sys.executable, *program, *without_ranks_option(argv)]
    return run_forwarding_signals(command, launcher_environment(os.environ))


def without_ranks_option(argv: Sequence[str]) -> list[str]:
    """`argv` without "-j N", "-jN" and "-j=N"."""
    kept: list[str] = []
    words = iter(argv)
    for word in words:
        if word == "-j":
            next(words, None)
        elif not (word.startswith("-j") and word[2:].lstrip("=").isdigit()):
            kept.append(word)
    return kept


def launcher_command(count: int) -> list[str]:
    """The start of the command line: mpirun that fits the installed MPI, with its options for `count` ranks here.

    Raises InputError if there is no MPI library, no mpirun, or none that fits.
    """
    library = mpi_family(installed_library())
    found = {path: launcher_family(path) for path in launcher_candidates()}
    if not found:
        raise InputError(f"-j needs mpirun, found none next to {sys.executable} or on PATH: {MEND}")
    fitting = [path for path, family in found.items() if family in (library, "unknown")]
    if not fitting:
        raise InputError(
            f"-j: {', '.join(map(str, found))} cannot start ranks of the installed {library} library: {MEND}"
        )
    options = ["--oversubscribe", "--bind-to", "none"] if library == "openmpi" else []
    return [str(fitting[0]), *options, "-n", str(count)]


def launcher_environment(env: Mapping[str, str]) -> dict[str, str]:
    """Environment of the ranks: one thread each; Open MPI may run as root and on few cores.

    SLURM's variables are dropped: -j means this machine, and mpirun would ask SLURM to start the ranks.
    """
    kept = {name: value for name, value in env.items() if not name.startswith("SLURM_")}
    root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return kept | root | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def launcher_candidates() -> list[Path]:
    """Existing mpirun and mpiexec: of MPI4PY_LIBMPI's installation, next to the interpreter, on PATH; best first."""
    folders = [Path(sys.executable).parent]
    chosen = os.environ.get("MPI4PY_LIBMPI")
    if chosen:
        folders.insert(0, Path(chosen).parent.parent / "bin")
    names = ("mpirun", "mpiexec")
    paths = [shutil.which(name, path=str(folder)) for folder in folders for name in names]
    paths += [shutil.which(name) for name in names]
    return [Path(path) for path in dict.fromkeys(paths) if path is not None]


def installed_library() -> str:
    """Version text of the MPI library that mpi4py loads, asked in a process of its own. Raises InputError if none."""
    question = "import mpi4py; mpi4py.rc.initialize = False; from mpi4py import MPI; print(MPI.Get_library_version())"
    answer = subprocess.run([sys.executable, "-c", question], capture_output=True, text=True)
    if answer.returncode != 0:
        reason = (answer.stderr.strip().splitlines() or ["no answer"])[-1]
        raise InputError(f"-j needs MPI, which cannot be loaded ({reason}): {MEND}")
    return answer.stdout


def launcher_family(path: Path) -> str:
    """Which MPI a mpirun belongs to: "openmpi", "mpich" or "unknown"."""
    try:
        answer = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return "broken"
    return mpi_family(answer.stdout + answer.stderr)


def mpi_family(text: str) -> str:
    """Family by version text; MPICH, Intel MPI and MVAPICH share one binary interface and one kind of launcher."""
    lower = text.lower()
    if "open mpi" in lower or "openrte" in lower or "prrte" in lower:
        return "openmpi"
    return "mpich" if any(name in lower for name in ("mpich", "hydra", "mvapich", "intel(r) mpi")) else "unknown"


def run_forwarding_signals(command: Sequence[str], env: Mapping[str, str]) -> int:
    """Run the command to its end, passing signals on; return its exit code, 1 if a signal ended it."""
    child: subprocess.Popen[bytes] | None = None
    early: list[int] = []

    def forward(number: int, frame: FrameType | None) -> None:
        if child is None:
            early.append(number)
        elif child.poll() is None:
            child.send_signal(FORWARDED[signal.Signals(number)])

    previous = {number: signal.signal(number, forward) for number in FORWARDED}
    try:
        # A session of its own: else a terminal's Ctrl-C reaches mpirun twice, and it ends the ranks on the second.
        child = subprocess.Popen(command, env=dict(env), stdin=subprocess.DEVNULL, start_new_session=True)
        for number in early:
            forward(number, None)
        code = child.wait()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return code if code >= 0 else 1
