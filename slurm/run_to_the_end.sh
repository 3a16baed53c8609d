# Sourced by the batch scripts: one step of ranks that may be interrupted, and the way back into the queue.

# One rank = one thread.
export OMP_NUM_THREADS=1
# Compiled kernels stay on each node's own disk: 20 ranks need not share a file system for them.
export CAUSTICMPI_CACHE="${CAUSTICMPI_CACHE:-/tmp/causticmpi-$(id -u)}"
CAUSTICMPI=${CAUSTICMPI:-.venv/bin/causticmpi}
# -K1: when one rank dies the others end too. pmi2 is what libraries with the MPICH ABI speak.
LAUNCH=${LAUNCH:-srun -K1 --mpi=pmi2}

tell_until_gone() {
    while kill -USR1 "$1" 2> /dev/null; do sleep 5; done
}

run_to_the_end() { # DIR WORDS...: runs `causticmpi WORDS...`, which leaves DIR/unfinished if a signal stopped it
    local directory=$1 step code requeue=
    shift
    # A rank that is still starting would die of USR1: it ignores it until it can save, and is told again.
    $LAUNCH sh -c 'trap "" USR1; exec "$@"' ranks "$CAUSTICMPI" "$@" &
    step=$!
    trap 'requeue=yes; tell_until_gone "$step" &' USR1
    trap : TERM # SLURM ends the ranks of a cancelled job itself; this shell stays until they have saved
    while wait "$step"; code=$?; kill -0 "$step" 2> /dev/null; do :; done # a signal to this shell ends `wait` early
    if [ -n "$requeue" ] && [ "$code" -eq 0 ] && [ -e "$directory/unfinished" ]; then
        echo "$(date '+%F %T') $directory is unfinished: back into the queue"
        scontrol requeue "$SLURM_JOB_ID"
        sleep 60 # SLURM ends this shell; its exit would be taken for the end of the job
    fi
    exit "$code"
}
