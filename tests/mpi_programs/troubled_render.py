"""The program, with trouble built in. Arguments: what happens, on which rank, a directory, then causticmpi's own.

raise, kill   once a picture has been written, in the middle of a round
disk-full     the second picture cannot be written
signal        the rank alone gets SIGUSR1, at the same time
crawl         the first round takes for ever
slow-rename   putting a file in place takes a second and a half
clock-steps   the wall clock jumps to and fro by an hour, at every look at it

The file "trouble" appears in the directory when it begins.
"""

import errno
import itertools
import os
import signal
import sys
import time
from pathlib import Path

import causticmpi.distributed.result as result
from causticmpi.cli.main import main
from causticmpi.distributed.environment import launcher_rank
from causticmpi.render.rounds import Batches


def trouble_in_tracing(what: str, folder: Path, picture: Path) -> None:
    trace = Batches.trace

    def troubled(self, shares, pending, stop):
        if what == "crawl":
            (folder / "trouble").touch()
            while not stop():
                time.sleep(0.1)
            return False
        if picture.exists():
            (folder / "trouble").touch()
            if what == "raise":
                raise ValueError("boom in the sampler")
            os.kill(os.getpid(), signal.SIGKILL if what == "kill" else signal.SIGUSR1)
        return trace(self, shares, pending, stop)

    Batches.trace = troubled


def trouble_in_writing(folder: Path, picture: Path) -> None:
    write_run = result.write_run

    def troubled(*arguments):
        if picture.exists():
            (folder / "trouble").touch()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(picture))
        return write_run(*arguments)

    result.write_run = troubled


def slow_rename() -> None:
    replace = os.replace

    def slow(source, target):
        time.sleep(1.5)
        replace(source, target)

    os.replace = slow


def clock_steps() -> None:
    true_time, looks = time.time, itertools.count()
    time.time = lambda: true_time() + (3600 if next(looks) % 2 else -3600)


if __name__ == "__main__":
    what, rank, folder, *words = sys.argv[1:]
    sys.argv[1:] = words
    picture = Path(words[words.index("--out") + 1]) / "report.json"
    if int(rank) in (-1, launcher_rank()):
        if what == "slow-rename":
            slow_rename()
        elif what == "clock-steps":
            clock_steps()
        elif what == "disk-full":
            trouble_in_writing(Path(folder), picture)
        else:
            trouble_in_tracing(what, Path(folder), picture)
    raise SystemExit(main())
