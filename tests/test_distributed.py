"""The MPI layer, in real runs under mpirun, and its serial stand-in."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mpi_tools import (
    PROGRAMS,
    launcher_words,
    python_environment,
    remove_shared_memory,
    require_mpi,
    run_mpi,
    shared_files,
    start_mpi,
)

from causticmpi.distributed.environment import announced_size, launcher_rank, started_by_launcher
from causticmpi.distributed.launch import launch_ranks, launcher_family, mpi_family, without_ranks_option
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.world import AgreedInputError, SerialWorld, open_world
from causticmpi.errors import InputError

pytestmark = pytest.mark.mpi
END = 60
"""Seconds within which a broken run has to be gone: it would hang for ever, and others may keep the cores busy."""


def lines(text: str, word: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith(word + " ")]


def run_failing(ranks: int, what: str, rank: int) -> "subprocess.CompletedProcess[str]":
    """Run failing.py, check that it is gone in time and that no rank got to the end."""
    start = time.monotonic()
    done = run_mpi(ranks, [PROGRAMS / "failing.py", what, str(rank)], timeout=2 * END)
    remove_shared_memory(done.stdout)
    assert time.monotonic() - start < END
    assert "reached the end" not in done.stdout
    return done


@pytest.mark.parametrize(("ranks", "per_node"), [(2, 0), (3, 0), (3, 2), (3, 1), (20, 7)])
def test_collectives(ranks: int, per_node: int) -> None:
    # One rank a node: MPICH takes its windows from malloc then, which here fills them with rubbish.
    alone = {"MPIR_CVAR_NOLOCAL": "1", "MALLOC_PERTURB_": "7"} if per_node == 1 else {}
    done = run_mpi(ranks, [PROGRAMS / "collectives.py", str(per_node)], env=alone)
    assert done.returncode == 0, done.stderr
    assert sorted(int(line.split()[1]) for line in lines(done.stdout, "ok")) == list(range(ranks))
    named = shared_files(done.stdout)
    assert named and not [file for file in named if file.exists()]


@pytest.mark.parametrize(("ranks", "words"), [(3, "0"), (20, "7"), (3, "2 short")])
def test_films_of_nodes_against_plain_sums(ranks: int, words: str) -> None:
    done = run_mpi(ranks, [PROGRAMS / "node_films.py", *words.split()])
    assert done.returncode == 0, done.stderr
    assert sorted(int(line.split()[1]) for line in lines(done.stdout, "ok")) == list(range(ranks))
    assert ("each rank has sums of its own" in done.stderr) == ("short" in words), done.stderr
    named = shared_files(done.stdout)
    assert named and not [file for file in named if file.exists()]


def test_waiting_is_asleep() -> None:
    done = run_mpi(3, [PROGRAMS / "idle.py", "1.5"])
    measured = [[float(word) for word in line.split()[1:]] for line in lines(done.stdout, "cpu")]
    assert done.returncode == 0 and len(measured) == 3, done.stderr
    assert all(cpu < 0.3 * 1.5 for row in measured for cpu in row), measured


def test_failures_one_after_another_give_one_message() -> None:
    done = run_failing(3, "raise-late", -1)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("ending all ranks") == 1 and "rank 2 of 3" in done.stderr, done.stderr


@pytest.mark.parametrize("rank", [0, 2, -1])
def test_uncaught_exception_ends_all(rank: int) -> None:
    done = run_failing(3, "raise", rank)
    assert done.returncode == 1, done.stderr
    assert "cleared up" not in done.stdout  # a rank that leaves by way of `close` joins in what the others wait for
    assert done.stderr.count("failed: ValueError: boom in the sampler; ending all ranks") == 1, done.stderr
    # Where all fail at once, the first to be heard of prints: that need not be rank 0 on a busy machine.
    assert f"rank {'' if rank == -1 else f'{rank} of 3 on '}" in done.stderr
    assert done.stderr.count("Traceback (most recent call last)") == 1, done.stderr


def test_killed_rank_ends_all() -> None:
    done = run_failing(3, "kill", 1)
    assert done.returncode != 0


@pytest.mark.parametrize("what", ["agree", "leader-input"])
def test_agreed_input_error(what: str) -> None:
    done = run_failing(3, what, 1)
    assert done.returncode == 2, done.stderr
    assert lines(done.stderr, "causticmpi:") == ["causticmpi: scene.yaml:3: found no camera"], done.stderr
    assert "Traceback" not in done.stderr and "Abort" not in done.stderr


def test_input_error_of_one_rank_ends_all() -> None:
    done = run_failing(3, "input", 1)
    assert done.returncode == 2, done.stderr
    (line,) = lines(done.stderr, "causticmpi:")
    assert "rank 1 of 3" in line and "bad input: scene.yaml:3: found no camera" in line


def test_error_of_node_leader_ends_all() -> None:
    done = run_failing(3, "leader", -1)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("ending all ranks") == 1, done.stderr
    assert "rank 0 of 3" in done.stderr and "ValueError: boom" in done.stderr


@pytest.mark.parametrize("variable", ["PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS"])
def test_launcher_mismatch_is_refused(variable: str) -> None:
    require_mpi()
    env = python_environment() | {variable: "4"}
    command = [sys.executable, str(PROGRAMS / "mismatch.py")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=END)
    remove_shared_memory(done.stdout)  # a lone process of Open MPI leaves its segment behind
    assert done.returncode != 0
    assert "InputError" in done.stderr and f"launcher started 4 ({variable}=4)" in done.stderr, done.stderr
    assert "use the mpirun that belongs to the library" in done.stderr


def test_launcher_without_mpi_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mpi4py.py").write_text("raise ImportError('no mpi4py here')\n")
    program = "from causticmpi.distributed.world import open_world; open_world()"
    env = python_environment() | {"PMI_SIZE": "2"}
    env["PYTHONPATH"] = f"{tmp_path}{os.pathsep}{env['PYTHONPATH']}"
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, timeout=END)
    assert "InputError" in done.stderr and "pip install '.[mpi]' in the clone" in done.stderr, done.stderr


def test_serial_start_loads_no_mpi() -> None:
    program = (
        "import sys; from causticmpi.distributed.world import open_world; world = open_world(); "
        "import causticmpi.distributed.launch, causticmpi.distributed.failure; "
        "print(type(world).__name__, world.size, 'mpi4py' in sys.modules)"
    )
    for extra in ({}, {"SLURM_NTASKS": "4"}, {"PMI_RANK": "0", "PMI_SIZE": "1"}):
        env = python_environment() | extra
        done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, timeout=END)
        assert done.stdout.split() == ["SerialWorld", "1", "False"], done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_signal_to_launcher_stops_all_ranks(number: int) -> None:
    require_mpi()
    if launcher_family(Path(launcher_words()[0])) == "openmpi":
        pytest.skip("Open MPI's mpirun ends the ranks by itself after a signal")
    process = start_mpi(2, [PROGRAMS / "stopping.py"])
    assert process.stdout is not None
    for _ in range(2):
        assert process.stdout.readline().startswith("started")
    process.send_signal(number)
    out, err = process.communicate(timeout=END)
    assert lines(out, "stopped") == [f"stopped {int(number)}"] * 2, err
    assert process.returncode == 0


def launch(*argv: str) -> "subprocess.CompletedProcess[str]":
    """launch_ranks(2, argv) of arguments.py, in a process of its own."""
    program = (
        "import sys; from causticmpi.distributed.launch import launch_ranks; "
        f"sys.exit(launch_ranks(2, sys.argv[1:], [{str(PROGRAMS / 'arguments.py')!r}]))"
    )
    command = [sys.executable, "-c", program, *argv]
    return subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=END)


@pytest.mark.parametrize("code", [0, 2])
def test_launch_ranks(code: int) -> None:
    require_mpi()
    done = launch("render", "-j", "2", "a b.yaml", "--spp", "4", str(code))
    assert done.returncode == code, done.stderr
    words = f"1 render a b.yaml --spp 4 {code}"
    assert sorted(lines(done.stdout, "rank")) == [f"rank {rank} of 2 {words}" for rank in range(2)]


def test_launch_ranks_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    assert launch_ranks(1, ["render", "x.yaml"]) is None
    with pytest.raises(InputError, match="found 0, need at least 1"):
        launch_ranks(0, [])
    monkeypatch.setenv("PMI_RANK", "0")
    with pytest.raises(InputError, match="started this process already"):
        launch_ranks(2, [])


def test_launch_ranks_without_mpirun(monkeypatch: pytest.MonkeyPatch) -> None:
    require_mpi()
    monkeypatch.setattr("causticmpi.distributed.launch.launcher_candidates", lambda: [])
    with pytest.raises(InputError, match=r"pip install '\.\[mpi\]' in the clone"):
        launch_ranks(2, ["render"])


def test_ranks_option_is_removed() -> None:
    assert without_ranks_option(["render", "-j2", "x", "-j", "3", "-j=4", "--out", "-jungle"]) == [
        "render",
        "x",
        "--out",
        "-jungle",
    ]


def test_launcher_environment_is_understood() -> None:
    assert announced_size({}) == (1, "") and not started_by_launcher({"SLURM_NTASKS": "8", "SLURM_PROCID": "3"})
    assert announced_size({"PMI_SIZE": "1", "SLURM_STEP_NUM_TASKS": "4"}) == (4, "SLURM_STEP_NUM_TASKS=4")
    assert started_by_launcher({"PMIX_RANK": "0"}) and started_by_launcher({"SLURM_STEP_NUM_TASKS": "2"})
    assert launcher_rank({"PMI_RANK": "3", "PMI_SIZE": "4"}) == 3 and launcher_rank({"SLURM_PROCID": "3"}) == 0
    assert mpi_family("mpirun (Open MPI) 5.0") == "openmpi" and mpi_family("HYDRA build details:") == "mpich"


def test_serial_world() -> None:
    world = open_world()
    assert isinstance(world, SerialWorld) and world.is_root and world.is_node_leader and len(world.hosts()) == 1
    array = np.arange(6.0).reshape(2, 3)
    shared = world.share({"a": array, "scalar": np.array(1)})
    assert np.shares_memory(shared["a"], array) and not shared["a"].flags.writeable and array.flags.writeable
    assert shared["scalar"].shape == ()
    total = world.reduce_sum(array)
    assert total is not None and np.array_equal(total, array) and not np.shares_memory(total, array)
    assert (world.all_min(3), world.all_max(4), world.gather("x"), world.broadcast("y")) == (3, 4, ["x"], "y")
    assert world.first_on_node(lambda: 5) == 5
    world.agree(None)
    with pytest.raises(AgreedInputError, match="found no camera"):
        world.agree(InputError("found no camera"))


def test_stop_flag() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGCONT)]
    with StopFlag() as flag:
        os.kill(os.getpid(), signal.SIGCONT)
        assert flag.raised == 0
        for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGTERM, signal.SIGINT, signal.SIGINT):
            os.kill(os.getpid(), number)
        assert flag.raised == signal.SIGUSR1
    after = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGCONT)]
    assert after == before
