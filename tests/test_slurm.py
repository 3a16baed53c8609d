"""The batch scripts on a real SLURM of pretended nodes: interrupted, queued again, cancelled, gone on with, same bits.

Skipped where SLURM is not installed; CAUSTICMPI_SLURM=1 installs it (root, Debian). The long story, with the time limit
itself and the two minutes that SLURM makes a requeued job wait, is tests/slurm_lab/long_story; that of an array of
comparisons is tests/slurm_lab/array_story.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mpi_tools import ROOT, launcher_words, python_environment, require_mpi
from program_tools import CORNELL, SMALL, assert_same_layers, compile_kernels, read_layers, read_report, render_mpi
from slurm_lab.lab import LabError, SlurmLab, install, missing_programs, wait_until

from causticmpi.distributed.launch import launcher_family
from causticmpi.kernels.jit import cache_directory

PASSES = 6000
PICTURE = (*SMALL, "--method", "pt", "--set=output.interval=0.5", "--spp", str(PASSES))
"""Some seconds of work for two cores, and a picture to look for early on."""
PATIENCE = 120

pytestmark = pytest.mark.mpi


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmLab]:
    require_mpi()
    if launcher_family(Path(launcher_words()[0])) == "openmpi":
        pytest.skip("the batch scripts start ranks by pmi2, which the installed Open MPI does not speak")
    try:
        if missing_programs() and "CAUSTICMPI_SLURM" in os.environ:
            install()
        with SlurmLab(2, 2, tmp_path_factory.mktemp("lab")) as made:
            compile_kernels()
            yield made
    except LabError as reason:
        pytest.skip(f"no SLURM: {reason}")


@pytest.fixture
def submit(lab: SlurmLab, tmp_path: Path) -> Callable[..., str]:
    """Submit slurm/render.sbatch with these arguments on 2 nodes with 2 ranks each; returns the job's number."""
    program = tmp_path / "causticmpi"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m causticmpi "$@"\n')
    program.chmod(0o755)
    kept = {name: python_environment()[name] for name in ("PYTHONPATH", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    env = kept | {"CAUSTICMPI": str(program), "CAUSTICMPI_CACHE": str(cache_directory().parent)}
    env |= {"LAUNCH": launcher_words()[0]}
    shape = ("--nodes=2", "--ntasks-per-node=2", "--time=5", f"--output={tmp_path}/job.out")

    def submit(*words: str) -> str:
        command = ("sbatch", "--parsable", *shape, str(ROOT / "slurm" / "render.sbatch"), *words)
        return lab.run(*command, cwd=ROOT, env=env).stdout.strip()

    return submit


def wait_for_state(lab: SlurmLab, job: str, *states: str) -> None:
    wait_until(lambda: lab.job(job)["JobState"] in states, PATIENCE, f"job {job} is {lab.job(job)['JobState']}")


def test_interrupted_cancelled_and_gone_on_with(lab: SlurmLab, submit: Callable[..., str], tmp_path: Path) -> None:
    out, log = tmp_path / "out", tmp_path / "job.out"
    render_mpi(2, tmp_path / "alone", *PICTURE[len(SMALL) :])

    job = submit(str(CORNELL), "--out", str(out), *PICTURE)
    wait_until((out / "report.json").exists, PATIENCE, "no picture was written")
    lab.run("scancel", "--batch", "--signal=USR1", job)
    wait_until(lambda: lab.job(job)["Restarts"] == "1", PATIENCE, "the job did not go back into the queue")
    assert "back into the queue" in log.read_text(), log.read_text()
    stopped = read_report(out)["passes"]
    assert 0 < stopped < PASSES and (out / "unfinished").exists()

    wait_for_state(lab, job, "PENDING")
    time.sleep(2)  # a job that starts again within the second of its end is refused: "job credential revoked"
    lab.run("scontrol", "update", f"JobId={job}", "StartTime=now")
    wait_until(lambda: log.read_text().count("causticmpi: tracing\n") == 2, PATIENCE, "the job did not go on")
    assert f"going on from the {stopped} passes of its checkpoint" in log.read_text()
    lab.run("scancel", job)
    wait_for_state(lab, job, "CANCELLED")
    wait_until(lambda: not lab.run("squeue", "-h", "-j", job, check=False).stdout, PATIENCE, "the job did not end")
    assert stopped <= read_report(out)["passes"] < PASSES and (out / "unfinished").exists(), log.read_text()
    assert lab.job(job)["Restarts"] == "1"

    job = submit(str(CORNELL), "--out", str(out), "--resume", *PICTURE)
    wait_for_state(lab, job, "COMPLETED", "FAILED", "CANCELLED")
    assert lab.job(job)["JobState"] == "COMPLETED", log.read_text()
    report = read_report(out)
    assert report["passes"] == PASSES and report["ranks"] == 4 and not (out / "unfinished").exists()
    assert report["provenance"]["world"]["nodes"] == 2
    assert_same_layers(read_layers(out)[0], read_layers(tmp_path / "alone")[0])


def test_bad_input_ends_a_job_at_once(lab: SlurmLab, submit: Callable[..., str], tmp_path: Path) -> None:
    job = submit(str(CORNELL), "--out", str(tmp_path / "out"), "--spp", "none")
    wait_for_state(lab, job, "FAILED", "COMPLETED", "CANCELLED")
    # 2 of the first rank to leave, or 143 where srun -K1 ended ranks that were still on their way out.
    assert lab.job(job)["JobState"] == "FAILED" and lab.job(job)["ExitCode"] in ("2:0", "143:0")
    assert (tmp_path / "job.out").read_text().count("causticmpi: ") == 1


LAUNCHERS = {
    "saves, then fails": ("echo > unfinished; exit 255", True),
    "fails": ("exit 1", False),
    "ends by itself": ("exit 0", False),
}


@pytest.mark.parametrize("name", LAUNCHERS)
def test_back_into_the_queue_only_with_a_state(name: str, tmp_path: Path) -> None:
    """A launcher that is told to stop: its ranks save, and it fails over a second signal; it fails and leaves the old
    marker; it ends, for the run was done. No SLURM is needed."""
    told, requeued = LAUNCHERS[name]
    (tmp_path / "unfinished").touch()  # of an earlier start
    launcher = f"told() {{ {told}; }}; trap told USR1; kill -USR1 $PPID; while :; do /bin/sleep 0.05; done"
    for program, does in {"scontrol": 'echo "$@" > requeued', "sleep": "exec /bin/sleep 0.3"}.items():
        (tmp_path / program).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / program).chmod(0o755)
    (tmp_path / "launcher").write_text(f"#!/bin/bash\n{launcher}\n")
    words = f". {ROOT}/slurm/run_to_the_end.sh; run_to_the_end unfinished bash launcher"
    env = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURM_JOB_ID": "7"}
    subprocess.run(["bash", "-c", words], cwd=tmp_path, env=env, timeout=PATIENCE)
    asked = tmp_path / "requeued"
    assert (asked.read_text() == "requeue 7\n") if requeued else not asked.exists()


@pytest.mark.parametrize("script", sorted((ROOT / "slurm").iterdir()), ids=lambda path: path.name)
def test_batch_scripts_are_bash(script: Path) -> None:
    assert subprocess.run(["bash", "-n", str(script)]).returncode == 0
