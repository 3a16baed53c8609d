"""A small SLURM on this machine alone: munge, controller and a few pretended nodes as child processes of a test.

Needs root and Debian's packages slurm-wlm and munge; nothing is left behind but a folder of logs. Also a program:

    python tests/slurm_lab/lab.py NODES CPUS COMMAND...    run a command inside the lab
"""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Self

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol", "scancel", "squeue", "sinfo")
PACKAGES = ("slurm-wlm", "munge")
SEARCH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
PATIENCE = 60
"""Seconds until all nodes answer."""


class LabError(Exception):
    """Why there can be no SLURM here."""


def missing_programs() -> list[str]:
    return [name for name in PROGRAMS if shutil.which(name, path=SEARCH) is None]


def install() -> None:
    """Debian's packages, their services not started. Raises LabError."""
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        raise LabError(
            f"SLURM is not installed, and only root on Debian or Ubuntu can: apt install {' '.join(PACKAGES)}"
        )
    env = os.environ | {"DEBIAN_FRONTEND": "noninteractive", "RUNLEVEL": "1"}
    words = ["apt-get", "-qq", "-o", "Acquire::Retries=1"]
    subprocess.run([*words, "update"], env=env, capture_output=True, timeout=120)
    done = subprocess.run(
        [*words, "install", "-y", "--no-install-recommends", *PACKAGES],
        env=env, capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode != 0:
        raise LabError(f"apt-get cannot install {' '.join(PACKAGES)}: {done.stderr.strip().splitlines()[-1:]}")


class SlurmLab:
    """`with SlurmLab(nodes=2, cpus=2) as lab: lab.run("sbatch", ...)`. folder: configuration, state and logs."""

    def __init__(self, nodes: int, cpus: int, folder: Path | None = None) -> None:
        if os.geteuid() != 0:
            raise LabError("slurmd starts job steps as other users: it needs root")
        if missing_programs():
            raise LabError(f"not installed: {', '.join(missing_programs())} (apt install {' '.join(PACKAGES)})")
        self.nodes, self.cpus = nodes, cpus
        self.folder = folder or Path(tempfile.mkdtemp(prefix="slurm-lab-"))
        self.config = self.folder / "slurm.conf"
        self.env = os.environ | {"SLURM_CONF": str(self.config), "PATH": SEARCH}
        self._daemons: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _start(self) -> None:
        self.folder.chmod(0o755)  # munge refuses a socket that other users cannot reach
        for name in ("state", "munge", "spool", "log"):
            (self.folder / name).mkdir(exist_ok=True)
        (self.folder / "munge").chmod(0o755)
        self.config.write_text(self._settings())
        key = self.folder / "key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        munge = self.folder / "munge"
        self._daemon(
            "munged", "--foreground", "--force", f"--key-file={key}", f"--socket={munge}/socket",
            f"--pid-file={munge}/pid", f"--seed-file={munge}/seed", f"--log-file={munge}/log",
        )  # fmt: skip
        wait_until(lambda: (munge / "socket").exists(), PATIENCE, "munged opened no socket")
        self._daemon("slurmctld", "-D", "-f", str(self.config))
        for number in range(1, self.nodes + 1):
            self._daemon("slurmd", "-D", "-N", f"node{number}", "-f", str(self.config))
        wait_until(lambda: self._idle() == self.nodes, PATIENCE, "not all nodes came up: see log/ of the lab")

    def _settings(self) -> str:
        here = socket.gethostname().split(".")[0]
        ports = free_ports(self.nodes + 1)
        lines = {
            "ClusterName": "lab", "SlurmctldHost": f"{here}(127.0.0.1)", "SlurmctldPort": ports[0],
            "SlurmUser": "root", "SlurmdUser": "root",
            "AuthType": "auth/munge", "AuthInfo": f"socket={self.folder}/munge/socket", "CredType": "cred/munge",
            "StateSaveLocation": f"{self.folder}/state", "SlurmdSpoolDir": f"{self.folder}/spool/%n",
            "SlurmctldPidFile": f"{self.folder}/slurmctld.pid", "SlurmdPidFile": f"{self.folder}/%n.pid",
            "SlurmctldLogFile": f"{self.folder}/log/slurmctld", "SlurmdLogFile": f"{self.folder}/log/%n",
            # Without cgroups: steps are found by their parents, nothing is bound or enforced.
            "ProctrackType": "proctrack/linuxproc", "TaskPlugin": "task/none",
            "JobAcctGatherType": "jobacct_gather/none", "AccountingStorageType": "accounting_storage/none",
            "JobCompType": "jobcomp/filetxt", "JobCompLoc": f"{self.folder}/log/finished-jobs",
            "SelectType": "select/cons_tres", "SelectTypeParameters": "CR_CPU", "SlurmdParameters": "config_overrides",
            "CommunicationParameters": "NoInAddrAny,NoCtldInAddrAny",
            "SchedulerParameters": "sched_interval=2,bf_interval=2,batch_sched_delay=0,kill_invalid_depend",
            "KillWait": 20, "MinJobAge": 3600, "ReturnToService": 2, "MessageTimeout": 30, "JobRequeue": 1,
        }  # fmt: skip
        text = "".join(f"{name}={value}\n" for name, value in lines.items())
        for number, port in enumerate(ports[1:], 1):
            text += (
                f"NodeName=node{number} NodeHostname={here} NodeAddr=127.0.0.1 Port={port} CPUs={self.cpus} Boards=1 "
                f"Sockets=1 CoresPerSocket={self.cpus} ThreadsPerCore=1 RealMemory=32000 State=UNKNOWN\n"
            )
        return text + "PartitionName=lab Nodes=ALL Default=YES MaxTime=60 DefaultTime=10 State=UP\n"

    def _daemon(self, *words: str) -> None:
        log = (self.folder / "log" / f"{words[0]}-{len(self._daemons)}.out").open("wb")
        program = shutil.which(words[0], path=SEARCH)
        assert program is not None
        self._daemons.append(
            subprocess.Popen([program, *words[1:]], env=self.env, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        )
        log.close()

    def _idle(self) -> int:
        dead = [daemon.args for daemon in self._daemons if daemon.poll() is not None]
        if dead:
            raise LabError(f"{dead[0]} ended at once: see {self.folder}/log")
        listed = self.run("sinfo", "-h", "-N", "-t", "idle", "-o", "%N", check=False).stdout
        return len(set(listed.split()))

    def run(
        self, *words: str, check: bool = True, cwd: Path | None = None, env: Mapping[str, str] | None = None
    ) -> "subprocess.CompletedProcess[str]":
        """Run a command that finds this lab."""
        return subprocess.run(
            words, env={**self.env, **(env or {})}, cwd=cwd, capture_output=True, text=True, check=check, timeout=60
        )

    def job(self, number: str) -> dict[str, str]:
        """What the controller says of a job: JobState, Restarts, ..."""
        shown = self.run("scontrol", "show", "job", number, "-o").stdout
        return dict(word.split("=", 1) for word in shown.split() if "=" in word)

    def stop(self) -> None:
        """Cancel all jobs, wait for their ends, end the daemons."""
        if len(self._daemons) > 1:
            with contextlib.suppress(subprocess.SubprocessError, AssertionError):
                self.run("scancel", "--full", "--partition=lab", check=False)
                wait_until(lambda: not self.run("squeue", "-h", check=False).stdout.strip(), 30, "jobs did not end")
        for daemon in reversed(self._daemons):
            daemon.terminate()
        for daemon in reversed(self._daemons):
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()
        self._daemons.clear()


def free_ports(count: int) -> list[int]:
    """TCP ports nobody listens to at the moment."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def wait_until(true: Callable[[], bool], seconds: float, complaint: str) -> None:
    """Look four times a second. Raises AssertionError with the complaint when the time is over."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, complaint
        time.sleep(0.25)


def main(words: Sequence[str]) -> int:
    nodes, cpus, *command = words
    try:
        if missing_programs():
            install()
        with SlurmLab(int(nodes), int(cpus)) as lab:
            return subprocess.run(command, env=lab.env).returncode
    except LabError as reason:
        print(f"slurm lab: {reason}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
