"""What the environment says about a launcher (mpirun, mpiexec, srun), before any MPI is loaded."""

import os
from collections.abc import Mapping

SIZE_VARIABLES = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MPI_LOCALNRANKS", "SLURM_STEP_NUM_TASKS")
"""Each holds a number of processes. SLURM_NTASKS is no test: the batch shell has it too."""

RANK_VARIABLES = ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "PMIX_RANK", "SLURM_PROCID")


def announced_size(env: Mapping[str, str] = os.environ) -> tuple[int, str]:
    """The largest number of processes any launcher announces, and "VARIABLE=value"; (1, "") without a launcher."""
    sizes = [(int(env[name]), f"{name}={env[name]}") for name in SIZE_VARIABLES if env.get(name, "").isdigit()]
    return max(sizes, key=lambda size: size[0], default=(1, ""))


def started_by_launcher(env: Mapping[str, str] = os.environ) -> bool:
    """True for a process that mpirun, mpiexec or `srun -n` (more than one task, or with an MPI plugin) started."""
    own = any(name in env for name in ("PMI_RANK", "PMI_SIZE", "PMIX_RANK", "OMPI_COMM_WORLD_SIZE", "MPI_LOCALNRANKS"))
    return own or announced_size(env)[0] > 1


def launcher_rank(env: Mapping[str, str] = os.environ) -> int:
    """Rank by the launcher's word, 0 without one: who prints while there is no world (its opening failed)."""
    if not started_by_launcher(env):
        return 0
    return next((int(env[name]) for name in RANK_VARIABLES if env.get(name, "").isdigit()), 0)
