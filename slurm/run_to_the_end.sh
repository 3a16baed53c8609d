# Sourced by the batch scripts: one step of ranks that may be interrupted, and the way back into the queue.

# One rank = one thread.
export OMP_NUM_THREADS=1
# Compiled kernels stay on each node's own disk: 20 ranks need not share a file system for them.
export CAUSTICMPI_CACHE="${CAUSTICMPI_CACHE:-/tmp/causticmpi-$(id -u)}"
CAUSTICMPI=${CAUSTICMPI:-.venv/bin/causticmpi}
# -K1: when one rank dies the others end too. pmi2 is what libraries with the MPICH ABI speak.
LAUNCH=${LAUNCH:-srun -K1 --mpi=pmi2}

run_to_the_end() { # DIR WORDS...: runs `causticmpi WORDS...`, which leaves DIR/unfinished if a signal stopped it
    local directory=$1 step code requeue=
    shift
    $LAUNCH "$CAUSTICMPI" "$@" &
    step=$!
    # SLURM ends the ranks of a cancelled job itself; this shell stays until they have saved.
    trap 'requeue=yes; kill -USR1 "$step"' USR1
    trap : TERM
    while wait "$step"; code=$?; kill -0 "$step" 2> /dev/null; do :; done # a signal to this shell ends `wait` early
    if [ -n "$requeue" ] && [ "$code" -eq 0 ] && [ -e "$directory/unfinished" ]; then
        echo "$(date '+%F %T') $directory is unfinished: back into the queue"
        scontrol requeue "$SLURM_JOB_ID"
        sleep 60 # SLURM ends this shell; its exit would be taken for the end of the job
    fi
    exit "$code"
}
