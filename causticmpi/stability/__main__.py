"""`python -m causticmpi.stability`."""

import os
import sys

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # one process is one thread

if __name__ == "__main__":
    from causticmpi.stability.run import main

    sys.exit(main(sys.argv[1:]))
