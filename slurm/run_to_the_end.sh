# Sourced by the batch scripts: one step of ranks that may be interrupted, and the way back into the queue.

# One rank = one thread.
export OMP_NUM_THREADS=1
# Compiled kernels stay on each node's own disk: 20 ranks need not share a file system for them.
export CAUSTICMPI_CACHE="${CAUSTICMPI_CACHE:-/tmp/causticmpi-$(id -u)}"
PROGRAM=$(realpath -- "${CAUSTICMPI:-.venv/bin/causticmpi}")
export PROGRAM # for slurm/rank
# The MPI that pip brought along comes with its own launcher, which asks SLURM for the nodes and places the ranks. A
# cluster's MPI is started by srun; -K1: when one rank dies the others end too; pmi2: what the MPICH ABI speaks.
brought=$(dirname -- "$PROGRAM")/mpiexec
if [ -z "${LAUNCH:-}" ] && [ -x "$brought" ]; then
    LAUNCH=$brought
    export SLURM_CPU_BIND=none # or its helper, one a node, would keep all ranks of the node on its own core
fi
LAUNCH=${LAUNCH:-srun -K1 --mpi=pmi2}

run_to_the_end() { # FILE COMMAND...: runs ranks by a command, which leaves the file if a signal stopped them
    local file=$1 before step code requeue=
    before=$(mark "$1")
    shift
    "$@" &
    step=$!
    trap 'requeue=yes; tell_until_saved "$step" "$file" "$before" &' USR1
    trap : TERM # SLURM ends the ranks of a cancelled job itself; this shell stays until they have saved
    while wait "$step"; code=$?; kill -0 "$step" 2> /dev/null; do :; done # a signal to this shell ends `wait` early
    # Whatever the launcher says: mpiexec fails if a signal reaches it when its ranks have saved and gone.
    if [ -n "$requeue" ] && saved "$file" "$before"; then
        echo "$(date '+%F %T') $file: back into the queue"
        # By its place in the array, if it is of one: the number of an array's last job means the whole array.
        scontrol requeue "${SLURM_ARRAY_JOB_ID:-$SLURM_JOB_ID}${SLURM_ARRAY_TASK_ID:+_$SLURM_ARRAY_TASK_ID}"
        sleep 60 # SLURM ends this shell; its exit would be taken for the end of the job
    fi
    exit "$code"
}

mark() { # FILE: which one it is, nothing if there is none; no clock is asked, for that of a file system may be another
    stat -c '%i %y' -- "$1" 2> /dev/null
}

saved() { # FILE BEFORE: whether it was made anew
    local now
    now=$(mark "$1") && [ "$now" != "$2" ]
}

tell_until_saved() { # PROCESS FILE BEFORE: again and again, for a launcher that only starts may miss a signal
    while kill -USR1 "$1" 2> /dev/null; do
        sleep 5
        ! saved "$2" "$3" || break
    done
}
